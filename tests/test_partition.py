"""Normalised cuts of the view graph and the overlap between its clusters."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from colmap_netvlad.graph.viewgraph import ViewGraph
from colmap_netvlad.mapping.partition import (
    bisect,
    cut,
    fiedler_vector,
    normalised_cuts,
    partition,
)
from colmap_netvlad.runtime.errors import InputError


def normalised_cut(weights: sparse.csr_array, left: np.ndarray) -> float:
    """Return Ncut of one bipartition, given as (N) membership of the left side."""
    order = np.concatenate([np.flatnonzero(left), np.flatnonzero(~left)])
    return float(normalised_cuts(weights, order)[int(left.sum()) - 1])


def view_graph(graph: nx.Graph) -> ViewGraph:
    """A view graph of a networkx graph with `weight` on its edges (1 where absent)."""
    nodes = sorted(graph.nodes)
    place = {node: i for i, node in enumerate(nodes)}
    rows = sorted(
        (*sorted((place[a], place[b])), data.get("weight", 1.0))
        for a, b, data in graph.edges(data=True)
    )
    table = np.array(rows, np.float64).reshape(-1, 3)
    weights = table[:, 2]
    names = tuple(f"{i:04d}.jpg" for i in range(len(nodes)))
    inliers = np.full(len(rows), 50)
    return ViewGraph(names, table[:, :2].astype(np.int32), inliers, weights, weights, weights)


def flight(rows: int, columns: int, seed: int = 0, reach: float = 2.5) -> nx.Graph:
    """Images of a flight on a jittered grid, joined where they are near, near ones stronger."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns)), -1).reshape(-1, 2)
    place = grid + rng.uniform(-0.2, 0.2, grid.shape)
    graph = nx.Graph()
    graph.add_nodes_from(range(len(place)))
    for i in range(len(place)):
        for j in range(i):
            distance = float(np.linalg.norm(place[i] - place[j]))
            if distance < reach:
                graph.add_edge(j, i, weight=1 - distance / (reach + 0.1))
    return graph


TWO_SQUARES = nx.Graph([(0, 1), (1, 2), (2, 3), (0, 3), (4, 5), (5, 6), (6, 7), (4, 7)], weight=1.0)
TWO_SQUARES.add_edge(3, 4, weight=0.5)


def test_normalised_cut_is_the_hand_computed_one() -> None:
    weights = view_graph(TWO_SQUARES).adjacency()
    left = np.arange(8) < 4
    assert normalised_cut(weights, left) == pytest.approx(2 * 0.5 / 8.5)
    first = normalised_cuts(weights, np.arange(8))[0]
    assert first == pytest.approx(2 / 2 + 2 / (17 - 2))


def test_bisection_finds_the_hand_computed_cut() -> None:
    weights = view_graph(TWO_SQUARES).adjacency()
    left, right = bisect(weights, np.arange(8))
    assert sorted([left.tolist(), right.tolist()]) == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_fiedler_vector_solves_the_generalised_eigenproblem() -> None:
    weights = view_graph(flight(5, 6)).adjacency().toarray()
    degree = np.diag(weights.sum(axis=1))
    vector = fiedler_vector(sparse.csr_array(weights))
    image = (degree - weights) @ vector
    value = vector @ image / (vector @ degree @ vector)
    assert image == pytest.approx(value * degree @ vector, abs=1e-9)
    assert 1e-3 < value < 1
    assert vector @ degree @ np.ones(30) == pytest.approx(0, abs=1e-9)


def test_sparse_and_dense_eigenvectors_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = view_graph(flight(25, 10)).adjacency()
    dense = fiedler_vector(weights)
    monkeypatch.setattr("colmap_netvlad.mapping.partition.DENSE_IMAGES", 10)
    found = fiedler_vector(weights)
    assert abs(found @ dense) == pytest.approx(np.linalg.norm(found) * np.linalg.norm(dense))


