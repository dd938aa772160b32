"""`compare` on the rendered flight: fair, resumable, and clear about what fails."""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.cli import cli
from colmap_netvlad.commands import compare as pipeline
from colmap_netvlad.commands.compare import CompareOptions
from colmap_netvlad.comparison import models, pool
from colmap_netvlad.comparison.result import Comparison, read_json, write_json
from colmap_netvlad.comparison.workspace import Workspace, file_name, open_workspace
from colmap_netvlad.flight import open_flight
from colmap_netvlad.graph.verified import correct_pairs, verified_by_name
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank
from colmap_netvlad.runtime.errors import EXIT_PARTIAL, InputError


def compare(*arguments, **options) -> tuple[Comparison, Workspace]:
    """Compare, and return the figures and the comparison's folder."""
    report = pipeline.compare(*arguments, **options)
    return report.comparison, Workspace(report.page.parent)


METHODS = ("vlad", "random")
# One thread: COLMAP adds in the order its threads finish, so only that repeats the last digits.
OPTIONS = CompareOptions(k=(2, 4), mapping=MappingOptions(threads=1))
FAST = replace(OPTIONS, reconstruct=False)

Make = Callable[..., Project]


def timeless(comparison: Comparison) -> Comparison:
    """Return the comparison without times, and without the notes that speak of caches."""
    return replace(
        comparison,
        seconds_matched=0.0,
        methods=tuple(
            replace(
                method,
                notes=(),
                seconds_describe=None,
                seconds_search=None,
                seconds_match=None,
                timed_earlier=False,
                match_measured=1.0,
                model=method.model and replace(method.model, seconds=0.0, seconds_match=None),
            )
            for method in comparison.methods
        ),
    )


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def whole(flight_database: Path, flight, tmp_path_factory) -> tuple[Comparison, Path, str]:
    """A comparison of three methods with models; its folder, and the database's hash before."""
    folder = tmp_path_factory.mktemp("whole")
    shutil.copy(flight_database, folder / "project.db")
    before = sha256(folder / "project.db")
    project = Project(folder / "project.db", flight.images)
    comparison, _ = compare(project, ("exhaustive", *METHODS), OPTIONS)
    return comparison, folder, before


@pytest.fixture(scope="module")
def unbroken(flight_database: Path, flight, tmp_path_factory) -> Comparison:
    """A comparison without models that nothing interrupted."""
    database = tmp_path_factory.mktemp("unbroken") / "project.db"
    shutil.copy(flight_database, database)
    return timeless(compare(Project(database, flight.images), METHODS, FAST)[0])


def test_the_database_of_the_user_stays_byte_identical(whole):
    _, folder, before = whole
    assert sha256(folder / "project.db") == before


def test_all_methods_are_compared_and_written(whole):
    comparison, folder, _ = whole
    output = folder / "project-compare"
    assert read_json(output / "compare.json") == comparison
    assert len((output / "compare.csv").read_text().splitlines()) == 1 + 3 * 2
    assert "<h2" in (output / "compare.html").read_text()
    assert comparison.reference == "exhaustive"
    assert comparison.precision_depth == comparison.images - 1
    assert not comparison.incomplete


def test_figures_follow_from_the_matches(whole):
    comparison, folder, _ = whole
    verified = verified_by_name(folder / "project-compare" / "work" / "union.db")
    truth = correct_pairs(verified)
    exhaustive, vlad, chance = comparison.methods
    assert len(verified) == comparison.pairs_matched == exhaustive.best_k.pairs == 12 * 11 // 2
    assert exhaustive.best_k.recall == 1.0
    assert exhaustive.best_k.correct == comparison.reference_pairs == len(truth)
    assert exhaustive.mean_average_precision is None
    assert vlad.best_k.accuracy == vlad.best_k.correct / vlad.best_k.pairs
    assert vlad.mean_average_precision > chance.mean_average_precision
    assert vlad.at_k[0].recall < vlad.at_k[1].recall


