"use strict";
(() => {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const { names, status, details, columns, x, y, corners, edges } = facts;
  const count = names.length;
  const REGISTERED = "registered";
  const number = new Intl.NumberFormat("en-GB", { maximumFractionDigits: 5 });
  const fixed = columns.map(([, digits]) => new Intl.NumberFormat("en-GB", { minimumFractionDigits: digits, maximumFractionDigits: digits }));
  const show = (value, k) => (value === null || value === undefined ? "–" : fixed[k].format(value));
  const byId = (id) => document.getElementById(id);

  let order = names.map((_, i) => i);
  let sorted = { key: -2, down: false };
  let chosen = -1;
  const partners = names.map(() => []);
  for (const [a, b, matches] of edges) { partners[a].push([b, matches]); partners[b].push([a, matches]); }

  // The table: only the rows in view are in the page.

  const ROW = 30;
  const PRINTED = 400;
  const box = byId("rows"), body = box.querySelector("tbody"), search = byId("search"), found = byId("found");

  function cell(kind, text, name) {
    const made = document.createElement(kind);
    made.textContent = text;
    if (name) made.className = name;
    if (kind === "th") made.scope = "row";
    return made;
  }

  function rowOf(i) {
    const row = document.createElement("tr");
    row.dataset.i = i;
    if (status[i] !== REGISTERED) row.classList.add("lack");
    if (i === chosen) row.classList.add("chosen");
    const name = cell("th", names[i]);
    name.title = names[i];
    row.append(name, cell("td", status[i], "status"));
    columns.forEach(([, , values], k) => row.append(cell("td", show(values[i], k))));
    return row;
  }

  function space(height) {
    const row = document.createElement("tr");
    row.className = "space";
    row.setAttribute("aria-hidden", "true");
    const filler = document.createElement("td");
    filler.colSpan = columns.length + 2;
    filler.style.height = `${height}px`;
    row.append(filler);
    return row;
  }

  function draw(all) {
    const first = all ? 0 : Math.max(0, Math.floor(box.scrollTop / ROW) - 10);
    const last = all ? Math.min(order.length, PRINTED)
      : Math.min(order.length, first + Math.ceil(box.clientHeight / ROW) + 20);
    const rows = order.slice(first, last).map(rowOf);
    body.replaceChildren(...(all ? rows
      : [space(first * ROW), ...rows, space((order.length - last) * ROW)]));
    byId("printed").textContent = order.length > PRINTED
      ? `The first ${PRINTED} of ${number.format(order.length)} rows are printed; the page itself has all.` : "";
  }

  function value(i, key) {
    return key === -2 ? names[i] : key === -1 ? status[i] : columns[key][2][i];
  }

  function choose_order() {
    const words = search.value.trim().toLowerCase();
    order = names.map((_, i) => i).filter(
      (i) => !words || names[i].toLowerCase().includes(words) || status[i].toLowerCase().includes(words));
    const { key, down } = sorted;
    order.sort((a, b) => {
      const p = value(a, key), q = value(b, key);
      const none = (p === null || p === undefined) - (q === null || q === undefined);
      if (none) return none; // what is not known comes last either way
      const less = typeof p === "string" ? p.localeCompare(q, "en", { numeric: true }) : p - q;
      return (down ? -less : less) || a - b;
    });
    found.textContent = `${number.format(order.length)} of ${number.format(count)} photos`;
    draw(false);
  }

  box.querySelectorAll("thead button").forEach((button, n) => {
    button.addEventListener("click", () => {
      const key = n - 2;
      sorted = { key, down: sorted.key === key ? !sorted.down : false };
      box.querySelectorAll("thead th").forEach((head, m) => {
        if (m === n) head.setAttribute("aria-sort", sorted.down ? "descending" : "ascending");
        else head.removeAttribute("aria-sort");
      });
      box.scrollTop = 0;
      choose_order();
    });
  });
  search.addEventListener("input", () => { box.scrollTop = 0; choose_order(); paint(); });
  box.addEventListener("scroll", () => requestAnimationFrame(() => draw(false)));
  body.addEventListener("click", (event) => {
    const row = event.target.closest("tr[data-i]");
    if (row) choose(Number(row.dataset.i), false);
  });
  box.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step || event.target !== box || !order.length) return;
    event.preventDefault();
    const at = order.indexOf(chosen);
    choose(order[Math.min(Math.max(at + step, 0), order.length - 1)], true);
  });

  // The photo that was chosen.

  function choose(i, scroll) {
    chosen = i;
    const at = order.indexOf(i);
    if (scroll && at >= 0) box.scrollTop = Math.max(0, at * ROW - box.clientHeight / 2);
    const best = [...partners[i]].sort((p, q) => q[1] - p[1]).slice(0, 5).map(([j, n]) => `${names[j]} (${number.format(n)})`);
    const name = document.createElement("strong");
    name.textContent = names[i];
    const parts = [` ${status[i]}.`];
    if (details[i]) parts.push(` ${details[i]}`);
    if (best.length) parts.push(` Strongest pairs: ${best.join(", ")}.`);
    if (x[i] === null) parts.push(" Its place is not known.");
    byId("picked").replaceChildren(name, ...parts);
    draw(false);
    paint();
  }

  // The map.

  const canvas = byId("map");
  if (!canvas) { choose_order(); return; }
  const pen = canvas.getContext("2d");
  const [west, south, east, north] = facts.box;
  const placed = names.map((_, i) => i).filter((i) => x[i] !== null);
  const pictures = {};
  function load(key, source) {
    if (!source) return;
    const image = new Image();
    image.onload = () => { pictures[key] = image; paint(); };
    image.src = source;
  }
  load("points", facts.points);
  load("overlap", facts.overlap && facts.overlap.picture);
  let scale = 1, shift = [0, 0], size = [1, 1];

  function fit() {
    const bounds = canvas.getBoundingClientRect();
    size = [bounds.width, bounds.height];
    scale = Math.min(size[0] / (east - west), size[1] / (north - south));
    shift = [(size[0] - scale * (east + west)) / 2, (size[1] + scale * (north + south)) / 2];
  }
  const at = (e, n) => [shift[0] + scale * e, shift[1] - scale * n];
  const checked = (id) => byId(id) && byId(id).checked;

  function lay(image, [w, s, e, n]) {
    const [left, top] = at(w, n), [right, bottom] = at(e, s);
    pen.imageSmoothingEnabled = scale * (e - w) < image.width;
    pen.drawImage(image, left, top, right - left, bottom - top);
  }

  function polygon(i) {
    const c = corners[i];
    if (!c) return;
    pen.beginPath();
    for (let k = 0; k < 8; k += 2) pen.lineTo(...at(c[k], c[k + 1]));
    pen.closePath();
  }

  function paint() {
    const sharp = window.devicePixelRatio || 1;
    canvas.width = Math.round(size[0] * sharp);
    canvas.height = Math.round(size[1] * sharp);
    pen.setTransform(sharp, 0, 0, sharp, 0, 0);
    pen.fillStyle = "#ffffff";
    pen.fillRect(0, 0, ...size);
    if (checked("layer-points") && pictures.points) lay(pictures.points, facts.box);
    if (checked("layer-overlap") && pictures.overlap) { pen.globalAlpha = 0.75; lay(pictures.overlap, facts.overlap.box); pen.globalAlpha = 1; }
    if (checked("layer-footprints")) {
      pen.strokeStyle = "rgba(20,80,210,0.35)"; pen.lineWidth = 0.7;
      for (const i of placed) if (corners[i]) { polygon(i); pen.stroke(); }
    }
    if (checked("layer-pairs")) {
      pen.strokeStyle = "rgba(40,40,40,0.3)"; pen.lineWidth = 0.6; pen.beginPath();
      for (const [a, b] of edges) if (x[a] !== null && x[b] !== null) { pen.moveTo(...at(x[a], y[a])); pen.lineTo(...at(x[b], y[b])); }
      pen.stroke();
    }
    if (chosen >= 0 && x[chosen] !== null) {
      polygon(chosen);
      if (corners[chosen]) { pen.fillStyle = "rgba(255,196,0,0.25)"; pen.fill(); pen.strokeStyle = "#8a6500"; pen.lineWidth = 1.5; pen.stroke(); }
      pen.strokeStyle = "#0b5cad"; pen.lineWidth = 1.2; pen.beginPath();
      for (const [j] of partners[chosen]) if (x[j] !== null) { pen.moveTo(...at(x[chosen], y[chosen])); pen.lineTo(...at(x[j], y[j])); }
      pen.stroke();
    }
    const wanted = search.value.trim() ? new Set(order) : null;
    const dot = Math.max(1.5, Math.min(5, 60 / Math.sqrt(count || 1)));
    for (const i of placed) {
      const [left, top] = at(x[i], y[i]);
      pen.globalAlpha = !wanted || wanted.has(i) ? 1 : 0.15;
      if (status[i] === REGISTERED) {
        pen.fillStyle = "#ffffff"; pen.fillRect(left - dot - 1, top - dot - 1, 2 * dot + 2, 2 * dot + 2);
        pen.fillStyle = "#1450d2"; pen.fillRect(left - dot, top - dot, 2 * dot, 2 * dot);
      } else {
        pen.strokeStyle = "#c1121f"; pen.lineWidth = 2; pen.beginPath();
        pen.moveTo(left - 4, top - 4); pen.lineTo(left + 4, top + 4); pen.moveTo(left - 4, top + 4); pen.lineTo(left + 4, top - 4); pen.stroke();
      }
    }
    pen.globalAlpha = 1;
    if (chosen >= 0 && x[chosen] !== null) {
      pen.strokeStyle = "#d35400"; pen.lineWidth = 3; pen.beginPath();
      pen.arc(...at(x[chosen], y[chosen]), dot + 6, 0, 7); pen.stroke();
    }
    if (facts.metric) bar();
  }

  function bar() {
    const wide = 90 / scale, power = 10 ** Math.floor(Math.log10(wide));
    const length = [5, 2, 1].map((step) => step * power).find((step) => step <= wide) || power;
    const bottom = size[1] - 12;
    pen.fillStyle = "rgba(255,255,255,0.8)"; pen.fillRect(6, bottom - 18, length * scale + 12, 26);
    pen.strokeStyle = "#111"; pen.lineWidth = 1.5; pen.beginPath();
    pen.moveTo(12, bottom - 4); pen.lineTo(12, bottom); pen.lineTo(12 + length * scale, bottom); pen.lineTo(12 + length * scale, bottom - 4); pen.stroke();
    pen.fillStyle = "#111"; pen.font = "12px sans-serif"; pen.fillText(`${number.format(length)} m`, 14, bottom - 6);
  }

  function nearest(event) {
    const bounds = canvas.getBoundingClientRect();
    const here = [event.clientX - bounds.left, event.clientY - bounds.top];
    let best = -1, least = 14;
    for (const i of placed) {
      const [left, top] = at(x[i], y[i]);
      const away = Math.hypot(left - here[0], top - here[1]);
      if (away < least) { least = away; best = i; }
    }
    return best;
  }

  function zoom(factor) {
    const middle = [size[0] / 2, size[1] / 2];
    shift = shift.map((s, k) => middle[k] + (s - middle[k]) * factor);
    scale *= factor;
    paint();
  }

  let held = null;
  canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY, false]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) { const i = nearest(event); canvas.title = i < 0 ? "" : names[i]; return; }
    const move = [event.clientX - held[0], event.clientY - held[1]];
    if (!held[2] && Math.hypot(...move) < 4) return;
    held = [event.clientX, event.clientY, true];
    shift = [shift[0] + move[0], shift[1] + move[1]];
    paint();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (held && !held[2]) { const i = nearest(event); if (i >= 0) choose(i, true); }
    held = null;
  });
  canvas.addEventListener("pointercancel", () => { held = null; });
  byId("zoom-in").addEventListener("click", () => zoom(1.5));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
  byId("zoom-fit").addEventListener("click", () => { fit(); paint(); });
  document.querySelectorAll(".layers input").forEach((input) => input.addEventListener("change", paint));
  window.addEventListener("resize", () => { fit(); paint(); draw(false); });
  window.addEventListener("beforeprint", () => draw(true));
  window.addEventListener("afterprint", () => draw(false));

  fit();
  choose_order();
  paint();
})();
