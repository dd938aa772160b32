"""Damage what a user may hand in, and see that no command crashes over it.

    python tests/soak/fuzz.py databases 500 --seed 0

Each try changes one sound input (flipped, cut or overwritten bytes, impossible rows or values) and
gives it to a command or a function of the library, in a process of its own. Wanted is success or
one sentence; a traceback, a process that dies, more than 60 s or 2 GiB, or a changed database
where it is only read, counts as a fault and is printed with the number of its try, which
`--first NUMBER` with a count of 1 repeats. `--minutes` ends a run early; it says where to go on.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sqlite3
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kill
import numpy as np
from click.testing import CliRunner
from PIL import Image

from colmap_netvlad.cli import cli
from colmap_netvlad.runtime.errors import EXIT_PARTIAL, InputError

HANG_SECONDS = 60.0
MOST_BYTES = 2 * 2**30

Random = np.random.Generator


class Fault(Exception):
    """What must not happen; its text says what did."""


@dataclass(frozen=True)
class Base:
    """Sound inputs, made once.

    Attributes:
        folder: holds everything.
        images: photos of a small rendered flight.
        database: its features, every pair matched.
        cache: what `vlad` and the model left of it.
        model: a checkpoint with random weights.
    """

    folder: Path

    @property
    def images(self) -> Path:
        return self.folder / "images"

    @property
    def database(self) -> Path:
        return self.folder / "project.db"

    @property
    def cache(self) -> Path:
        return self.folder / "project.netvlad.db"

    @property
    def model(self) -> Path:
        return self.folder / "tiny.safetensors"

    @property
    def photos(self) -> list[Path]:
        return sorted(self.images.iterdir())

    @property
    def names(self) -> list[str]:
        return [photo.name for photo in self.photos]


def make_base(folder: Path) -> Base:
    """Render a flight of 8 photos, extract, match, and describe it."""
    base = Base(folder)
    _apart(lambda: _make_base(base), 600.0)
    return base


def _make_base(base: Base) -> str:
    import torch

    from colmap_netvlad.colmap.features import FeatureOptions, extract_features
    from colmap_netvlad.demo.render import FlightOptions, render_flight
    from colmap_netvlad.matching.run import MatchOptions, match_pairs
    from colmap_netvlad.models.aggregation import build_aggregation
    from colmap_netvlad.models.backbones import build_trunk
    from colmap_netvlad.models.checkpoint import save_checkpoint
    from colmap_netvlad.models.network import GlobalDescriptor

    options = FlightOptions(rows=2, columns=4, width=320, height=240, altitude=45.0)
    render_flight(base.folder / "flight", options)
    (base.folder / "flight" / "images").rename(base.images)
    extract_features(base.images, base.database, FeatureOptions(max_features=400))
    names = base.names
    match_pairs(
        base.database, [(a, b) for a in names for b in names if a < b], MatchOptions(processes=1)
    )
    torch.manual_seed(0)
    trunk = build_trunk("efficientnet-lite0-stage5")
    network = GlobalDescriptor(trunk, build_aggregation(trunk.channels, {"kind": "gem"}))
    save_checkpoint(base.model, network, {"name": "tiny", "long_side": 64, "rotations": 1})
    for method in (("--method", "vlad"), ("--model", base.model)):
        command("pairs", "--db", base.database, *method, "--k", 3)
    return "made"


# One try


def command(*words: object) -> str:
    """Run a command in this process; return how it ended.

    Raises:
        Fault: with a traceback, or without a sentence.
    """
    result = CliRunner().invoke(cli, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise Fault("".join(traceback.format_exception(result.exception)))
    if "Traceback" in result.output:
        raise Fault(result.output)
    if result.exit_code == 0:
        return "done"
    if result.exit_code == EXIT_PARTIAL:
        return "done in part"
    if result.exit_code in (1, 2) and "Error: " in result.stderr:
        return "refused"
    raise Fault(f"exit code {result.exit_code}: {result.output}")


def bytes_changed(random: Random, data: bytes) -> bytes:
    """Return data with bytes flipped, cut, overwritten, repeated or put in."""
    if not data:
        return random.bytes(50)
    at = int(random.integers(len(data)))
    some = int(random.integers(1, max(2, min(len(data), 4096))))
    changed = bytearray(data)
    match random.integers(6):
        case 0:
            for place in random.integers(len(data), size=random.integers(1, 30)):
                changed[place] ^= 1 << int(random.integers(8))
        case 1:
            del changed[at:]
        case 2:
            changed[at : at + some] = bytes(some)
        case 3:
            changed[at : at + some] = random.bytes(some)
        case 4:
            del changed[at : at + some]
        case _:
            changed[at:at] = random.bytes(some)
    return bytes(changed)


VALUES: tuple[Any, ...] = (
    None, -1, 0, 1, 7, 2**31, 2**62, -(2**62), 0.5, float("nan"), float("inf"), "", "text",
    "../../etc/passwd", "/etc/passwd", "a\0b", b"", b"\0", b"\xff" * 7, bytes(24), bytes(72),
    b"\xff" * 4096,
)  # fmt: skip
"""What a cell of a table may hold that it should not."""


def rows_changed(random: Random, database: Path) -> None:
    """Put impossible values into some cells of a COLMAP database, or take rows or tables away."""
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        tables = [name for (name,) in names if not name.startswith("sqlite_")]
        for _ in range(random.integers(1, 4)):
            table = tables[random.integers(len(tables))]
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
            column = columns[random.integers(len(columns))]
            some = f"rowid IN (SELECT rowid FROM {table} ORDER BY random() LIMIT 3)"
            value = VALUES[random.integers(len(VALUES))]
            change = {
                0: (f"DELETE FROM {table} WHERE {some}", ()),
                1: (f"DELETE FROM {table}", ()),
                2: (f"DROP TABLE {table}", ()),
                3: (f"ALTER TABLE {table} DROP COLUMN {column}", ()),
            }.get(
                int(random.integers(24)),
                (f"UPDATE OR IGNORE {table} SET {column} = ? WHERE {some}", (value,)),
            )
            try:
                connection.execute(*change)
            except sqlite3.Error:
                continue  # the table itself refuses it
            if change[0].startswith("DROP"):
                tables.remove(table)
        connection.commit()


def database(random: Random, base: Base, folder: Path) -> str:
    """A damaged database, through the commands that read it and those that work on a copy."""
    project = folder / "project.db"
    shutil.copy(base.database, project)
    if random.random() < 0.4:
        project.write_bytes(bytes_changed(random, project.read_bytes()))
    else:
        rows_changed(random, project)
    (folder / "images").symlink_to(base.images)
    pairs = [f"{a} {b}\n" for a in base.names for b in base.names if a < b]
    (folder / "pairs.txt").write_text("".join(pairs))
    before = project.read_bytes()
    words = [
        ("pairs", "--method", "vlad", "--k", 3),
        ("pairs", "--method", "vlad", "--k", 3, "--gps", "on"),
        ("pairs", "--method", "spatial", "--k", 3),
        ("viewgraph",),
        ("viewgraph",),
        ("match", "--copy"),
        ("reconstruct", "--copy", "--mapper", "incremental", "--threads", 1),
        ("reconstruct", "--copy", "--mapper", "parallel", "--threads", 1),
    ][random.integers(8)]
    ended = command(words[0], "--db", project, *words[1:])
    if project.read_bytes() != before:
        raise Fault(f"{words} changed the database")
    if list(folder.glob(".*")) and ended == "refused":
        left = [path.name for path in folder.glob(".*")]
        if [name for name in left if name != ".sparse.clusters"]:
            raise Fault(f"{words} left {left}")
    return f"{words[0]} {ended}"


def photo(random: Random, base: Base, folder: Path) -> str:
    """A damaged or unusual photo, decoded, and in every fifth try imported."""
    from colmap_netvlad.photos.decode import decode_photo
    from colmap_netvlad.photos.files import BadPhoto, file_stamp, photo_fingerprint, read_header
    from colmap_netvlad.photos.positions import read_gps

    images = folder / "images"
    images.mkdir()
    path = _odd_photo(random, base.photos[random.integers(8)], images)
    ended = Counter[str]()
    uses: tuple[Callable[[], object], ...] = (
        lambda: read_header(path),
        lambda: decode_photo(path, 64),
        lambda: decode_photo(path, 384),
        lambda: photo_fingerprint(path),
        lambda: file_stamp(path),
        lambda: read_gps(path),
    )
    for use in uses:
        try:
            use()
            ended["read"] += 1
        except BadPhoto:
            ended["refused"] += 1
    if random.integers(5) == 0:
        shutil.copy(base.photos[0], images / "sound.jpg")
        # SIFT itself takes 2 GiB of a sound photo of 13 megapixels.
        found = command("features", "--images", images, "--db", folder / "p.db", "--threads", 1,
                        "--max-image-size", 800)  # fmt: skip
        return f"features {found}"
    return "read" if not ended["refused"] else "refused"


def _odd_photo(random: Random, sound: Path, images: Path) -> Path:
    path = images / "odd.jpg"
    data = sound.read_bytes()
    kind = int(random.integers(12))
    if kind < 5:
        path.write_bytes(bytes_changed(random, data))
    elif kind == 5:  # huge dimensions in a small file
        start = data.find(b"\xff\xc0")
        size = struct.pack(">HH", *random.integers(1, 65536, size=2).tolist())
        path.write_bytes(data[: start + 5] + size + data[start + 9 :])
    elif kind == 6:  # the head only: EXIF, tables
        head = bytes_changed(random, data[:2000])
        path.write_bytes(head + data[2000:])
    else:
        with Image.open(sound) as opened:
            pixels = opened.convert("RGB")
        pixels = pixels.resize((96, 64))
        suffix = [".png", ".tif", ".webp", ".bmp", ".gif"][random.integers(5)]
        written = images / f"odd{suffix}"
        mode = ["RGB", "L", "P", "1", "RGBA", "CMYK", "I;16"][random.integers(7)]
        try:
            frames = [pixels.rotate(90 * turn) for turn in range(3)]
            if mode == "I;16":
                grey = np.asarray(pixels.convert("L")).astype(np.uint16) * 257
                Image.fromarray(grey).save(written)
            elif kind == 7 and suffix in (".png", ".tif", ".webp", ".gif"):  # animated
                pixels.save(written, save_all=True, append_images=frames)
            else:
                pixels.convert(mode).save(written)
        except (OSError, ValueError):  # no such mode in such a file
            pixels.save(written)
        changed = written.read_bytes()
        if kind < 10:
            changed = bytes_changed(random, changed)
        if suffix == ".png" and random.random() < 0.3:  # huge dimensions in a small file
            changed = changed[:16] + random.bytes(8) + changed[24:]
        path = images / f"odd{[suffix, '.jpg', '.png', '.tif'][random.integers(4)]}"
        written.unlink()
        path.write_bytes(changed)
    return path


def pairs_list(random: Random, base: Base, folder: Path) -> str:
    """A list of pairs as spreadsheets, editors and accidents leave it."""
    from colmap_netvlad.pairs.lists import read_pairs, write_pairs
    from colmap_netvlad.pairs.union import ImagePair

    names = [*base.names, "c d.jpg", "--help", "-k", 'a"b.jpg', "ü.jpg", "#x.jpg", "a,b.jpg"]
    suffix, format = [(".txt", "colmap"), (".csv", "csv"), (".json", "json")][random.integers(3)]
    path = folder / f"pairs{suffix}"
    rows = random.integers(len(names), size=(random.integers(0, 40), 2)).tolist()
    write_pairs(path, [ImagePair(names[i], names[j], 0.5, 1) for i, j in rows], format)
    data = path.read_bytes()
    for change in random.integers(9, size=random.integers(0, 4)):
        match int(change):
            case 0:
                data = b"\xef\xbb\xbf" + data
            case 1:
                data = data.replace(b"\n", b"\r\n")
            case 2:
                data = data.replace(b" ", b"\t").replace(b",", b"\t")
            case 3:
                data = data.decode("utf-8", "replace").encode("utf-16")
            case 4:
                data = data.replace(b",", b";")
            case 5:
                data = data + data
            case 6:
                data = data.replace(b" ", b'" "').replace(b"\n", b'"\n"')
            case _:
                data = bytes_changed(random, data)
    path.write_bytes(data)
    if random.integers(10) == 0:
        shutil.copy(base.database, folder / "project.db")
        return f"match {command('match', '--db', folder / 'project.db', '--pairs', path)}"
    try:
        read_pairs(path, names)
    except InputError:
        return "refused"
    return "read"


def cache(random: Random, base: Base, folder: Path) -> str:
    """A damaged cache beside a sound database."""
    shutil.copy(base.database, folder / "project.db")
    (folder / "images").symlink_to(base.images)
    kept = folder / "project.netvlad.db"
    with closing(sqlite3.connect(base.cache)) as source, closing(sqlite3.connect(kept)) as target:
        source.backup(target)
    if random.random() < 0.5:
        kept.write_bytes(bytes_changed(random, kept.read_bytes()))
    else:
        rows_changed(random, kept)
    before = (folder / "project.db").read_bytes()
    method = [("--method", "vlad"), ("--model", base.model)][random.integers(2)]
    ended = command("pairs", "--db", folder / "project.db", *method, "--k", 3)
    if (folder / "project.db").read_bytes() != before:
        raise Fault("pairs changed the database")
    return ended


def checkpoint(random: Random, base: Base, folder: Path) -> str:
    """A damaged checkpoint, or one whose card says what cannot be."""
    from colmap_netvlad.models.checkpoint import METADATA_KEY, load_model, read_metadata

    path = folder / "model.safetensors"
    data = base.model.read_bytes()
    if random.random() < 0.5:
        head = 3000 if random.random() < 0.7 else len(data)
        data = bytes_changed(random, data[:head]) + data[head:]
    else:
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + length])
        card = json.loads(header["__metadata__"][METADATA_KEY])
        values = [None, -1, 0, 1e9, 2**70, "", "text", [], {}, [1], {"kind": "gem"}, True]
        for _ in range(random.integers(1, 3)):
            key = sorted(card)[random.integers(len(card))]
            if random.random() < 0.2:
                del card[key]
            else:
                card[key] = values[random.integers(len(values))]
        header["__metadata__"][METADATA_KEY] = json.dumps(card)
        told = json.dumps(header).encode()
        data = struct.pack("<Q", len(told)) + told + data[8 + length :]
    path.write_bytes(data)
    if random.integers(10) == 0:
        shutil.copy(base.database, folder / "project.db")
        (folder / "images").symlink_to(base.images)
        ended = command("pairs", "--db", folder / "project.db", "--model", path, "--k", 3)
        return f"pairs {ended}"
    try:
        read_metadata(path)
        load_model(path)
    except InputError:
        return "refused"
    return "read"


RECIPE = """trunk = "efficientnet-lite0-stage5"
clusters = 4
width = 96
height = 64
epsilon = 10
epochs = 2
learning_rate = 1e-3
frozen = "block4"
"""


def recipe(random: Random, base: Base, folder: Path) -> str:
    """A recipe with other values, unknown settings or broken syntax."""
    from dataclasses import fields

    from colmap_netvlad.training.options import TrainOptions, read_recipe

    settings = [item.name for item in fields(TrainOptions)]
    values = ["-1", "0", "1e400", "nan", '"text"', "[1]", "{a = 1}", "true", "1979-05-27", "2"]
    lines = []
    for name in random.permutation(settings)[: random.integers(1, 5)]:
        kind = type(next(item.default for item in fields(TrainOptions) if item.name == name))
        like = {int: ["-1", "0", "2", str(2**70)], float: ["-1.0", "0.0", "1e400", "nan"]}
        chosen = values if random.random() < 0.3 else like.get(kind, ['"text"', '""', "true"])
        lines.append(f"{name} = {chosen[random.integers(len(chosen))]}")
    text = "\n".join(lines).encode() + b"\n"
    if random.random() < 0.4:
        text = bytes_changed(random, RECIPE.encode() if random.random() < 0.5 else text)
    (folder / "recipe.toml").write_bytes(text)
    try:
        TrainOptions(**read_recipe(folder / "recipe.toml"))
    except InputError:
        return "refused"
    return "read"


Try = Callable[[Random, Base, Path], str]

KINDS: dict[str, tuple[Try, int]] = {
    "databases": (database, 500),
    "photos": (photo, 500),
    "lists": (pairs_list, 300),
    "caches": (cache, 200),
    "checkpoints": (checkpoint, 200),
    "recipes": (recipe, 100),
}
"""What is damaged, and how often a full run does."""

SHORT = {"databases": 8, "photos": 20, "lists": 40, "caches": 4, "checkpoints": 8, "recipes": 20}


# Many tries


def fuzz(
    base: Base, kind: str, numbers: range, seed: int, until: float
) -> tuple[Counter[str], list[str]]:
    """Return how tries ended, and the faults among them with their numbers."""
    function, ended, faults = KINDS[kind][0], Counter[str](), list[str]()
    place = sorted(KINDS).index(kind)
    for number in numbers:
        if time.monotonic() > until:
            break
        folder = base.folder / f"{kind}-{number}"
        folder.mkdir()

        def attempt(folder: Path = folder, number: int = number) -> str:
            return function(np.random.default_rng([seed, place, number]), base, folder)

        try:
            ended[_apart(attempt, HANG_SECONDS)] += 1
        except Fault as fault:
            ended["FAULT"] += 1
            faults.append(f"{kind} {number} (--seed {seed}): {fault}")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return ended, faults


def _apart(attempt: Callable[[], str], seconds: float) -> str:
    """Run in a process of its own; return what it says.

    Raises:
        Fault: it failed, died, took too long or too much memory.
    """
    receiver, sender = os.pipe()
    process = os.fork()
    if process == 0:
        os.setpgid(0, 0)
        os.close(receiver)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        log = os.open(f"/tmp/fuzz-{os.getpid()}.log", os.O_CREAT | os.O_RDWR | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        try:
            told = {"ended": attempt()}
        except BaseException as fault:
            text = str(fault) if isinstance(fault, Fault) else traceback.format_exc()
            told = {"fault": text}
        with os.fdopen(sender, "w") as pipe:
            json.dump(told, pipe)
        os._exit(0)
    os.close(sender)
    log_file = Path(f"/tmp/fuzz-{process}.log")
    deadline = time.monotonic() + seconds
    try:
        with os.fdopen(receiver, "rb") as pipe:
            os.set_blocking(pipe.fileno(), False)
            text = b""
            while True:
                text += pipe.read() or b""
                done, status, usage = os.wait4(process, os.WNOHANG)
                if done:
                    text += pipe.read() or b""
                    break
                if time.monotonic() > deadline:
                    os.killpg(process, signal.SIGKILL)
                    os.wait4(process, 0)
                    raise Fault(f"took more than {seconds:.0f} s")
                time.sleep(0.005)
        if usage.ru_maxrss * 1024 > MOST_BYTES:
            raise Fault(f"took {usage.ru_maxrss / 2**20:.1f} GiB")
        if status or not text:
            log = log_file.read_text(errors="replace")[-1500:] if log_file.exists() else ""
            raise Fault(f"its process died (status {status}): {log}")
        told = json.loads(text)
        if "fault" in told:
            raise Fault(told["fault"])
        return str(told["ended"])
    finally:
        log_file.unlink(missing_ok=True)


def main() -> int:
    """Run a kind of tries and print how they ended; 1 where there were faults."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("kind", choices=[*KINDS, "short"], help="short: a few tries of each kind")
    parser.add_argument("count", type=int, nargs="?", help="how many tries [default: all]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="begin with the try of this number")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no try after")
    chosen = parser.parse_args()
    until = time.monotonic() + 60 * chosen.minutes
    if chosen.kind == "short":
        todo = {kind: range(count) for kind, count in SHORT.items()}
    else:
        count = chosen.count or KINDS[chosen.kind][1] - chosen.first
        todo = {chosen.kind: range(chosen.first, chosen.first + count)}
    failed = False
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        base = make_base(Path(folder))
        for kind, numbers in todo.items():
            ended, faults = fuzz(base, kind, numbers, chosen.seed, until)
            failed |= bool(faults)
            tries = ended.total()
            print(f"{kind}: {tries} tries, {len(faults)} with faults", dict(sorted(ended.items())))
            if tries < len(numbers):
                print(f"go on with --first {numbers.start + tries}")
            print(*faults, sep="\n\n", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    kill.load()
    sys.exit(main())