def test_each_distinct_pair_is_matched_once(whole):
    comparison, folder, _ = whole
    with closing(sqlite3.connect(folder / "project-compare" / "work" / "seconds.db")) as ledger:
        timed = ledger.execute("SELECT COUNT(*), SUM(seconds) FROM pairs").fetchone()
    assert timed[0] == comparison.pairs_matched < comparison.pairs_requested
    assert comparison.methods[0].seconds_match == pytest.approx(timed[1])


def test_figures_equal_those_of_a_method_run_alone(no_page, whole, project_copy: Make):
    together = next(m for m in timeless(whole[0]).methods if m.name == "vlad")
    alone = timeless(compare(project_copy(), ["vlad"], OPTIONS)[0]).methods[0]
    # Recall, precision and single finds depend on the reference, not on the method alone.
    for a, b in zip(together.at_k, alone.at_k, strict=True):
        assert replace(a, recall=None) == replace(b, recall=None)
    assert alone.model == together.model
    assert together.model.registered > 2


def test_models_made_earlier_are_shown_without_reconstruct(no_page, whole, project_copy: Make):
    _, folder, _ = whole
    project = project_copy()
    shutil.copytree(folder / "project-compare", project.folder / "project-compare")
    comparison, _ = compare(project, ["spatial"], FAST)
    assert all(m.model for m in comparison.methods[:3])
    assert comparison.methods[3].model is None


def test_a_comparison_in_which_every_method_fails_is_still_written(project_copy: Make, monkeypatch):
    def fails(*args):
        raise InputError("Nothing works.")

    monkeypatch.setattr(pipeline, "rank", fails)
    comparison, workspace = compare(project_copy(), METHODS, OPTIONS)
    assert comparison.incomplete == ["vlad: Nothing works.", "random: Nothing works."]
    assert "Nothing works." in workspace.html.read_text()


@pytest.fixture
def no_page(monkeypatch) -> None:
    """Leave the page out where a test is not about it: it is most of a small comparison's time."""
    monkeypatch.setattr("colmap_netvlad.report.page.render_page", lambda *args: "")


class Killed(BaseException):
    """Stands for a kill: nothing catches it."""


def kill_on_call(monkeypatch, module, name: str, call: int, after: bool = False) -> None:
    whole_function, calls = getattr(module, name), []

    def killed(*args, **kwargs):
        calls.append(name)
        if len(calls) == call and not after:
            raise Killed
        result = whole_function(*args, **kwargs)
        if len(calls) == call:
            raise Killed
        return result

    monkeypatch.setattr(module, name, killed)


@pytest.mark.parametrize(
    ("module", "name", "call", "after"),
    [
        (pipeline, "open_workspace", 1, True),
        (pipeline, "rank", 2, False),
        (pool, "match_pairs", 2, True),
        (pipeline, "write_report", 1, False),
    ],
)
def test_a_killed_run_goes_on_to_the_same_figures(
    no_page, unbroken, project_copy: Make, monkeypatch, module, name, call, after
):
    project = project_copy(name="killed")
    with monkeypatch.context() as patch:
        kill_on_call(patch, module, name, call, after)
        with pytest.raises(Killed):
            compare(project, METHODS, FAST)
    again, _ = compare(project, METHODS, FAST)
    assert timeless(again) == unbroken
    if module is pool:
        assert any(method.match_measured < 1 for method in again.methods)


def test_a_run_killed_while_mapping_keeps_the_models_it_has(
    no_page, whole, project_copy: Make, monkeypatch
):
    _, folder, _ = whole
    copy = project_copy(name="mapping")
    output = copy.folder / "project-compare"
    shutil.copytree(folder / "project-compare", output)
    (output / "work" / "models" / "random" / "figures.json").unlink()
    mapped = []
    kept = models.map_incremental
    monkeypatch.setattr(
        models, "map_incremental", lambda *args: (mapped.append(args), kept(*args))[1]
    )
    again, _ = compare(copy, ("exhaustive", *METHODS), OPTIONS)
    assert len(mapped) == 1
    assert timeless(again) == timeless(whole[0])


