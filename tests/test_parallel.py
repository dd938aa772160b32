"""Parallel SfM end to end on a simulated flight: same model as incremental, nothing lost."""

import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from models import grid_model

from colmap_netvlad.colmap.copies import copy_images
from colmap_netvlad.colmap.database import images_of_pair
from colmap_netvlad.demo.simulate import SimulationOptions, simulate_flight
from colmap_netvlad.graph.viewgraph import read_view_graph
from colmap_netvlad.mapping import MAPPERS, parallel, pipelines, refine
from colmap_netvlad.mapping.incremental import map_incremental
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import largest_first, numbered
from colmap_netvlad.mapping.partition import Cluster, partition
from colmap_netvlad.runtime.errors import InputError

FLIGHT = SimulationOptions(lines=4, photos=8, features=150, partners=12)
OPTIONS = MappingOptions(cluster_size=12, threads=2)


@dataclass(frozen=True)
class Mapped:
    """A simulated flight, its clusters mapped, and the model merged from them."""

    database: Path
    truth: dict[str, np.ndarray]
    state: Path
    clusters: list[Cluster]
    model: pycolmap.Reconstruction


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    folder = tmp_path_factory.mktemp("simulated")
    database = folder / "database.db"
    truth = simulate_flight(database, FLIGHT)
    clusters = partition(read_view_graph(database), 12)
    for number, cluster in enumerate(clusters):
        target = folder / "state" / str(number)
        target.mkdir(parents=True)
        parallel.map_cluster(lambda count: None, database, target, cluster.images, OPTIONS, 1)
    (folder / "merged").mkdir()
    models = sorted((folder / "state").glob("*/*"))
    parallel.merge_models(lambda count: None, database, None, models, folder / "merged", OPTIONS)
    model = pycolmap.Reconstruction(folder / "merged/0")
    return Mapped(database, truth, folder / "state", clusters, model)


def centres(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}


def offsets(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> np.ndarray:
    """Distances of common camera centres after alignment, over the extent of `other`."""
    names = sorted(one.keys() & other.keys())
    a, b = (np.array([centre[name] for name in names]) for centre in (one, other))
    found = pycolmap.estimate_sim3d(a, b)
    assert found is not None
    matrix = found.matrix()
    return np.linalg.norm(a @ matrix[:, :3].T + matrix[:, 3] - b, axis=1) / np.ptp(b, axis=0).max()


def test_merged_model_is_as_good_as_the_incremental_one(mapped: Mapped, tmp_path: Path) -> None:
    (incremental,) = map_incremental(
        mapped.database, None, tmp_path / "sparse", MappingOptions(threads=2)
    )
    assert len(mapped.clusters) >= 3
    assert mapped.model.num_reg_images() == incremental.num_reg_images() == 32
    error = mapped.model.compute_mean_reprojection_error()
    assert error == pytest.approx(incremental.compute_mean_reprojection_error(), rel=0.05)
    assert offsets(centres(mapped.model), centres(incremental)).max() < 0.01
    assert offsets(centres(mapped.model), mapped.truth).max() < 0.01
    assert mapped.model.num_cameras() == 1


def test_each_observation_has_one_point_and_each_point_sees_an_image_once(mapped: Mapped) -> None:
    seen = set()
    for point in mapped.model.points3D.values():
        images = [element.image_id for element in point.track.elements]
        assert len(images) == len(set(images)) >= 2
        seen |= {(element.image_id, element.point2D_idx) for element in point.track.elements}
    assert len(seen) == mapped.model.compute_num_observations()


def test_a_cluster_database_has_the_same_ids_and_only_its_own_images(
    mapped: Mapped, tmp_path: Path
) -> None:
    before = mapped.database.read_bytes()
    names = mapped.clusters[0].images
    copy_images(mapped.database, tmp_path / "subset.db", names)
    assert mapped.database.read_bytes() == before
    with closing(sqlite3.connect(tmp_path / "subset.db")) as subset:
        ids = dict(subset.execute("SELECT name, image_id FROM images"))
        pairs = [row[0] for row in subset.execute("SELECT pair_id FROM two_view_geometries")]
    assert sorted(ids) == sorted(names)
    assert ids == {name: int(name[:5]) + 1 for name in names}
    assert pairs and all(set(images_of_pair(pair)) <= set(ids.values()) for pair in pairs)


def drop_pairs(database: Path, drop: Callable[[int, int], bool]) -> None:
    with closing(sqlite3.connect(database)) as connection:
        rows = connection.execute("SELECT pair_id FROM two_view_geometries").fetchall()
        dropped = [row for row in rows if drop(*images_of_pair(row[0]))]
        connection.executemany("DELETE FROM two_view_geometries WHERE pair_id = ?", dropped)
        connection.commit()


def test_components_become_models_and_an_isolated_image_is_left_out(
    mapped: Mapped, tmp_path: Path
) -> None:
    database = tmp_path / "database.db"
    shutil.copy(mapped.database, database)
    # Lines 1 and 2 (images 1 to 16) apart from lines 3 and 4; image 32 apart from all.
    drop_pairs(database, lambda a, b: (a <= 16) != (b <= 16) or b == 32)
    models, report = parallel.reconstruct_parallel(
        database, None, tmp_path / "sparse", MappingOptions(cluster_size=16, threads=2)
    )
    first, second = (model.num_reg_images() for model in models)
    assert first == 16 and second >= 14
    assert [cluster.images for cluster in report.clusters] == [16, 15]
    assert "00031.jpg" not in centres(models[1])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "sparse"]


