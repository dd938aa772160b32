"""Look-alikes: wrong pairs among true ones are found, and nothing true goes."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import image_names, open_database, pair_id
from colmap_netvlad.commands.reconstruct import reconstruct
from colmap_netvlad.demo.landscape import ESTATE_STEP, Extent, Landscape
from colmap_netvlad.demo.simulate import FLYING_HEIGHT, SimulationOptions, simulate_flight
from colmap_netvlad.graph import lookalikes
from colmap_netvlad.graph.lookalikes import (
    APART,
    Moves,
    find_lookalikes,
    fit_plan,
    judge_moves,
    read_moves,
)
from colmap_netvlad.graph.pair import as_pair
from colmap_netvlad.graph.verified import verified_by_name
from colmap_netvlad.mapping import contradicted
from colmap_netvlad.mapping.contradicted import contradicted_pairs

WIDTH = 1.25


def flight_moves(
    side: int = 7, wrong: int = 20, seed: int = 0, filled: float = 0.4
) -> tuple[Moves, dict[str, np.ndarray], set[int]]:
    """Pairs of near photos of a nadir flight (unit: the flying height), and some of far ones.

    Returns:
        The moves, the true positions in m (flying height 100 m), and the wrong edges.
    """
    rng = np.random.default_rng(seed)
    grid = np.array([(i, j) for j in range(side) for i in range(side)]) * 0.35
    places = (grid + rng.normal(0, 0.02, grid.shape)) @ (1, 1j)
    turns = np.exp(1j * rng.uniform(-3, 3, len(grid))) * rng.uniform(0.9, 1.1, len(grid))
    far = np.abs(places[:, None] - places)
    near = [(i, j) for i, j in np.argwhere((far > 0) & (far < 0.8)).tolist() if i < j]
    apart = [(i, j) for i, j in np.argwhere(far > 1.5).tolist() if i < j]
    chosen = [apart[k] for k in rng.choice(len(apart), wrong, replace=False)]
    edges = np.array(sorted([*near, *chosen]))
    is_wrong = np.array([tuple(edge) in set(chosen) for edge in edges.tolist()])
    i, j = edges.T
    turn = turns[i] / turns[j]  # p = a_i u_i + b_i = a_j (r u_i + d) + b_j
    shift = (places[i] - places[j]) / turns[j]
    shift[is_wrong] = 0.3 * np.exp(1j * rng.uniform(-3, 3, wrong))
    shift += rng.normal(0, 0.01, len(edges)) + 1j * rng.normal(0, 0.01, len(edges))
    count = len(edges)
    moves = Moves(
        names=tuple(f"{k:03d}.jpg" for k in range(len(grid))),
        edges=edges,
        inliers=rng.integers(30, 600, count),
        turn=turn,
        shift=shift,
        misfit=np.full(count, 0.01),
        tilt=np.full(count, 2.0),
        cover=np.full(count, 0.5),
        filled=np.where(is_wrong, filled, 0.95),
        widths=np.full(len(grid), WIDTH),
    )
    metres = 100 * np.column_stack([places.real, places.imag, np.ones(len(grid))])
    return (
        moves,
        dict(zip(moves.names, metres, strict=True)),
        set(np.flatnonzero(is_wrong).tolist()),
    )


def pairs_of(moves: Moves, edges: set[int]) -> set[tuple[str, str]]:
    return {as_pair(*(moves.names[k] for k in moves.edges[e])) for e in edges}


@pytest.mark.parametrize("seed", range(5))
def test_cycles_find_wrong_pairs_and_drop_nothing_true(seed):
    moves, _, wrong = flight_moves(seed=seed)
    found = judge_moves(moves, {})
    assert {one.pair for one in found} == pairs_of(moves, wrong)
    assert all(one.contradicted and "beside the plan" in one.reason for one in found)
    assert [one.strength for one in found] == sorted((o.strength for o in found), reverse=True)
    plan = fit_plan(moves)
    assert np.nanmax(np.delete(plan.beside, list(wrong))) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_gps_finds_them_and_decides_alone(seed):
    moves, metres, wrong = flight_moves(seed=seed, filled=1.0)  # cycles say nothing of these
    assert judge_moves(moves, {}) == []
    found = judge_moves(moves, metres)
    assert {one.pair for one in found} == pairs_of(moves, wrong)
    assert all("m apart, GPS" in one.reason for one in found)


def test_photos_with_a_wild_position_keep_their_pairs():
    moves, metres, wrong = flight_moves(filled=1.0)
    wild = {**metres, moves.names[10]: metres[moves.names[10]] + (900.0, -400.0, 0.0)}
    wild[moves.names[30]] = np.array([0.0, 5000.0, 90.0])
    own = {
        as_pair(*(moves.names[k] for k in edge))
        for edge in moves.edges.tolist()
        if {10, 30} & {*edge}
    }
    assert {one.pair for one in judge_moves(moves, wild)} == pairs_of(moves, wrong) - own


def test_a_pair_that_lacks_nothing_is_not_contradicted():
    moves, _, wrong = flight_moves()
    filled = moves.filled.copy()
    spared = min(wrong)
    filled[spared] = 0.85
    found = {one.pair for one in judge_moves(replace(moves, filled=filled), {})}
    assert found == pairs_of(moves, wrong - {spared})


def test_gps_of_another_flight_contradicts_nothing():
    moves, metres, _ = flight_moves(wrong=0)
    rng = np.random.default_rng(3)
    shuffled = dict(zip(metres, rng.permutation(list(metres.values())), strict=True))
    assert judge_moves(moves, metres) == []
    assert not any(one.contradicted for one in judge_moves(moves, shuffled))


def test_pairs_that_fit_no_shift_are_judged_by_where_others_put_their_photos():
    moves, metres, wrong = flight_moves(side=10, wrong=30)
    mixed = moves.misfit.copy()
    mixed[list(wrong)] = 0.2
    near = [e for e in range(len(moves.edges)) if e not in wrong][:4]
    mixed[near] = 0.2  # true ones of which a similarity tells nothing either
    mixed = replace(moves, misfit=mixed, filled=np.where(mixed > 0.1, 0.3, moves.filled))
    places = np.array(list(metres.values()))
    gap = np.linalg.norm(places[moves.edges[:, 0]] - places[moves.edges[:, 1]], axis=1)
    far = {e for e in wrong if gap[e] > 1.1 * 100 * APART * WIDTH}  # heights differ by a tenth
    assert len(far) > 5
    for positions in ({}, metres):
        found = [one for one in judge_moves(mixed, positions) if one.contradicted]
        assert pairs_of(moves, far) <= {one.pair for one in found} <= pairs_of(moves, wrong)
        assert all("no ground in common" in one.reason for one in found)


def test_parts_that_only_such_pairs_join_are_not_contradicted():
    one, _, _ = flight_moves(wrong=0)
    count = len(one.names)
    bridges = np.array([(k, count + (k + 20) % count) for k in range(0, count, 5)])
    edges = np.concatenate([one.edges, one.edges + count, bridges])
    both = {
        name: np.concatenate([getattr(one, name)] * 2 + [np.full(len(bridges), value)])
        for name, value in {
            "inliers": 60, "turn": 1, "shift": 0.1, "misfit": 0.3, "tilt": 2.0, "cover": 0.5,
            "filled": 0.3,
        }.items()
    }  # fmt: skip
    names = (*one.names, *(f"b{name}" for name in one.names))
    moves = Moves(names=names, edges=edges, widths=np.full(2 * count, WIDTH), **both)
    assert not any(one.contradicted for one in judge_moves(moves, {}))


def test_facades_and_orbits_are_not_judged():
    moves, metres, _ = flight_moves()
    turned = replace(moves, tilt=np.full(len(moves.edges), 40.0))
    assert judge_moves(turned, metres) == []
    loose = replace(moves, misfit=np.where(np.arange(len(moves.edges)) % 3 == 0, 0.2, 0.01))
    assert judge_moves(loose, metres) == []


def test_crowded_matches_are_shown_only():
    moves, _, _ = flight_moves(wrong=0)
    cover, filled = moves.cover.copy(), moves.filled.copy()
    cover[4:6], filled[4] = 0.01, 0.5  # photos that share but a corner lack nothing there
    (one,) = judge_moves(replace(moves, cover=cover, filled=filled), {})
    assert not one.contradicted and "crowd on 1.0 %" in one.reason and one.strength > 1


def test_no_pairs_at_all(project_copy):
    with open_database(project_copy().database) as database:
        assert find_lookalikes(database) == []


def test_moves_are_the_true_ones(tmp_path):
    true = simulate_flight(tmp_path / "a.db", SimulationOptions(lines=4, photos=6, features=400))
    with open_database(tmp_path / "a.db") as database:
        moves = read_moves(database)
    assert moves.judged.mean() > 0.95
    apart = [
        np.linalg.norm((true[moves.names[i]] - true[moves.names[j]])[:2])
        for i, j in moves.edges.tolist()
    ]
    told = np.abs(moves.shift) * FLYING_HEIGHT
    # A tilt of 2 degrees moves the ground by 3.5 m, hills by as much.
    assert np.median(np.abs(told - apart)) < 6 and np.percentile(np.abs(told - apart), 90) < 15
    facing = np.abs(np.abs(moves.turn) - 1)
    assert np.percentile(facing, 90) < 0.1
    assert not any(one.contradicted for one in judge_moves(moves, true))


def add_lookalike(database, one: str, two: str) -> None:
    """Write a verified pair of two places: the features of one moved by a tenth of the photo."""
    with open_database(database) as opened:
        ids = {row.name: row.image_id for row in opened.images()}
        a, b = sorted((ids[one], ids[two]))
        first, second = opened.keypoints(a), opened.keypoints(b)
    wanted = np.add(first, [40, 0])
    distance = np.linalg.norm(wanted[:, None] - second, axis=2)
    nearest = distance.argmin(axis=1)
    close = np.flatnonzero(distance.min(axis=1) < 4)
    matches = np.column_stack([close, nearest[close]]).astype(np.uint32)
    assert len(matches) > 40
    essential = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)  # sideways, not turned
    with closing(sqlite3.connect(database)) as connection:
        for table in ("matches", "two_view_geometries"):
            connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (pair_id(a, b),))
        connection.execute(
            "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config, E)"
            " VALUES (?, ?, 2, ?, 2, ?)",
            (pair_id(a, b), len(matches), matches.tobytes(), essential.tobytes()),
        )
        connection.execute(
            "INSERT INTO matches (pair_id, rows, cols, data) VALUES (?, ?, 2, ?)",
            (pair_id(a, b), len(matches), matches.tobytes()),
        )
        connection.commit()


def test_dropped_pairs_stay_in_the_database_and_out_of_the_model(project_copy, flight):
    project = project_copy(matched=True)
    names = image_names(project.database)
    assert contradicted_pairs(project) == []
    corners = flight.centres[:, :2]
    far = np.linalg.norm(corners[0] - corners, axis=1).argmax()
    add_lookalike(project.database, flight.names[0], flight.names[int(far)])
    pair = as_pair(flight.names[0], flight.names[int(far)])
    assert contradicted_pairs(project) == [pair]
    before = verified_by_name(project.database)
    project.pairs.write_text("".join(f"{a} {b}\n" for a in names for b in names if a < b))
    run = CliRunner().invoke(cli, ["reconstruct", "--db", str(project.database)])
    assert run.exit_code == 0, run.output
    assert "Look-alikes: 1 contradicted pair was left out" in run.stdout
    assert verified_by_name(project.database) == before and before[pair] > 40
    assert not list(project.folder.glob(".lookalikes*"))
    page = (project.sparse / "0" / "report.html").read_text("utf-8")
    assert "1 contradicted pair was left out before this model was made" in page
    assert f"{pair[0]} – {pair[1]}" in page
    run = CliRunner().invoke(cli, ["report", "--sparse", str(project.sparse)])
    assert run.exit_code == 0, run.output


def test_reconstruct_and_its_report_read_the_pairs_once(project_copy, monkeypatch):
    project = project_copy(matched=True)
    names = image_names(project.database)
    pairs = [(a, b) for a in names for b in names if a < b]
    reads = []

    def counted(database):
        reads.append(database)
        return read_moves(database)

    for module in (lookalikes, contradicted):
        monkeypatch.setattr(module, "read_moves", counted)
    assert reconstruct(project, pairs).quality
    assert len(reads) == 1


def test_copies_are_alike_to_the_last_tile():
    land = Landscape(Extent(-190, -150, 190, 150), 0.5, "copies", 0)
    step, size = round(ESTATE_STEP / 0.5), 60
    row, column = land.shape[0] // 2, land.shape[1] // 2
    here = land.height[row - size : row + size, column - size : column + size]
    there = land.height[row - size : row + size, column + step - size : column + step + size]
    assert np.array_equal(here, there) and here.max() > 3