def test_methods_are_added_though_the_photos_are_elsewhere_by_now(
    no_page, project_copy: Make, tiny_checkpoint
):
    project = project_copy(copy_photos=True)
    first, _ = compare(project, [str(tiny_checkpoint)], FAST)
    project.need_images().rename(project.folder / "elsewhere")
    later, _ = compare(project, ["random"], FAST)
    before, after = (comparison.methods[0] for comparison in (first, later))
    assert [figures.pairs for figures in after.at_k] == [f.pairs for f in before.at_k]
    assert not later.incomplete
    assert "the photos are not at hand: as ranked before" in after.notes


def test_methods_are_added_to_an_earlier_comparison(no_page, project_copy: Make, monkeypatch):
    project = project_copy()
    compare(project, ["vlad"], FAST)
    ranked = []
    kept = pipeline.rank
    monkeypatch.setattr(
        pipeline, "rank", lambda p, name, o: (ranked.append(name), kept(p, name, o))[1]
    )
    comparison, _ = compare(project, ["random"], FAST)
    assert [m.name for m in comparison.methods] == ["vlad", "random"]
    assert ranked == ["random"]
    assert all(m.model is None for m in comparison.methods)
    assert comparison.reference == "union"
    assert comparison.precision_depth == 4


@pytest.fixture
def ranked(monkeypatch) -> list[tuple[str, RetrievalOptions]]:
    """What is ranked, and by which options; all of it by chance and unmatched, which is quick."""
    calls: list[tuple[str, RetrievalOptions]] = []

    def by_chance(flight, name, options):
        calls.append((name, options))
        return rank(flight, "random", RetrievalOptions(k=options.k))

    monkeypatch.setattr(pipeline, "rank", by_chance)
    monkeypatch.setattr(pool, "match_once", lambda *args: 0)
    return calls


def retrieving(**options) -> CompareOptions:
    return replace(FAST, retrieval=RetrievalOptions(**options))


def test_a_model_concerns_only_the_methods_that_take_one(
    no_page, project_copy: Make, tiny_checkpoint: Path, ranked
):
    project, methods = project_copy(), ["vlad", "hybrid", "netvlad-o-lite", str(tiny_checkpoint)]
    for _ in range(2):
        assert not compare(project, methods, retrieving(model=tiny_checkpoint))[0].incomplete
        models = {name: options.model for name, options in ranked}
        assert models == {name: tiny_checkpoint if name == "hybrid" else None for name in methods}
        assert len(ranked) == 4  # once
    compare(project, methods, FAST)
    assert [(name, options.model) for name, options in ranked[4:]] == [("hybrid", None)]


def test_a_model_that_no_method_takes_is_refused(project_copy: Make, tiny_checkpoint: Path):
    project = project_copy()
    with pytest.raises(InputError, match=r"none of vlad, random takes one; .*`methods`"):
        compare(project, METHODS, retrieving(model=tiny_checkpoint))
    assert not (project.folder / "project-compare").exists()


def test_a_changed_option_ranks_again(no_page, project_copy: Make, ranked):
    project, methods = project_copy(), ["netvlad-o-lite", "vlad"]
    changes = [retrieving(gps="off"), retrieving(gps="require"), retrieving(exact=True)]
    changes = [FAST, *changes, replace(FAST, seed=1)]
    for options in (*changes, *changes, retrieving(device="cpu", batch_size=1)):
        compare(project, methods, options)
    assert len(ranked) == len(changes) * len(methods)
    compare(project, methods, retrieving(rerank=5))
    assert [name for name, _ in ranked[10:]] == ["netvlad-o-lite"]  # vlad compares nothing