def test_two_runs_do_not_share_finished_clusters(mapped: Mapped, tmp_path: Path) -> None:
    enter = (
        "import sys, pathlib; from colmap_netvlad.runtime.files import claimed\n"
        "with claimed(pathlib.Path(sys.argv[1])): print(flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", enter, tmp_path / ".sparse.clusters"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(InputError, match="Another run maps clusters for"):
            parallel.reconstruct_parallel(mapped.database, None, tmp_path / "sparse", OPTIONS)
        other.kill()
    models, _ = parallel.reconstruct_parallel(mapped.database, None, tmp_path / "sparse", OPTIONS)
    assert [model.num_reg_images() for model in models] == [32]
    assert [path.name for path in tmp_path.iterdir()] == ["sparse"]


def test_a_corridor_flight_is_cut_and_merged_again(tmp_path: Path) -> None:
    corridor = SimulationOptions(lines=1, photos=24, features=250, partners=6)
    truth = simulate_flight(tmp_path / "database.db", corridor)
    models, report = parallel.reconstruct_parallel(
        tmp_path / "database.db", None, tmp_path / "sparse", MappingOptions(cluster_size=12)
    )
    assert len(report.clusters) >= 2
    assert [model.num_reg_images() for model in models] == [24]
    assert offsets(centres(models[0]), truth).max() < 0.05


def test_all_models_of_a_cluster_are_merged(mapped: Mapped, tmp_path: Path) -> None:
    names = sorted(mapped.truth)
    torn = tmp_path / "torn.db"
    shutil.copy(mapped.database, torn)
    drop_pairs(torn, lambda a, b: (a <= 16) != (b <= 16))
    # Without those pairs, all images together give two models; lines 2 and 3 join them.
    for number, database, part in (("0", torn, names), ("1", mapped.database, names[8:24])):
        (tmp_path / number).mkdir()
        parallel.map_cluster(lambda count: None, database, tmp_path / number, part, OPTIONS, 1)
    report = parallel.ParallelReport([parallel.ClusterReport(32), parallel.ClusterReport(16)])
    (tmp_path / "merged").mkdir()
    parallel.merge_clusters(mapped.database, None, tmp_path, tmp_path / "merged", OPTIONS, report)
    assert report.clusters[0].models == [16, 16]
    assert [sorted(members) for members in report.members] == [["0/0", "0/1", "1/0"]]
    assert pycolmap.Reconstruction(tmp_path / "merged/0").num_reg_images() == 32


def test_images_of_a_refused_sub_model_are_registered_afterwards(
    mapped: Mapped, tmp_path: Path
) -> None:
    bent = pycolmap.Reconstruction(mapped.state / "1/0")
    rng = np.random.default_rng(0)
    for point in bent.points3D.values():
        point.xyz = rng.uniform(-10, 10, 3)
    (tmp_path / "bent").mkdir()
    bent.write(tmp_path / "bent")
    others = [path for path in sorted(mapped.state.glob("*/*")) if path.parent.name != "1"]
    (tmp_path / "merged").mkdir()
    parallel.merge_models(
        lambda count: None,
        mapped.database,
        None,
        [*others, tmp_path / "bent"],
        tmp_path / "merged",
        OPTIONS,
    )
    note = (tmp_path / "merged/merge.json").read_text()
    assert f"{tmp_path.name}/bent" in note and "agree" in note
    model = pycolmap.Reconstruction(tmp_path / "merged/0")
    assert model.num_reg_images() == 32
    assert offsets(centres(model), mapped.truth).max() < 0.01


def fail_for_some(
    advance: Callable[[int], None],
    database: Path,
    folder: Path,
    names: tuple[str, ...],
    options: MappingOptions,
    threads: int,
) -> None:
    if options.seed == 99 or "00009.jpg" in names:
        raise ValueError("out of luck")
    parallel.map_cluster(advance, database, folder, names, options, threads)


def test_a_failing_cluster_is_reported_and_its_images_registered_by_the_others(
    mapped: Mapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "map_cluster", fail_for_some)
    names = sorted(mapped.truth)
    parts = tuple(names[8:12]), (*names[:9], *names[11:])
    clusters = [Cluster(part, part) for part in parts]
    report = parallel.map_clusters(mapped.database, clusters, tmp_path, OPTIONS)
    assert [cluster.fault for cluster in report.clusters] == ["ValueError: out of luck", None]
    (line,) = parallel.report_lines(report)
    assert line.startswith("Cluster 0 (4 images) failed: ValueError: out of luck.")
    (tmp_path / "merged").mkdir()
    parallel.merge_clusters(mapped.database, None, tmp_path, tmp_path / "merged", OPTIONS, report)
    assert pycolmap.Reconstruction(tmp_path / "merged/0").num_reg_images() == 32
    assert report.joined_later == 2


def test_images_that_nothing_sees_cost_no_further_adjustment(
    mapped: Mapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = tmp_path / "database.db"
    shutil.copy(mapped.database, database)
    drop_pairs(database, lambda a, b: b > 16)
    map_incremental(database, None, tmp_path / "sparse", OPTIONS)
    adjusted = []
    adjust = refine._refine_globally
    monkeypatch.setattr(refine, "_refine_globally", lambda *a: (adjusted.append(a), adjust(*a)))
    (tmp_path / "merged").mkdir()
    parallel.merge_models(
        lambda count: None, database, None, [tmp_path / "sparse/0"], tmp_path / "merged", OPTIONS
    )
    assert pycolmap.Reconstruction(tmp_path / "merged/0").num_reg_images() == 16
    assert len(adjusted) == 1


def test_all_clusters_failing_is_an_error(
    mapped: Mapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "map_cluster", fail_for_some)
    with pytest.raises(InputError, match=r"None of the \d clusters could be mapped: ValueError"):
        parallel.reconstruct_parallel(
            mapped.database, None, tmp_path / "sparse", MappingOptions(seed=99, cluster_size=12)
        )
    assert not (tmp_path / "sparse").exists()


def test_nothing_verified_gives_no_model(mapped: Mapped, tmp_path: Path) -> None:
    shutil.copy(mapped.database, tmp_path / "database.db")
    drop_pairs(tmp_path / "database.db", lambda a, b: True)
    assert MAPPERS["parallel"](tmp_path / "database.db", None, tmp_path / "sparse", OPTIONS) == []


def test_workers_keep_to_processors_and_memory(mapped: Mapped) -> None:
    def count(**options: float) -> int:
        given = MappingOptions(**options)  # type: ignore[arg-type]
        return parallel.worker_count(mapped.database, 12, 8, given)

    assert count(threads=3, memory=1e12) == 3
    assert count(threads=100, memory=1e12) == 8
    assert count(threads=3, memory=1) == 1
    assert count(threads=100, memory=2.5 * parallel.WORKER_BYTES) == 2


def test_finished_clusters_of_other_input_are_not_used(mapped: Mapped, tmp_path: Path) -> None:
    graph = read_view_graph(mapped.database)
    state = parallel.open_state(tmp_path / "sparse", graph, mapped.clusters, OPTIONS)
    (state / "0").mkdir()
    again = parallel.open_state(tmp_path / "sparse", graph, mapped.clusters, OPTIONS)
    assert (again / "0").exists()
    parallel.open_state(tmp_path / "sparse", graph, mapped.clusters, MappingOptions(seed=1))
    assert not (state / "0").exists()


RUN = """
import sys
from pathlib import Path
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.output import largest_first, numbered
from colmap_netvlad.mapping.parallel import reconstruct_parallel
if __name__ == "__main__":
    options = MappingOptions(cluster_size=12, threads=1)
    _, report = reconstruct_parallel(Path(sys.argv[1]), None, Path(sys.argv[2]), options)
    print(report.reused)
"""


def test_killed_in_each_stage_and_run_again_ends_with_the_same_figures(
    mapped: Mapped, tmp_path: Path
) -> None:
    script = tmp_path / "run.py"
    script.write_text(RUN)
    output, state = tmp_path / "sparse", tmp_path / ".sparse.clusters"
    every = [state / str(number) for number in range(len(mapped.clusters))]

    def start() -> subprocess.Popen[str]:
        command = [sys.executable, script, mapped.database, output]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def kill_when(condition: Callable[[], bool]) -> None:
        with start() as process:
            while not condition():
                assert process.poll() is None
                time.sleep(0.01)
            process.send_signal(signal.SIGKILL)
        assert not output.exists()

    kill_when(lambda: any(tmp_path.glob(".sparse.*")))  # before the graph is cut
    kill_when(lambda: every[0].exists())  # clusters are being mapped
    kill_when(lambda: all(path.exists() for path in every))  # clusters are being merged
    with start() as process:
        told, _ = process.communicate()
    assert process.returncode == 0
    assert told == f"{len(every)}\n"
    model = pycolmap.Reconstruction(output / "0")
    assert model.num_reg_images() == mapped.model.num_reg_images()
    assert model.num_points3D() == mapped.model.num_points3D()
    assert model.compute_mean_reprojection_error() == pytest.approx(
        mapped.model.compute_mean_reprojection_error(), rel=1e-6
    )
    assert offsets(centres(model), centres(mapped.model)).max() < 1e-6


def test_ctrl_c_ends_the_workers_and_leaves_no_output(mapped: Mapped, tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(RUN)
    output, state = tmp_path / "sparse", tmp_path / ".sparse.clusters"
    with subprocess.Popen(
        [sys.executable, script, mapped.database, output], stderr=subprocess.PIPE
    ) as process:
        while not any(state.glob("*.part/cluster.db")):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        assert b"KeyboardInterrupt" in process.stderr.read()  # ends when no worker holds it open
    assert process.returncode != 0
    assert not output.exists()
    assert [path.name for path in state.iterdir()] == ["fingerprint"]


@pytest.mark.parametrize("mapper", ["hierarchical", "global", "auto"])
def test_other_mappers_write_the_same_layout(mapper: str, mapped: Mapped, tmp_path: Path) -> None:
    options = MappingOptions(cluster_size=24, threads=2)
    models = MAPPERS[mapper](mapped.database, None, tmp_path / "sparse", options)
    assert [model.num_reg_images() for model in models] == [32]
    assert pycolmap.Reconstruction(tmp_path / "sparse/0").num_reg_images() == 32
    with pytest.raises(InputError, match="exists already"):
        MAPPERS[mapper](mapped.database, None, tmp_path / "sparse", options)


def write_eleven_models(advance: Callable[[int], None], request: object, folder: Path) -> None:
    for number in range(11):
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(
            pycolmap.Camera.create_from_model_name(number + 1, "SIMPLE_PINHOLE", 9.0, 9, 9)
        )
        (folder / str(number)).mkdir()
        model.write(folder / str(number))


def test_eleven_models_come_in_the_order_of_their_numbers(mapped: Mapped, tmp_path: Path) -> None:
    output = tmp_path / "sparse"
    models = pipelines._map("somehow", write_eleven_models, mapped.database, None, output)
    assert [list(model.cameras) for model in models] == [[number + 1] for number in range(11)]


def test_the_largest_model_is_the_first(tmp_path: Path) -> None:
    for number, gone in enumerate((20, 0, 20, 10)):
        model = grid_model(5)
        for frame_id in list(model.reg_frame_ids())[:gone]:
            model.deregister_frame(frame_id)
        (tmp_path / str(number)).mkdir()
        model.write(tmp_path / str(number))
    sizes = [25, 15, 5, 5]
    assert [model.num_reg_images() for model in largest_first(tmp_path)] == sizes
    written = [pycolmap.Reconstruction(path).num_reg_images() for path in numbered(tmp_path)]
    assert written == sizes
    assert sorted(path.name for path in tmp_path.iterdir()) == list("0123")
