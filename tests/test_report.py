"""The report: which figures are best, what is drawn, and that the page needs nothing beside it."""

from __future__ import annotations

import csv
import itertools
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from comparisons import made_up, with_method
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from colmap_netvlad.comparison.evidence import Plan
from colmap_netvlad.comparison.figures import retrieval_figures
from colmap_netvlad.comparison.finds import single_finds
from colmap_netvlad.comparison.result import MethodResult, ModelFigures, RetrievalFigures
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.report import plots
from colmap_netvlad.report.comparison import write_csv
from colmap_netvlad.report.examples import choose_examples, hardest_images
from colmap_netvlad.report.layout import align, lay_out
from colmap_netvlad.report.measures import MEASURES
from colmap_netvlad.report.moves import from_above, similarity
from colmap_netvlad.report.numbers import seconds
from colmap_netvlad.report.page import render_page
from colmap_netvlad.terminal import print_comparison


@pytest.fixture(scope="module")
def small():
    return made_up(60)


@pytest.fixture(scope="module")
def page(small) -> str:
    return render_page(*small)


class Outline(HTMLParser):
    """Collects what the tests ask about, and checks that tags are nested."""

    VOID = frozenset({"meta", "link", "img", "br", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.tags, self.ids = [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if "id" in dict(attributes):
            self.ids.append(dict(attributes)["id"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_refers_to_nothing_outside_itself(page):
    for attribute in re.findall(r'(?:src|href|srcset|action)="([^"]*)"', page):
        assert attribute.startswith(("data:", "#")), attribute[:80]
    assert "<script" not in page and "@import" not in page and "url(http" not in page


def test_page_is_well_formed_and_no_id_stands_twice(page):
    outline = Outline(page)
    assert len(outline.ids) == len(set(outline.ids))
    levels = [int(tag[1]) for tag, _ in outline.tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b - a <= 1 for a, b in itertools.pairwise(levels))


def test_page_can_be_used_without_seeing_it(page):
    tags = Outline(page).tags
    assert all(attributes.get("alt") for tag, attributes in tags if tag == "img")
    assert all("scope" in attributes for tag, attributes in tags if tag == "th")
    assert page.count("<caption>") == page.count("<table")
    assert 'lang="en"' in page and 'class="skip" href="#content"' in page
    assert page.count('<svg aria-hidden="true"') == page.count("<svg")


def test_names_are_escaped():
    names = tuple(f"<b>&{i}.jpg" for i in range(20))
    text = render_page(*made_up(20, names=names))
    assert "<b>&" not in text
    assert "&lt;b&gt;&amp;0.jpg" in text


def test_page_of_five_thousand_images_stays_small_and_is_capped():
    text = render_page(*made_up(5000, (10, 30)))
    assert len(text) < 15e6
    assert text.count("<img") + text.count("no photo") < 400
    Outline(text)


def test_page_is_the_same_twice(small, page):
    assert render_page(*small) == page


def test_page_without_truth_models_or_positions_says_so(small):
    comparison, evidence = small
    nowhere = np.full((len(evidence.names), 3), np.nan)
    bare = replace(
        evidence, truth=set(), verified=dict.fromkeys(evidence.verified, 0), plans={},
        positions=nowhere,
    )  # fmt: skip
    methods = tuple(
        replace(m, model=None, at_k=tuple(replace(f, correct=0, recall=None) for f in m.at_k))
        for m in comparison.methods
    )
    text = render_page(replace(comparison, methods=methods), bare)
    assert "There is no correct pair" in text
    assert 'id="models"' not in text
    assert "could not be placed" in text


def test_page_with_one_k_and_one_failed_method(small):
    comparison, evidence = made_up(30, (5,))
    comparison = with_method(comparison, MethodResult("netvlad", "s", failed="no weights <here>"))
    text = render_page(comparison, evidence)
    assert 'id="curves"' not in text
    assert "no weights &lt;here&gt;" in text and "Not everything finished" in text


def test_page_says_where_a_view_graph_splits():
    comparison, evidence = made_up(30, (5,))
    assert "Nowhere: no single image" in render_page(comparison, evidence)
    chain = {as_pair(a, b) for a, b in itertools.pairwise(evidence.names)}
    evidence = replace(
        evidence,
        pairs={**evidence.pairs, "vlad": chain},
        verified=dict.fromkeys(chain | evidence.truth, 100),
        truth=chain | evidence.truth,
    )
    figures = retrieval_figures(chain, 5, evidence)
    assert (figures.bridges, figures.articulation_images, figures.components) == (29, 28, 1)
    methods = tuple(
        replace(m, at_k=(figures,)) if m.name == "vlad" else m for m in comparison.methods
    )
    text = render_page(replace(comparison, methods=methods), evidence)
    assert "28 images: " in text and "29 connections: " in text
    assert "DJI_0000.JPG – DJI_0001.JPG" in text


# Best of a row


def method(name: str, correct: int | None, error: float | None = None) -> MethodResult:
    at_k = () if correct is None else (RetrievalFigures(5, 100, correct, None, None, 1, 9, 0, 0),)
    model = ModelFigures(5, 1, 9, 10, 20, error, 2.0, 1.0)
    return MethodResult(name, "", at_k=at_k, model=model)


def best(key: str, *methods: MethodResult) -> set[str]:
    return next(m for m in MEASURES if m.key == key).best(methods)


def test_best_is_the_highest_or_the_lowest_as_the_measure_has_it():
    methods = method("a", 10, 0.9), method("b", 12, 0.5), method("c", 12, 0.7)
    assert best("correct", *methods) == {"b", "c"}
    assert best("mean_reprojection_error", *methods) == {"b"}
    assert best("pairs", *methods) == set()


def test_reference_and_floor_are_not_best():
    assert best("correct", method("a", 10), method("b", 9), method("exhaustive", 66)) == {"a"}
    assert best("correct", method("a", 10), method("b", 9), method("random", 50)) == {"a"}


def test_equal_or_lonely_figures_are_not_best():
    assert best("correct", method("a", 10), method("b", 10)) == set()
    assert best("correct", method("a", 10), method("b", None)) == set()


def test_figures_that_read_equal_are_equally_best():
    methods = method("a", 1, 0.50004), method("b", 1, 0.50001), method("c", 1, 0.7)
    assert best("mean_reprojection_error", *methods) == {"a", "b"}


@given(st.floats(0, 1e6))
def test_durations_are_short_and_carry_a_unit(value):
    text = seconds(value)
    assert len(text) <= 9 and text.split()[-1] in ("s", "min", "h")


def test_terminal_table_is_whole_on_a_narrow_terminal(small, tmp_path):
    out = tmp_path / "out.txt"
    with out.open("w") as file:
        print_comparison(small[0], Console(file=file, width=30))
    text = out.read_text()
    assert all(m.name in text for m in small[0].methods)
    assert "Mean reprojection error" in text and "*" in text


def test_csv_has_a_row_for_each_method_and_k(small, tmp_path):
    failed = MethodResult("netvlad", "", failed="no weights")
    write_csv(tmp_path / "compare.csv", with_method(small[0], failed))
    rows = list(csv.DictReader((tmp_path / "compare.csv").open()))
    assert [(r["method"], r["k"]) for r in rows[:2]] == [("netvlad-o", "5"), ("netvlad-o", "10")]
    assert len(rows) == 3 * 2 + 1
    assert rows[1]["registered"] == "60" and rows[0]["registered"] == ""
    assert rows[-1]["failed"] == "no weights"


# What is shown


def test_queries_differ_between_methods_and_are_not_partners(small):
    _, evidence = small
    examples = choose_examples(evidence)
    assert len(examples) == 3
    queries = [example.query for example in examples]
    assert not any(as_pair(a, b) in evidence.truth for a in queries for b in queries if a != b)
    for example in examples:
        counts = [sum(p.correct for p in partners) for _, partners in example.rows]
        assert max(counts) > min(counts)
    assert choose_examples(evidence) == examples


def test_wrong_partners_are_those_with_fifteen_matches_or_fewer(small):
    _, evidence = small
    for example in choose_examples(evidence):
        for _, partners in example.rows:
            for partner in partners:
                pair = as_pair(example.query, partner.name)
                assert partner.correct == (evidence.verified.get(pair, 0) > 15)


def test_single_finds_are_in_one_method_only(small):
    _, evidence = small
    for name, finds in single_finds(evidence).items():
        others = set().union(*(p for other, p in evidence.pairs.items() if other != name))
        assert all(find.pair not in others and find.matches > 15 for find in finds)
        assert [f.matches for f in finds] == sorted((f.matches for f in finds), reverse=True)


def test_hardest_images_come_first_and_say_who_registered_them(small):
    _, evidence = small
    hard = hardest_images(evidence, 5)
    assert [image.partners for image in hard] == sorted(image.partners for image in hard)
    last = hardest_images(evidence, 60)
    missing = next(image for image in last if image.name == evidence.names[-1])
    assert {m: r for m, _, r in missing.found} == {
        "netvlad-o": True, "bow": False, "vlad": False,
    }  # fmt: skip


# The ground plan


@settings(deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 100))
def test_similarity_finds_the_transform_it_was_given(seed, scale):
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(6, 3)) * (10, 7, 3)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    target = scale * source @ turn.T + (5, 6, 7)
    found = similarity(source, target)
    assert found is not None
    assert np.allclose(found(source), target, atol=1e-6 * scale * 10)


def test_points_on_a_line_fix_no_similarity():
    line = np.arange(5.0)[:, None] * (1.0, 2.0, 3.0)
    assert similarity(line, line) is None
    assert similarity(line[:2], line[:2]) is None


def test_the_ground_lies_in_the_page_with_the_cameras_above_and_not_mirrored():
    generator = np.random.default_rng(3)
    ground = np.column_stack([generator.uniform(0, 100, (500, 2)), generator.normal(0, 1, 500)])
    cameras = np.column_stack([generator.uniform(0, 100, (20, 2)), np.full(20, 30.0)])
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    plan = Plan(
        tuple("abcdefghijklmnopqrst"), cameras @ turn.T, ground @ turn.T, np.zeros((500, 3))
    )
    move = from_above(plan.centres, plan.points)
    seen_cameras, seen_ground = move(plan.centres), move(plan.points)
    assert seen_cameras[:, 2].min() > seen_ground[:, 2].max()
    assert np.ptp(seen_ground[:, 2]) < 12
    back = similarity(seen_cameras, cameras)
    assert back is not None and np.allclose(back(seen_cameras), cameras)


def test_models_are_laid_over_gps_and_over_each_other(small):
    _, evidence = small
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = {
        name: Plan(
            plan.names, 0.1 * plan.centres @ turn.T, 0.1 * plan.points @ turn.T, plan.colours
        )
        for name, plan in evidence.plans.items()
    }
    layout = lay_out(replace(evidence, plans=turned))
    assert layout.metric and layout.placed.all()
    assert np.linalg.norm(layout.xyz - evidence.positions, axis=1).mean() < 3
    vlad = align(turned["vlad"], layout)
    assert np.allclose(vlad.centres, layout.xyz[: len(vlad.names)], atol=1e-6)


def test_images_of_unknown_place_stand_between_their_partners(small):
    _, evidence = small
    nowhere = np.full((len(evidence.names), 3), np.nan)
    layout = lay_out(replace(evidence, positions=nowhere, plans={"vlad": evidence.plans["vlad"]}))
    assert layout.estimated == evidence.names[-2:]
    assert not layout.metric and layout.placed.all()


def test_without_model_and_gps_the_view_graph_gives_the_places(small):
    _, evidence = small
    nowhere = np.full((len(evidence.names), 3), np.nan)
    layout = lay_out(replace(evidence, positions=nowhere, plans={}))
    assert "spectral" in layout.source and layout.placed.all()


# Times of methods that do less


def timed(name: str, registered: int, seconds: float) -> MethodResult:
    figures = RetrievalFigures(5, 100, 90, 0.9, None, 1, 9, 0, 0)
    model = ModelFigures(
        5, 2, registered, 10, 20, 0.5, 2.0, registered + 7, 1.0, seconds_match=seconds
    )
    return MethodResult(
        name, "", seconds_describe=1.0, seconds_search=1.0, seconds_match=seconds,
        at_k=(figures,), model=model,
    )  # fmt: skip


def test_least_time_is_said_only_of_methods_whose_model_is_as_complete(small):
    hasty, slow, slower = timed("vlad", 42, 10.0), timed("a", 79, 60.0), timed("b", 79, 90.0)
    assert best("seconds_total", hasty, slow, slower) == {"a"}
    assert best("seconds_match", hasty, slow) == set()
    assert best("seconds_total", hasty, timed("a", 42, 60.0)) == {"vlad"}
    comparison = replace(small[0], methods=(hasty, slow, slower), images=123)
    evidence = replace(
        small[1],
        pairs={"vlad": set(), "a": set(), "b": set()},
        partners=dict.fromkeys(("vlad", "a", "b"), small[1].partners["vlad"]),
        plans={},
    )
    text = render_page(comparison, evidence)
    assert "Least time in all: a (" in text and ", of those with the fullest models)" in text


def test_total_time_and_model_are_of_the_k_the_models_were_made_from(small, tmp_path):
    method = timed("vlad", 60, 10.0)
    at_10 = replace(method.at_k[0], k=10)
    method = replace(method, at_k=(*method.at_k, at_10), seconds_match=100.0)
    value = {m.key: m.value(method) for m in MEASURES}
    assert value["seconds_match"] == 100
    assert value["seconds_total"] == 1 + 1 + 10 + 1 == sum(plots._stages(method))
    evidence = replace(
        small[1], pairs={"vlad": set()}, partners={"vlad": small[1].partners["vlad"]}, plans={}
    )
    comparison = replace(small[0], methods=(method,))
    page = render_page(comparison, evidence)
    assert "All figures at k = 10, mapping, total time and model at k = 5." in page
    assert "Where the time goes, at k = 5" in page
    assert "model at k" not in render_page(*small)
    write_csv(tmp_path / "compare.csv", comparison)
    at_5, at_10 = csv.DictReader((tmp_path / "compare.csv").open())
    assert (at_5["seconds_total"], at_5["registered"], at_5["seconds_match"]) == ("13", "60", "")
    assert (at_10["seconds_total"], at_10["registered"], at_10["seconds_match"]) == ("", "", "100")


def test_photos_of_all_models_are_counted_beside_the_largest():
    shown = {m.key: m.show(timed("a", 42, 1.0)) for m in MEASURES}
    assert (shown["registered"], shown["in_any_model"]) == ("42", "49")
    earlier = MethodResult("a", "", model=ModelFigures(5, 1, 42))
    assert next(m for m in MEASURES if m.key == "in_any_model").show(earlier) == "–"


def test_sentences_of_the_view_graphs_are_kept_apart(small):
    comparison, evidence = small
    positions = evidence.positions.copy()
    positions[5:] = np.nan
    joined = {as_pair(evidence.names[0], evidence.names[5])}
    evidence = replace(evidence, truth=joined, plans={}, positions=positions)
    text = render_page(comparison, evidence)
    assert "verified partners. 54 images could not be placed." in text