def test_what_a_ranking_is_made_from_is_looked_at_again(no_page, project_copy: Make, ranked):
    project = project_copy(copy_photos=True)
    methods = [str(project.folder / "theirs.h5"), "vlad"]
    masks = project.folder / "masks"
    masks.mkdir()
    photo = sorted(project.images.iterdir())[0]

    def write(path: Path, content: bytes) -> None:
        path.write_bytes(content)

    def lose_a_position() -> None:
        with closing(sqlite3.connect(project.database)) as connection, connection:
            connection.execute("DELETE FROM pose_priors WHERE corr_data_id = 1")

    steps = [
        (lambda: write(project.folder / "theirs.h5", b"some"), 2),
        (lambda: None, 0),
        (lambda: write(project.folder / "theirs.h5", b"other"), 1),
        (lambda: write(masks / f"{photo.name}.png", b"a mask"), 1),
        (lambda: write(photo, photo.read_bytes() + b"more"), 1),
        (lose_a_position, 2),
    ]
    for change, again in steps:
        change()
        before = len(ranked)
        compare(project, methods, retrieving(masks=masks))
        assert len(ranked) - before == again


def test_a_failing_method_is_reported_and_the_others_finish(project_copy: Make, monkeypatch):
    project = project_copy()
    kept = pipeline.rank

    def fails(project, name, options):
        if name == "random":
            raise RuntimeError("out of luck\nat line 3")
        return kept(project, name, options)

    monkeypatch.setattr(pipeline, "rank", fails)
    command = ["compare", "--db", str(project.database), "--methods", "random,vlad", "--k", "3"]
    result = CliRunner().invoke(cli, [*command, "--no-reconstruct"])
    assert result.exit_code == EXIT_PARTIAL, result.output
    assert "random: RuntimeError: out of luck" in result.output
    comparison = read_json(project.folder / "project-compare" / "compare.json")
    assert comparison.methods[0].failed and comparison.methods[1].best_k.pairs > 0
    page = (project.folder / "project-compare" / "compare.html").read_text()
    assert "RuntimeError: out of luck" in page


def test_missing_weights_leave_the_other_methods(
    no_page, project_copy: Make, monkeypatch, tmp_path
):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nothing"))
    comparison, _ = compare(project_copy(), ["netvlad", "vlad"], FAST)
    assert "download" in comparison.methods[0].failed
    assert comparison.methods[1].failed is None


def test_without_photos_methods_of_features_still_run(project_copy: Make, monkeypatch, tmp_path):
    project = project_copy()
    shutil.rmtree(project.images)
    nowhere = Project(project.database, None)
    comparison, workspace = compare(nowhere, ["netvlad-o", "vlad"], FAST)
    assert comparison.methods[0].failed
    assert comparison.methods[1].best_k.correct > 0
    assert "no photo" in workspace.html.read_text()


def test_failing_mapping_is_reported_and_tried_again(project_copy: Make, monkeypatch):
    project = project_copy()

    def fails(*args):
        raise RuntimeError("bundle adjustment gave up")

    with monkeypatch.context() as patch:
        patch.setattr(models, "map_incremental", fails)
        comparison, _ = compare(project, ["vlad"], OPTIONS)
    assert comparison.incomplete == [
        "vlad: mapping failed: RuntimeError: bundle adjustment gave up"
    ]
    monkeypatch.setattr(models, "map_incremental", lambda *args: [])
    comparison, workspace = compare(project, ["vlad"], OPTIONS)
    assert comparison.incomplete == []
    assert comparison.methods[0].model.registered == 0
    assert "no image could be registered" in workspace.html.read_text()


def test_a_model_is_charged_the_matching_of_its_own_pairs(no_page, project_copy: Make, monkeypatch):
    monkeypatch.setattr(models, "map_incremental", lambda *args: [])
    comparison, workspace = compare(project_copy(), ["random"], replace(OPTIONS, reconstruct_k=2))
    method, seconds = comparison.methods[0], workspace.pair_seconds()
    assert method.model.k == comparison.model_k == 2
    assert method.at_k[0].pairs < method.at_k[1].pairs == len(seconds)
    assert method.seconds_match == pytest.approx(sum(seconds.values()))
    share = method.at_k[0].pairs / method.at_k[1].pairs  # matched together, all take the same
    assert method.model.seconds_match == pytest.approx(share * method.seconds_match)