@settings(deadline=None, max_examples=15)
@given(st.integers(4, 7), st.integers(4, 7), st.integers(0, 1000))
def test_cut_of_a_flight_is_not_worse_than_a_random_balanced_one(rows, columns, seed) -> None:
    weights = view_graph(flight(rows, columns, seed)).adjacency()
    n = rows * columns
    left, _ = bisect(weights, np.arange(n))
    found = normalised_cut(weights, np.isin(np.arange(n), left))
    rng = np.random.default_rng(seed)
    for _ in range(20):
        random = np.zeros(n, bool)
        random[rng.permutation(n)[: n // 2]] = True
        assert found <= normalised_cut(weights, random) + 1e-12


@st.composite
def any_graph(draw: st.DrawFn) -> nx.Graph:
    n = draw(st.integers(1, 40))
    graph = nx.gnm_random_graph(n, draw(st.integers(0, 3 * n)), seed=draw(st.integers(0, 99)))
    for _, _, data in graph.edges(data=True):
        data["weight"] = draw(st.floats(0.01, 1))
    return graph


@settings(deadline=None, max_examples=30)
@given(any_graph(), st.integers(3, 15))
def test_clusters_cover_all_joined_images_with_disjoint_cores_within_the_size(
    graph, max_size
) -> None:
    view = view_graph(graph)
    clusters = partition(view, max_size)
    cores = [name for cluster in clusters for name in cluster.core]
    assert len(cores) == len(set(cores))
    assert all(len(cluster.core) <= max_size for cluster in clusters)
    assert all(set(cluster.core) <= set(cluster.images) for cluster in clusters)
    covered = {name for cluster in clusters for name in cluster.images}
    assert covered == set(view.names) - set(view.isolated())
    assert partition(view, max_size) == clusters


def test_flight_is_cut_into_balanced_connected_overlapping_clusters() -> None:
    view = view_graph(flight(20, 15))
    clusters = partition(view, 60)
    sizes = [len(cluster.core) for cluster in clusters]
    assert sum(sizes) == 300
    assert max(sizes) <= 60 and min(sizes) >= 20
    graph = view.graph()
    overlap = nx.Graph()
    for i, one in enumerate(clusters):
        assert nx.is_connected(graph.subgraph(one.images))
        for j, other in enumerate(clusters[:i]):
            if len(set(one.images) & set(other.images)) >= 10:
                overlap.add_edge(i, j)
    assert len(overlap) == len(clusters) and nx.is_connected(overlap)


def test_components_are_never_joined_and_isolated_images_left_out() -> None:
    graph = nx.disjoint_union(flight(4, 4), flight(3, 3))
    graph.add_node(99)
    view = view_graph(graph)
    clusters = partition(view, 60)
    assert [len(cluster.images) for cluster in clusters] == [16, 9]
    assert all(view.names[25] not in cluster.images for cluster in clusters)


def test_star_is_cut_so_that_every_cluster_has_the_centre() -> None:
    view = view_graph(nx.star_graph(30))
    clusters = partition(view, 10)
    assert all(view.names[0] in cluster.images for cluster in clusters)
    assert {name for cluster in clusters for name in cluster.images} == set(view.names)


@pytest.mark.parametrize("length", [100, 700])
def test_long_chain_is_cut_into_runs(length: int) -> None:
    view = view_graph(nx.path_graph(length))
    clusters = partition(view, 40)
    for cluster in clusters:
        positions = [view.names.index(name) for name in cluster.images]
        assert positions == list(range(positions[0], positions[-1] + 1))
    assert max(len(cluster.core) for cluster in clusters) <= 40


def test_more_clusters_than_images_cannot_be_asked_for() -> None:
    view = view_graph(flight(2, 2))
    clusters = partition(view, 3)
    assert {name for cluster in clusters for name in cluster.images} == set(view.names)
    assert len(clusters) <= 4
    with pytest.raises(InputError, match="3 or more"):
        partition(view, 0)


def test_graph_without_edges_has_no_clusters() -> None:
    graph = nx.Graph()
    graph.add_nodes_from(range(5))
    assert partition(view_graph(graph), 10) == []
    assert cut(view_graph(graph).adjacency(), 10) == [[0], [1], [2], [3], [4]]
