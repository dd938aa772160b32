"""The table of retrieval methods, each run on the rendered flight."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ranks import rank
from schemas import add_images, make_database

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.cache.store import Store
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.commands.pairs import make_pairs
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval import methods
from colmap_netvlad.retrieval.methods import METHODS, bow, deep, find_method, vlad
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError

MakeProject = Callable[..., Project]


@pytest.fixture
def checkpoint(tiny_checkpoint: Path) -> Path:
    return tiny_checkpoint


@pytest.fixture(autouse=True)
def _small_trees(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bow, "MOST_WORDS", 64)
    monkeypatch.setenv("HOME", str(tmp_path))  # no published tree of this machine's user


def check_ranking(ranking: Ranking, count: int, depth: int) -> None:
    assert ranking.partners.shape == (count, depth)
    for i, row in enumerate(ranking.partners.tolist()):
        assert sorted({i, *row}) == sorted([i, *row])
        assert NO_PARTNER not in row
    assert (np.diff(ranking.scores, axis=1) <= 0).all()


@pytest.mark.parametrize("name", ["vlad", "bow", "random", "exhaustive", "spatial"])
def test_each_method_ranks_every_image_of_the_flight(name: str, project_copy: MakeProject) -> None:
    ranking = rank(project_copy(), name, RetrievalOptions(k=5))
    assert ranking.method == name
    check_ranking(ranking, 12, {"exhaustive": 11}.get(name, 5))


@pytest.mark.parametrize("name", ["vlad", "bow", "random"])
def test_each_method_gives_the_same_ranking_twice(name: str, project_copy: MakeProject) -> None:
    first, second = (
        rank(project_copy(name=workspace), name, RetrievalOptions(k=11))
        for workspace in ("first", "second")
    )
    np.testing.assert_array_equal(first.partners, second.partners)


@pytest.mark.parametrize("name", ["vlad", "bow"])
def test_what_sees_the_photos_beats_chance(
    name: str, project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bow, "MOST_WORDS", 512)
    project = project_copy(matched=True)
    with open_database(project.database) as database:
        rows = {image.image_id: i for i, image in enumerate(database.images())}
        matches = np.zeros((12, 12))
        for (a, b), count in database.verified_matches().items():
            matches[rows[a], rows[b]] = matches[rows[b], rows[a]] = count
    ranking = rank(project, name, RetrievalOptions(k=3)).top(3)
    retrieved = np.take_along_axis(matches, ranking.partners, axis=1).mean()
    by_chance = matches.sum() / (12 * 11)
    assert retrieved > 1.3 * by_chance


def test_a_checkpoint_by_path_is_a_method(project_copy: MakeProject, checkpoint: Path) -> None:
    ranking = rank(project_copy(), str(checkpoint), RetrievalOptions(k=4))
    check_ranking(ranking, 12, 4)
    assert ranking.method == "tiny"
    assert ranking.notes == (
        "12 of 12 descriptors computed",
        "positions of 12 of 12 photos used",
        "up to 11 candidates of each image compared place by place",
    )
    assert ranking.seconds_describe > 0


def test_positions_join_in_by_themselves_only_where_candidates_are_compared(
    project_copy: MakeProject, checkpoint: Path
) -> None:
    project = project_copy()
    compared, alone, vlad = (
        rank(project, method, RetrievalOptions(k=4, rerank=rerank))
        for method, rerank in ((str(checkpoint), 100), (str(checkpoint), 0), ("vlad", 100))
    )
    assert "positions of 12 of 12 photos used" in compared.notes
    assert not any("positions" in note for note in (*alone.notes, *vlad.notes))


def test_a_second_run_computes_nothing_and_ranks_the_same(
    project_copy: MakeProject, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = project_copy()
    first = rank(project, checkpoint, RetrievalOptions(k=4))

    def refuse(*_: object) -> None:
        raise AssertionError("the model was loaded")

    monkeypatch.setattr("colmap_netvlad.models.checkpoint.load_model", refuse)
    second = rank(project, checkpoint, RetrievalOptions(k=4))
    assert second.notes[0].startswith("0 of 12 descriptors computed")
    assert second.seconds_describe == pytest.approx(first.seconds_describe)
    np.testing.assert_array_equal(first.partners, second.partners)


def test_new_and_changed_photos_alone_are_computed(
    project_copy: MakeProject, checkpoint: Path
) -> None:
    project = project_copy(copy_photos=True)
    assert project.images is not None
    names = image_names(project.database)
    aside = project.folder / "aside.jpg"
    (project.images / names[0]).rename(aside)
    first = rank(project, checkpoint, RetrievalOptions(k=4))
    assert first.left_out == ((names[0], "is missing"),)
    assert (first.partners[0] == NO_PARTNER).all()
    assert 0 not in first.partners
    aside.rename(project.images / names[0])
    shutil.copy(project.images / names[2], project.images / names[1])
    second = rank(project, checkpoint, RetrievalOptions(k=4))
    assert second.notes[0].startswith("2 of 12 descriptors computed")
    assert second.left_out == ()
    # The copy now lies nearest to its original; the database has the features of before.
    alone = rank(project, checkpoint, RetrievalOptions(k=4, rerank=0))
    assert alone.partners[2, 0] == 1
    assert alone.partners[1, 0] == 2


def test_bad_photos_are_left_out_with_a_reason_and_stop_nothing(
    project_copy: MakeProject, checkpoint: Path, caplog: pytest.LogCaptureFixture
) -> None:
    project = project_copy(copy_photos=True)
    assert project.images is not None
    names = image_names(project.database)
    whole = (project.images / names[1]).read_bytes()
    (project.images / names[0]).write_bytes(b"")
    (project.images / names[1]).write_bytes(whole[: len(whole) // 2])
    (project.images / names[2]).write_text("no photo")
    ranking = rank(project, checkpoint, RetrievalOptions(k=11))
    assert dict(ranking.left_out).keys() == set(names[:3])
    assert all(dict(ranking.left_out).values())
    assert ranking.partners.shape == (12, 8)
    assert not np.isin(ranking.partners[3:], [0, 1, 2]).any()
    # The commands that rank without a list of their own say it as well.
    assert ranking.left_out_lines() == caplog.messages


@pytest.mark.parametrize("others", [False, True])
def test_a_photo_that_is_gone_is_listed_and_not_compared_though_something_else_ranks_it(
    others: bool, project_copy: MakeProject, checkpoint: Path, tmp_path: Path
) -> None:
    project = project_copy(copy_photos=True)
    method = str(tmp_path / "others.h5") if others else "hybrid"
    options = RetrievalOptions(k=4, model=checkpoint)
    if others:
        export = replace(options, rerank=1)
        make_pairs(project, str(checkpoint), export, export=Path(method))
    before = rank(project, method, options)
    assert before.left_out == before.unseen == ()
    gone, broken = image_names(project.database)[:2]
    (project.need_images() / gone).unlink()
    (project.need_images() / broken).write_bytes(b"")
    with Store(project.cache) as store:
        store._db.execute("DELETE FROM agreements")
    after = rank(project, method, options)
    assert after.left_out == () and (after.partners[:2] != NO_PARTNER).all()
    assert after.unseen == ((gone, "is missing"), (broken, "is empty"))
    with Store(project.cache) as store:
        key = deep.cells_key(checkpoint, options)
        numbers = {store.cell_numbers(key)[name] for name in (gone, broken)}
        pairs, _, _ = store.agreements()
        assert len(pairs) and not numbers & set(pairs.ravel().tolist())


def test_no_usable_photo_at_all_is_one_sentence(
    project_copy: MakeProject, checkpoint: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    project = replace(project_copy(), images=tmp_path / "empty")
    with pytest.raises(InputError, match=r"None of the 12 photos .*is missing.*`images`"):
        rank(project, checkpoint)


def test_a_killed_description_goes_on_where_it_stopped(
    project_copy: MakeProject, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from colmap_netvlad.models.describe import DescriptorModel

    project = project_copy()
    describe, calls = DescriptorModel.describe_with_cells, []

    def describe_twice(self: DescriptorModel, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(len(pixels))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return describe(self, pixels)

    with monkeypatch.context() as patch:
        patch.setattr(DescriptorModel, "describe_with_cells", describe_twice)
        with pytest.raises(KeyboardInterrupt):
            rank(project, checkpoint, RetrievalOptions(k=4, batch_size=2))
    ranking = rank(project, checkpoint, RetrievalOptions(k=4, batch_size=2))
    assert ranking.notes[0].startswith("8 of 12 descriptors computed")


def test_vlad_describes_new_images_only(project_copy: MakeProject) -> None:
    project = project_copy()
    rank(project, "vlad", RetrievalOptions(k=3))
    again = rank(project, "vlad", RetrievalOptions(k=3))
    assert again.notes[0].startswith("0 of 12 descriptors computed")


def test_the_time_of_learning_the_codebook_is_part_of_describing(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, learn = project_copy(), vlad.learn_words

    def slowly(*arguments: Any) -> Any:
        time.sleep(1)
        return learn(*arguments, 8)

    monkeypatch.setattr(vlad, "learn_words", slowly)
    first = rank(project, "vlad", RetrievalOptions(k=3))
    assert first.seconds_describe > 1 and "in an earlier run" not in first.notes[1]
    again = rank(project, "vlad", RetrievalOptions(k=3))
    assert again.seconds_describe == first.seconds_describe
    assert "in an earlier run, which are part of describing" in again.notes[1]


def test_a_codebook_of_a_cache_that_kept_no_seconds_is_learned_again(
    project_copy: MakeProject, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, learn = project_copy(), vlad.learn_words
    monkeypatch.setattr(vlad, "learn_words", lambda *arguments: learn(*arguments, 8))
    first = rank(project, "vlad", RetrievalOptions(k=3))
    with closing(sqlite3.connect(project.cache)) as connection:
        connection.execute("ALTER TABLE codebooks DROP COLUMN seconds")
    again = rank(project, "vlad", RetrievalOptions(k=3))
    assert "in an earlier run" not in again.notes[1]
    assert again.partners.tolist() == first.partners.tolist()
    assert "in an earlier run" in rank(project, "vlad", RetrievalOptions(k=3)).notes[1]


def test_vlad_follows_its_definition() -> None:
    generator = np.random.default_rng(0)
    descriptors = generator.integers(0, 255, (30, 128)).astype(np.uint8)
    words = generator.uniform(0, 255, (4, 128)).astype(np.float32)
    expected = np.zeros((4, 128))
    for descriptor in descriptors.astype(float):
        word = np.argmin(((descriptor - words) ** 2).sum(axis=1))
        expected[word] += descriptor - words[word]
    expected = np.sign(expected) * np.sqrt(np.abs(expected))
    norms = np.linalg.norm(expected, axis=1, keepdims=True)
    expected = (expected / np.maximum(norms, 1e-12)).ravel()
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(vlad.describe(descriptors, words), expected, atol=1e-4)


@pytest.mark.parametrize("name", ["vlad", "bow"])
def test_a_database_without_features_is_said(name: str, tmp_path: Path) -> None:
    project = Project(tmp_path / "project.db", None)
    make_database(project.database, "4.2")
    add_images(project.database, ["a.jpg", "b.jpg"])
    with pytest.raises(InputError, match=r"no SIFT features.*colmap-netvlad features"):
        rank(project, name)


def test_bow_leaves_the_database_alone_and_says_which_tree(
    project_copy: MakeProject, capfd: pytest.CaptureFixture[str]
) -> None:
    project = project_copy(matched=True)
    before = hashlib.sha256(project.database.read_bytes()).hexdigest()
    ranking = rank(project, "bow", RetrievalOptions(k=3))
    assert "built from this project's own descriptors" in ranking.notes[0]
    assert "WARNING" not in capfd.readouterr().err, "faiss would like fewer words"
    assert hashlib.sha256(project.database.read_bytes()).hexdigest() == before
    (tree,) = project.folder.glob("*.bin")
    built = tree.stat().st_mtime_ns
    again = rank(project, "bow", RetrievalOptions(k=3))
    assert tree.stat().st_mtime_ns == built
    np.testing.assert_array_equal(ranking.partners, again.partners)
    given = rank(project, "bow", RetrievalOptions(k=3, vocab_tree=tree))
    assert given.notes == (f"vocabulary tree {tree}", bow.ONE_THREAD)
    np.testing.assert_array_equal(ranking.partners, given.partners)


def test_a_tree_that_is_not_one_is_refused(project_copy: MakeProject, tmp_path: Path) -> None:
    project = project_copy()
    with pytest.raises(InputError, match="does not exist"):
        rank(project, "bow", RetrievalOptions(vocab_tree=tmp_path / "none.bin"))
    wrong = tmp_path / "flann.bin"
    wrong.write_bytes(b"FLANN" * 100)
    with pytest.raises(InputError, match="not a vocabulary tree that COLMAP 4 reads"):
        rank(project, "bow", RetrievalOptions(vocab_tree=wrong))


def test_spatial_ranks_by_true_distance(project_copy: MakeProject, flight: RenderedFlight) -> None:
    project = project_copy()
    ranking = rank(project, "spatial", RetrievalOptions(k=3))
    centres = np.array([flight.centres[flight.names.index(n)][:2] for n in ranking.names])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    for i, row in enumerate(ranking.partners.tolist()):
        others = np.sort(np.delete(distances[i], i))[:3]
        np.testing.assert_allclose(distances[i, row], others, rtol=0.05, atol=0.5)


def test_k_above_the_number_of_images_is_lowered_with_a_note(project_copy: MakeProject) -> None:
    ranking = rank(project_copy(), "random", RetrievalOptions(k=50))
    check_ranking(ranking, 12, 11)
    assert ranking.notes[-1] == "k lowered from 50 to 11: the project has 12 images"


@pytest.mark.parametrize("k", [0, -3])
def test_k_below_one_is_refused(k: int, project_copy: MakeProject) -> None:
    with pytest.raises(InputError, match=f"`k` is {k}"):
        rank(project_copy(), "random", RetrievalOptions(k=k))


@pytest.mark.parametrize(
    ("name", "hint"),
    [("bwo", "did you mean bow"), ("VLAD", "did you mean vlad"), ("xyzzy", "methods are")],
)
def test_an_unknown_method_suggests_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        find_method(name)


@pytest.mark.parametrize("seed", [-1, 2**31 - 1])
def test_a_seed_that_cannot_be_one_is_refused(seed: int, project_copy: MakeProject) -> None:
    with pytest.raises(InputError, match=f"`seed` is {seed}"):
        rank(project_copy(), "random", RetrievalOptions(seed=seed))


def test_the_highest_seed_serves_k_means(project_copy: MakeProject) -> None:
    check_ranking(rank(project_copy(), "vlad", RetrievalOptions(k=3, seed=2**31 - 2)), 12, 3)


def test_a_missing_checkpoint_is_said() -> None:
    with pytest.raises(InputError, match=r"none\.safetensors does not exist"):
        find_method("none.safetensors")


def test_every_method_has_one_line_of_help() -> None:
    assert all(m.summary and "\n" not in m.summary for m in METHODS.values())
    assert {"bow", "vlad", "spatial", "exhaustive", "random"} <= METHODS.keys()
    assert methods.CHECKPOINT_SUFFIXES