def test_a_long_exhaustive_matching_is_asked_about(no_page, project_copy: Make, monkeypatch):
    project = project_copy()
    monkeypatch.setattr(pipeline, "ASK_ABOVE", 0.0)
    asked = []
    with pytest.raises(InputError, match=r"about .* min .*`confirm`"):
        compare(project, ["exhaustive"], FAST, lambda question: bool(asked.append(question)))
    assert "42 pairs" in asked[0] or "66 pairs" in asked[0]
    comparison, _ = compare(project, ["exhaustive"], FAST, lambda question: True)
    assert comparison.methods[0].best_k.pairs == 66


def test_pairs_of_the_cost_sample_are_not_in_the_union(no_page, unbroken, project_copy: Make):
    project = project_copy(name="sampled")
    with open_flight(project) as flight:
        workspace = open_workspace(project.folder / "project-compare", flight)
        pool.measure_cost(workspace, flight.names, FAST.matching)
    assert timeless(compare(project, METHODS, FAST)[0]) == unbroken


def test_a_folder_of_another_project_is_refused(no_page, project_copy: Make):
    one, other = project_copy(name="one"), project_copy(name="other")
    compare(one, ["random"], FAST)
    with closing(sqlite3.connect(other.database)) as connection, connection:
        connection.execute("UPDATE images SET name = 'renamed.jpg' WHERE image_id = 1")
    with pytest.raises(InputError, match="another project"):
        compare(other, ["random"], replace(FAST, output=one.folder / "project-compare"))


GUIDED = replace(FAST, matching=MatchOptions("guided"))


def test_one_comparison_has_one_matcher_and_says_which(project_copy: Make):
    project = project_copy()
    comparison, workspace = compare(project, ["vlad"], GUIDED)
    assert comparison.matcher == read_json(workspace.json).matcher == "guided"
    assert "matched by the matcher guided" in workspace.html.read_text()
    assert compare(project, ["random"], FAST)[0].matcher == "guided"  # none named: the folder's
    for other in (MatchOptions("colmap"), MatchOptions("guided", thorough=True)):
        with pytest.raises(InputError, match=r"matched by guided, not by .*`output`"):
            compare(project, ["vlad"], replace(FAST, matching=other))


def test_the_truth_is_colmaps(project_copy: Make, monkeypatch):
    project = project_copy()
    with pytest.raises(InputError, match="exhaustive is the truth"):
        compare(project, ["vlad", "exhaustive"], GUIDED)
    compare(project, ["vlad"], GUIDED)
    with pytest.raises(InputError, match="exhaustive is the truth"):
        compare(project, ["exhaustive"], FAST)
    monkeypatch.setattr(pipeline, "MATCHER_DEFAULT", "guided")
    assert compare(project_copy(name="truth"), ["exhaustive"], FAST)[0].matcher == "colmap"
    assert compare(project_copy(name="other"), ["random"], FAST)[0].matcher == "guided"


def test_a_comparison_made_before_there_were_matchers_is_colmaps(project_copy: Make):
    project = project_copy()
    _, workspace = compare(project, ["random"], FAST)
    content = json.loads(workspace.project.read_text())
    del content["matcher"]
    workspace.project.write_text(json.dumps(content))
    with pytest.raises(InputError, match="matched by colmap, not by guided"):
        compare(project, ["random"], GUIDED)


def test_few_pairs_are_charged_as_if_they_were_among_many(project_copy: Make, monkeypatch):
    """Three processors, one of which matches: a pair takes a third of what that one needed."""
    project = project_copy()
    with open_flight(project) as flight:
        workspace = open_workspace(project.folder / "compare", flight)
    pairs = list(itertools.combinations(flight.names, 2))[:7]
    reports = []

    def matched(*arguments):
        reports.append(match_pairs(*arguments))
        return reports[-1]

    monkeypatch.setattr(pool, "match_pairs", matched)
    monkeypatch.setattr(pool, "CHUNK", 1)
    pool.match_once(workspace, {"one": pairs}, MatchOptions(processes=3))
    assert [report.matched for report in reports] == [3, 3, 1]
    for report in reports:
        assert report.even_seconds == pytest.approx(report.seconds / 3, rel=0.3)
    total = sum(report.even_seconds for report in reports)
    assert sum(workspace.pair_seconds().values()) == pytest.approx(total)


