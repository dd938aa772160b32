"""The weighted view graph: equations 1 to 3, structure, export."""

import math
import sqlite3
from pathlib import Path

import networkx as nx
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from colmap_netvlad.cli import cli
from colmap_netvlad.colmap.database import pair_id
from colmap_netvlad.graph.viewgraph import ViewGraph, edge_weights, hull_area, read_view_graph
from colmap_netvlad.runtime.errors import InputError

SQUARE = np.array([[10, 10], [30, 10], [30, 30], [10, 30], [20, 20]], np.float32)
LINE = np.array([[1, 1], [2, 2], [3, 3], [4, 4], [5, 5]], np.float32)


def graph_of(names: str, *edges: tuple[str, str]) -> ViewGraph:
    """A view graph of one-letter names whose edges all weigh 1."""
    rows = sorted(tuple(sorted((names.index(a), names.index(b)))) for a, b in edges)
    ones = np.ones(len(rows))
    table = np.array(rows, np.int32).reshape(-1, 2)
    return ViewGraph(tuple(names), table, np.full(len(rows), 20), ones, ones, ones)


def write_database(path: Path, keypoints: list[np.ndarray], pairs: dict) -> Path:
    """A database of 100 x 100 pixel images `a.jpg`, `b.jpg`, ... with verified matches."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_id(
        0, pycolmap.CameraModelId.SIMPLE_PINHOLE, 100, 100, 100
    )
    camera_id = database.write_camera(camera)
    for i, points in enumerate(keypoints):
        image_id = database.write_image(pycolmap.Image(f"{chr(97 + i)}.jpg", camera_id=camera_id))
        database.write_keypoints(image_id, points)
    for (i, j), matches in pairs.items():
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = np.array(matches, np.uint32)
        database.write_matches(i + 1, j + 1, np.array(matches, np.uint32))
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    database.close()
    return path


def test_weights_are_the_hand_computed_ones_of_equations_1_to_3() -> None:
    w_inlier, w_overlap, w = edge_weights(
        np.array([100, 10]),
        np.array([[2000.0, 4000.0], [100.0, 300.0]]),
        np.array([[10000.0, 10000.0], [10000.0, 30000.0]]),
        0.5,
    )
    assert w_inlier == pytest.approx([1.0, 0.5])
    assert w_overlap == pytest.approx([0.3, 0.01])
    assert w == pytest.approx([0.65, 0.255])


def test_weighting_coefficient_moves_weight_between_matches_and_overlap() -> None:
    args = np.array([100, 10]), np.full((2, 2), 5000.0), np.full((2, 2), 10000.0)
    assert edge_weights(*args, 1.0)[2] == pytest.approx([1.0, 0.5])
    assert edge_weights(*args, 0.0)[2] == pytest.approx([0.5, 0.5])
    assert edge_weights(*args, 0.25)[2] == pytest.approx([0.625, 0.5])
    with pytest.raises(InputError, match="between 0 and 1"):
        edge_weights(*args, 1.5)


def test_pairs_of_one_inlier_weigh_one_where_no_pair_has_more() -> None:
    w_inlier, w_overlap, w = edge_weights(np.array([1, 1]), np.zeros((2, 2)), np.ones((2, 2)))
    assert w_inlier.tolist() == [1, 1]
    assert w_overlap.tolist() == [0, 0]
    assert w.tolist() == [0.5, 0.5]


def test_images_of_unknown_size_overlap_by_nothing() -> None:
    assert edge_weights(np.array([7]), np.ones((1, 2)), np.zeros((1, 2)))[1].tolist() == [0]


def test_hull_area_is_the_hand_computed_one() -> None:
    assert hull_area(SQUARE, np.arange(5, dtype=np.uint32)) == pytest.approx(400)
    assert hull_area(SQUARE, np.array([0, 1, 2], np.uint32)) == pytest.approx(200)


@pytest.mark.parametrize("points", [LINE, SQUARE[:2], SQUARE[:0], np.full((4, 2), np.nan)])
def test_hulls_without_area_are_zero(points: np.ndarray) -> None:
    assert hull_area(points.astype(np.float32), np.arange(len(points), dtype=np.uint32)) == 0


@given(
    st.lists(
        st.tuples(
            st.integers(1, 10**6),
            st.floats(0, 1e9),
            st.floats(0, 1e9),
            st.integers(0, 10**9),
            st.integers(0, 10**9),
        ),
        max_size=20,
    ),
    st.floats(0, 1),
)
def test_weights_lie_between_zero_and_one_and_do_not_depend_on_the_side(rows, share) -> None:
    table = np.array(rows, np.float64).reshape(-1, 5)
    inliers, hulls, areas = table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3:]
    weights = edge_weights(inliers, hulls, areas, share)
    swapped = edge_weights(inliers, hulls[:, ::-1], areas[:, ::-1], share)
    for weight, other in zip(weights, swapped, strict=True):
        assert ((weight >= 0) & (weight <= 1)).all()
        assert weight == pytest.approx(other)


def test_graph_of_a_database_has_its_hand_computed_weights(tmp_path: Path) -> None:
    wide = SQUARE * 2
    path = write_database(
        tmp_path / "database.db",
        [SQUARE, wide, LINE, SQUARE],
        {(0, 1): [[k, k] for k in range(5)], (1, 2): [[k, 4 - k] for k in range(4)]},
    )
    before = path.read_bytes()
    graph = read_view_graph(path, min_inliers=1)
    assert path.read_bytes() == before
    assert graph.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    assert graph.edges.tolist() == [[0, 1], [1, 2]]
    assert graph.inliers.tolist() == [5, 4]
    assert graph.weight_inlier == pytest.approx([1, math.log(4) / math.log(5)])
    assert graph.weight_overlap == pytest.approx([(400 + 1600) / 20000, 1600 / 20000])
    assert graph.weights == pytest.approx([0.5 + 0.05, 0.5 * math.log(4) / math.log(5) + 0.04])
    adjacency = graph.adjacency().toarray()
    assert (adjacency == adjacency.T).all()
    assert adjacency[0, 1] == pytest.approx(0.55)
    assert graph.isolated() == ["d.jpg"]


def test_pairs_that_failed_or_have_too_few_inliers_are_no_edges(tmp_path: Path) -> None:
    path = write_database(
        tmp_path / "database.db", [SQUARE] * 3, {(0, 1): [[0, 0]] * 5, (1, 2): np.zeros((0, 2))}
    )
    assert len(read_view_graph(path).edges) == 0
    assert read_view_graph(path, min_inliers=5).edges.tolist() == [[0, 1]]
    with pytest.raises(InputError, match="at least 1"):
        read_view_graph(path, min_inliers=0)


def test_matches_of_keypoints_that_are_not_there_are_one_sentence(tmp_path: Path) -> None:
    path = write_database(tmp_path / "database.db", [SQUARE] * 2, {(0, 1): [[0, 1]] * 5})
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute("DELETE FROM keypoints WHERE image_id = 2")
        assert connection.execute(
            "SELECT COUNT(*) FROM two_view_geometries WHERE pair_id = ?", (pair_id(1, 2),)
        ).fetchone() == (1,)
    connection.close()
    with pytest.raises(InputError, match="matches of keypoint 1 of image 2"):
        read_view_graph(path, min_inliers=1)


def test_several_components_come_largest_first_with_isolated_images() -> None:
    graph = graph_of("abcdef", ("b", "c"), ("c", "d"), ("e", "f"))
    assert graph.components() == [["b", "c", "d"], ["e", "f"], ["a"]]
    statistics = graph.statistics()
    assert statistics.component_sizes == (3, 2, 1)
    assert statistics.isolated == ("a",)
    assert (statistics.degree_min, statistics.degree_max) == (0, 2)
    assert statistics.degree_mean == pytest.approx(1.0)


def test_bridges_and_articulation_images_are_where_the_model_splits() -> None:
    two_triangles = [("a", "b"), ("b", "c"), ("a", "c"), ("d", "e"), ("e", "f"), ("d", "f")]
    graph = graph_of("abcdef", *two_triangles, ("c", "d"))
    assert graph.bridges() == [("c", "d")]
    assert graph.articulation_images() == ["c", "d"]


def test_a_star_hangs_on_its_centre_and_a_chain_on_every_inner_image() -> None:
    star = graph_of("abcd", ("a", "b"), ("a", "c"), ("a", "d"))
    assert star.articulation_images() == ["a"]
    assert len(star.bridges()) == 3
    chain = graph_of("abcd", ("a", "b"), ("b", "c"), ("c", "d"))
    assert chain.articulation_images() == ["b", "c"]
    ring = graph_of("abcd", ("a", "b"), ("b", "c"), ("c", "d"), ("a", "d"))
    assert (ring.bridges(), ring.articulation_images()) == ([], [])
    assert (ring.statistics().degree_min, ring.statistics().degree_max) == (2, 2)


def test_an_empty_graph_has_empty_figures() -> None:
    assert graph_of("").statistics().images == 0
    assert graph_of("ab").statistics().component_sizes == (1, 1)


def test_graphml_keeps_names_and_weights(tmp_path: Path) -> None:
    graph = graph_of("a& ", ("a", " "))
    graph.write_graphml(tmp_path / "graph.graphml")
    read = nx.read_graphml(tmp_path / "graph.graphml")
    assert set(read.nodes) == {"a", "&", " "}
    assert read.edges["a", " "] == {
        "inliers": 20, "weight_inlier": 1.0, "weight_overlap": 1.0, "weight": 1.0,
    }  # fmt: skip


def test_command_prints_where_the_model_splits_and_writes_graphml(tmp_path: Path) -> None:
    chain = {(0, 1): [[k, k] for k in range(5)] * 3, (1, 2): [[k, k] for k in range(5)] * 3}
    path = write_database(tmp_path / "database.db", [SQUARE] * 4, chain)
    before = path.read_bytes()
    graphml = tmp_path / "graph.graphml"
    result = CliRunner().invoke(cli, ["viewgraph", "--db", str(path), "--graphml", str(graphml)])
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        "Images: 4, verified pairs: 2.",
        "Pairs an image: 0 to 2, median 1, mean 1.0.",
        "Components: 2 (images: 3, 1).",
        "Images without a verified pair: 1: d.jpg.",
        "Images whose loss splits the model: 1: b.jpg.",
        "Pairs whose loss splits the model: 2: a.jpg b.jpg, b.jpg c.jpg.",
        f"The graph is in {graphml}.",
    ]
    assert nx.read_graphml(graphml).number_of_edges() == 2
    assert path.read_bytes() == before