def test_a_folder_with_other_things_is_left_alone(project_copy: Make, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.txt").write_text("mine")
    with pytest.raises(InputError, match="no comparison's folder"):
        compare(project_copy(), ["random"], replace(FAST, output=tmp_path / "thesis"))
    assert [p.name for p in (tmp_path / "thesis").iterdir()] == ["chapter1.txt"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "vald"], "did you mean vlad?"),
        (["--methods", " , "], "No method to compare"),
        (["--methods", "vlad", "--k", "ten"], "whole number"),
        (["--methods", "vlad", "--k", "0"], "--k is 0"),
        (["--methods", "vlad", "--k", ","], "no number of partners"),
        (["--methods", "vlad", "--k", "2,4", "--reconstruct-k", "3"], "--reconstruct-k is 3"),
    ],
)
def test_bad_arguments_are_one_sentence(project_copy: Make, arguments, message):
    project = project_copy()
    result = CliRunner().invoke(cli, ["compare", "--db", str(project.database), *arguments])
    assert result.exit_code == 1
    assert message in result.output
    assert not (project.folder / "project-compare").exists()


def test_a_database_without_features_is_refused(project_copy: Make):
    project = project_copy()
    with closing(sqlite3.connect(project.database)) as connection, connection:
        connection.execute("DELETE FROM keypoints")
        connection.execute("DELETE FROM descriptors")
    with pytest.raises(InputError, match="no features"):
        compare(project, ["random"], FAST)


def test_a_method_gone_since_is_a_failed_one(no_page, project_copy: Make, monkeypatch):
    project = project_copy()
    _, workspace = compare(project, ["random"], FAST)
    workspace.add_methods(["/gone/model.safetensors"])
    comparison, _ = compare(project, ["random"], FAST)
    assert "does not exist" in comparison.methods[1].failed


def test_comparisons_of_another_version_are_refused(whole, tmp_path):
    path = tmp_path / "compare.json"
    write_json(path, whole[0])
    assert read_json(path) == whole[0]
    path.write_text(path.read_text().replace('"format": 2', '"format": 99'))
    with pytest.raises(InputError, match="format 99"):
        read_json(path)
    path.write_text("[]")
    with pytest.raises(InputError, match="not a comparison"):
        read_json(path)


def test_every_key_has_its_own_file_name():
    keys = ["netvlad-o", "a/b", "a-b", "a b", "ü", "o", "../x", "."]
    assert len({file_name(key) for key in keys}) == len(keys)
    assert all("/" not in file_name(key) and file_name(key)[0] != "." for key in keys)


@pytest.mark.parametrize("name", ["hybrid", "netvlad-o-lite"])
def test_methods_that_run_a_shipped_model_are_compared(no_page, project_copy: Make, name):
    comparison, _ = compare(project_copy(), [name, "vlad"], FAST)
    assert not comparison.incomplete
    assert comparison.methods[0].name == name and comparison.methods[0].at_k[0].pairs > 0


def test_a_kept_ranking_is_the_one_that_was_kept(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    partners = np.array([[1, 2], [0, -1], [0, 1]], np.int32)
    scores = np.where(partners < 0, -np.inf, 0.5).astype(np.float32)
    ranking = Ranking(
        ("a", "b", "c"), partners, scores, "hybrid", 1.5, 2.5, ("note",), (("b", "blurred"),),
        compared=True, every_pair=True, unseen=(("c", "is missing"),),
    )  # fmt: skip
    workspace.save_ranking("hybrid", ranking, True)
    kept, timed_earlier = workspace.load_ranking("hybrid") or (None, False)
    assert kept is not None and timed_earlier
    for field in fields(Ranking):
        assert np.array_equal(getattr(kept, field.name), getattr(ranking, field.name)), field.name
