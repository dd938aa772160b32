"""Many machines: three nodes of a real Ray cluster, one of which is killed in every stage."""

from __future__ import annotations

import logging
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner, Result

from colmap_netvlad.cache.store import Store
from colmap_netvlad.cli import cli
from colmap_netvlad.colmap import features
from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.mapping import parallel
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.mapping.partition import Cluster
from colmap_netvlad.matching import blocks
from colmap_netvlad.matching import colmap as matching
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.matching.run import match_pairs
from colmap_netvlad.photos.folders import photo_folders
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.methods import deep
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.retrieval.rank import rank_project
from colmap_netvlad.runtime import cluster, progress, workers
from colmap_netvlad.runtime.cluster import on_cluster
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.jobs import Capacity, Job, Load, Source

os.environ["RAY_AUTH_MODE"] = "disabled"  # else Ray keeps a token in the home folder
ray = pytest.importorskip("ray", reason="Ray is not installed: pip install colmap-netvlad[cluster]")
ray_tasks = pytest.importorskip("colmap_netvlad.runtime.ray_tasks")
ray_files = pytest.importorskip("colmap_netvlad.runtime.ray_files")
cluster_utils = pytest.importorskip("ray.cluster_utils")

MakeProject = Callable[..., Project]
LEAVE_SECONDS = 5.0
"""Ctrl-C takes less than 2 s; a busy machine has some more."""

NODE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
QUICK_TO_MISS = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 10_000,  # one that is only slow is not
    "health_check_failure_threshold": 5,
}
"""Ray's own way takes half a minute to see that a machine is gone."""


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The temporary disk of all machines."""
    return tmp_path_factory.mktemp("scratch")


@pytest.fixture(scope="module")
def machines(scratch: Path) -> Iterator[Any]:
    """A head and two nodes more, a processor each."""
    NODE["env_vars"] = {"TMPDIR": str(scratch)}
    made = cluster_utils.Cluster(
        initialize_head=True,
        head_node_args={**NODE, "include_dashboard": False, "_system_config": QUICK_TO_MISS},
    )
    try:
        made.add_node(**NODE)
        made.add_node(**NODE)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


@pytest.fixture(scope="module")
def connected(machines: Any) -> Iterator[Any]:
    """The same, and this process is its driver."""
    ray.init(address=machines.address, log_to_driver=False, logging_level="ERROR")
    yield machines
    ray.shutdown()


@pytest.fixture
def losing_a_node(connected: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Work goes to the cluster in small shares, and a node is killed when the first comes back."""
    if len(connected.worker_nodes) < 2:
        connected.add_node(**NODE)
    handed_back, lost = ray_tasks._handed_back, []

    def lose_a_node(ended: Any) -> Any:
        if not lost:
            node = next(iter(connected.worker_nodes))
            lost.append(node.unique_id)
            connected.remove_node(node, allow_graceful=False)
        return handed_back(ended)

    monkeypatch.setattr(ray_tasks, "_handed_back", lose_a_node)
    monkeypatch.setattr(ray_tasks, "TASK_SECONDS", 0.1)
    monkeypatch.setattr(matching, "CHUNK_SECONDS", 0.1)
    monkeypatch.setattr(matching, "FIRST_CHUNK", 4)
    monkeypatch.setattr(features, "SHARE_PHOTOS", 1)
    monkeypatch.setattr(blocks, "BLOCK", 4)
    for module in (matching, blocks):
        monkeypatch.setattr(module, "WORTH_A_PROCESS", 4)
    with on_cluster(connected.address):
        yield lost
    assert lost, "no work went to the cluster"


def tables(database: Path) -> dict[str, list[str]]:
    """Every row of every table, in any order."""
    with closing(sqlite3.connect(database)) as connection:
        names = connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        )
        return {
            name: sorted(map(repr, connection.execute(f'SELECT * FROM "{name}"')))
            for (name,) in names.fetchall()
        }


def here(work: Callable[[], Any]) -> Any:
    """Do some work on this machine."""
    with workers.using(workers.HERE):
        return work()


def some_pairs(database: Path, images: int = 9) -> list[tuple[str, str]]:
    names = image_names(database)[:images]
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]


# Equal to one machine, though a node is lost in every stage


@pytest.mark.parametrize("camera", ["auto", "per-image"])
def test_features(
    camera: str, losing_a_node: list[str], flight: RenderedFlight, tmp_path: Path
) -> None:
    options = FeatureOptions(camera, max_features=300)
    one, many = tmp_path / "one.db", tmp_path / "many.db"
    report = extract_features(flight.images, many, options)
    assert report == here(lambda: extract_features(flight.images, one, options))
    assert tables(one) == tables(many)
    again = extract_features(flight.images, many, options)
    assert (again.already, again.extracted) == (12, 0)


def test_descriptors_and_ranking(
    losing_a_node: list[str], project_copy: MakeProject, tiny_checkpoint: Path
) -> None:
    options = RetrievalOptions(k=5, batch_size=1)
    one, many = project_copy(name="one"), project_copy(name="many")
    ranking = rank_project(many, str(tiny_checkpoint), options)
    wanted = here(lambda: rank_project(one, str(tiny_checkpoint), options))
    assert np.array_equal(ranking.partners, wanted.partners)
    assert np.array_equal(ranking.scores, wanted.scores)
    assert ranking.left_out == wanted.left_out == ()
    with Store(many.cache) as store:
        assert len(store.photos()) == 12


@pytest.mark.parametrize("matcher", ["colmap", "guided"])
def test_matches(matcher: str, losing_a_node: list[str], project_copy: MakeProject) -> None:
    one, many = (project_copy(name=name).database for name in ("one", "many"))
    report = match_pairs(many, some_pairs(many), MatchOptions(matcher))
    alone = MatchOptions(matcher, processes=1)
    wanted = here(lambda: match_pairs(one, some_pairs(one), alone))
    assert (report.matched, report.verified) == (wanted.matched, wanted.verified)
    assert tables(one) == tables(many)


def test_clusters(losing_a_node: list[str], matched_database: Path, tmp_path: Path) -> None:
    options = MappingOptions(threads=1)
    names = image_names(matched_database)
    clusters = [Cluster(names[at : at + 6], names[at : at + 6]) for at in (0, 2, 4, 6)]
    models = {}
    for name, run in (("many", lambda do: do()), ("one", here)):
        state = tmp_path / name
        state.mkdir()
        report = run(
            lambda state=state: parallel.map_clusters(matched_database, clusters, state, options)
        )
        assert [cluster.fault for cluster in report.clusters] == [None] * len(clusters)
        assert report.peak_bytes > 0
        models[name] = [
            pycolmap.Reconstruction(path).summary() for path in sorted(state.glob("*/[0-9]"))
        ]
    assert models["many"] == models["one"] and models["one"]


# Photos that the machines do not see


@pytest.fixture
def unseen(
    connected: Any, flight: RenderedFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Path], Path]]:
    """Returns paths to folders that this process alone sees; work goes on in small shares."""
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs Linux's /proc")
    monkeypatch.setattr(ray_tasks, "TASK_SECONDS", 0.1)
    monkeypatch.setattr(features, "SHARE_PHOTOS", 1)
    opened: list[int] = []

    def hide(folder: Path) -> Path:
        opened.append(os.open(folder, os.O_RDONLY))
        return Path(f"/proc/self/fd/{opened[-1]}")

    with on_cluster(connected.address):
        yield hide
    for folder in opened:
        os.close(folder)


def make_masks(flight: RenderedFlight, folder: Path) -> Path:
    """Masks that hide the left half; of some photos under the other name."""
    for number, name in enumerate(flight.names):
        mask = np.full((300, 400), 255, np.uint8)
        mask[:, :200] = 0
        target = folder / (f"{name}.png" if number % 2 else f"{Path(name).stem}.png")
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), mask)
    return folder


def left_behind(scratch: Path) -> list[Path]:
    return list(scratch.glob(".colmap-netvlad.*"))


@pytest.mark.parametrize("masked", [False, True])
def test_features_of_photos_that_are_sent(
    masked: bool,
    unseen: Callable[[Path], Path],
    flight: RenderedFlight,
    scratch: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    masks = make_masks(flight, tmp_path / "masks") if masked else None
    options = FeatureOptions(max_features=300, masks=masks)
    hidden = replace(options, masks=masks and unseen(masks))
    one, many = tmp_path / "one.db", tmp_path / "many.db"
    folder = unseen(flight.images)
    report = extract_features(folder, many, hidden)
    assert report == here(lambda: extract_features(flight.images, one, options))
    assert tables(one) == tables(many)
    said = [text for text in caplog.messages if "does not see" in text]
    sizes = [(flight.images / name).stat().st_size for name in flight.names]
    if masks is not None:
        sizes += [mask.stat().st_size for mask in masks.rglob("*.png")]
    mib = f"{sum(sizes) / 2**20:.1f} MiB"
    assert len(said) == 1 and said[0].startswith("The machine ")
    assert said[0].endswith(
        f"see {folder}: photos are sent there, at most {len(sizes)} files ({mib})."
    )
    assert not left_behind(scratch)


def test_descriptors_of_photos_that_are_sent(
    unseen: Callable[[Path], Path],
    project_copy: MakeProject,
    tiny_checkpoint: Path,
    scratch: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One of them vanishes once it is known to be there, one is no more a photo."""
    options, contents = RetrievalOptions(k=5, batch_size=1), deep.photo_contents
    rankings = []
    for name, hide, run in (("many", unseen, lambda do: do()), ("one", lambda path: path, here)):
        project = project_copy(name=name, copy_photos=True)
        gone, broken, *_ = sorted(path.name for path in project.images.iterdir())
        (project.images / broken).write_bytes(b"no photo")

        def lose_one(*arguments: Any, gone: Path = project.images / gone) -> Any:
            found = contents(*arguments)
            gone.unlink()
            return found

        monkeypatch.setattr(deep, "photo_contents", lose_one)
        sent = Project(project.database, hide(project.images))
        rankings.append(run(lambda sent=sent: rank_project(sent, str(tiny_checkpoint), options)))
    ranking, wanted = rankings
    assert dict(ranking.left_out) == {gone: "is missing", broken: "is not a photo"}
    assert ranking.left_out == wanted.left_out
    assert np.array_equal(ranking.partners, wanted.partners)
    assert np.array_equal(ranking.scores, wanted.scores)
    assert not left_behind(scratch)


def test_a_stopped_run_leaves_no_photos_behind(
    unseen: Callable[[Path], Path], flight: RenderedFlight, scratch: Path, tmp_path: Path
) -> None:
    class Stopped:
        def advance(self, count: int = 1) -> None:
            if title == "Extracting features":
                raise KeyboardInterrupt  # with other shares under way, unless they have just ended

    @contextmanager
    def reporter(name: str, total: int) -> Iterator[Stopped]:
        nonlocal title
        title = name
        yield Stopped()

    title = ""
    options = FeatureOptions()
    with progress.report_to(reporter), pytest.raises(KeyboardInterrupt):
        extract_features(unseen(flight.images), tmp_path / "project.db", options)
    assert not left_behind(scratch)


def test_shares_that_are_sent_are_cut_by_what_they_weigh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, size in (("a", 4), ("b", 4), ("c", 9), ("d", 0)):
        (tmp_path / name).write_bytes(b"x" * size)
    parcels = ray_files.Parcels(photo_folders(tmp_path, None), ["a", "b", "c", "d"])
    names = ["a", "b", "c", "d", "gone", "../a"]
    assert [parcels.fitting(names[at:], 8) for at in range(5)] == [2, 1, 1, 3, 2]
    monkeypatch.setattr(ray_files, "SENT_BYTES", 4)
    assert parcels.fitting(names, 8) == 1
    assert [file.name for file in parcels.files(names)] == ["a", "b", "c", "d"]


# The command line


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_every_command_that_takes_a_cluster_takes_it(
    connected: Any, flight: RenderedFlight, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    database, where = tmp_path / "project.db", ("--cluster", connected.address)
    for arguments in (
        ("features", "--images", flight.images, "--max-features", 1000),
        ("pairs", "--model", tiny_checkpoint, "--k", 4),
        ("match",),
        ("reconstruct", "--mapper", "parallel", "--cluster-size", 12),
        ("compare", "--methods", "vlad", "--k", 3, "--no-reconstruct"),
    ):
        result = run(*arguments, "--db", database, *where)
        assert result.exit_code == 0, result.output
    assert pycolmap.Reconstruction(tmp_path / "sparse" / "0").num_reg_images() == 12


# Stopped and gone on


SLOW = """
import sys, time
from pathlib import Path
from colmap_netvlad.cli import main
from colmap_netvlad.matching import colmap as matching
from colmap_netvlad.runtime import ray_tasks

match_chunk = matching._match_chunk

def slowly(seed, database, pairs):
    time.sleep(0.5)
    return match_chunk(seed, database, pairs)

if __name__ == "__main__":
    matching._match_chunk = slowly
    matching.WORTH_A_PROCESS = matching.FIRST_CHUNK = 2
    matching.CHUNK_SECONDS = ray_tasks.TASK_SECONDS = 0.01
    main()
"""


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_driver_goes_on_where_it_was(
    stop: signal.Signals, machines: Any, project_copy: MakeProject, tmp_path: Path
) -> None:
    project, script = project_copy(), tmp_path / "slow.py"
    pairs = some_pairs(project.database)
    project.pairs.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    script.write_text(SLOW)
    arguments = ["match", "--db", project.database, "--cluster", machines.address]
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    driver = subprocess.Popen(
        [sys.executable, script, *arguments],
        env={**os.environ, "PYTHONPATH": path},
        stderr=subprocess.PIPE,
        text=True,
    )
    while not matched(project.database):
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.05)
    driver.send_signal(stop)
    start = time.monotonic()
    _, said = driver.communicate()
    # Of a task that ends as it is cancelled Ray itself crashes now and then, on a loaded machine.
    if stop is signal.SIGINT and "likely discovered a bug in Ray" not in said:
        assert said.strip() == "Aborted!" and driver.returncode == 1
        assert time.monotonic() - start < LEAVE_SECONDS
    before = matched(project.database)
    assert 0 < before < len(pairs)
    report = match_pairs(project.database, pairs)
    assert (report.already, report.matched) == (before, len(pairs) - before)
    other = project_copy(name="other").database
    match_pairs(other, pairs)
    assert tables(other) == tables(project.database)


def matched(database: Path) -> int:
    with open_database(database) as colmap:
        return len(colmap.matched_pairs())


# What a task asks of its machine


MACHINES = [
    {"CPU": 16.0, "memory": 64e9},
    {"CPU": 8.0, "memory": 16e9, "GPU": 2.0},
    {"memory": 16e9},
]


def test_tasks_fit_on_some_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_tasks, "_machines", lambda: MACHINES)
    assert ray_tasks.RayTasks().capacity() == Capacity(24, 96e9, 16)
    for load, fitting, slots in (
        (Load(), Load(), 24),
        (Load(memory=8e9), Load(memory=8e9), 10),
        (Load(32, 1e12), Load(16, 64e9), 1),
        (Load(gpu=True), Load(4, gpu=True), 2),  # each GPU's share of processors decodes
    ):
        assert ray_tasks._fitting(load) == fitting
        assert ray_tasks._slots(fitting) == slots
    monkeypatch.setattr(ray_tasks, "_machines", lambda: MACHINES[:1])
    assert ray_tasks._fitting(Load(gpu=True)) == Load(), "no machine has a GPU"


# What is said in a sentence


def connect(address: str) -> None:
    with on_cluster(address):
        raise AssertionError("connected")


def test_an_address_where_nobody_listens(project_copy: MakeProject) -> None:
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    start = time.monotonic()
    result = run("pairs", "--db", project_copy().database, "--cluster", address)
    assert time.monotonic() - start < 5
    assert result.exit_code == 1
    (line,) = result.output.splitlines()
    assert f"No Ray cluster listens at {address}" in line and "mend --cluster" in line


def test_an_address_where_something_else_listens() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        threading.Thread(
            target=lambda: other.accept()[0].send(b"HTTP/1.1 505"), daemon=True
        ).start()
        with pytest.raises(InputError, match="No Ray cluster listens"):
            connect(f"127.0.0.1:{other.getsockname()[1]}")


@pytest.mark.parametrize("address", ["cluster", "ray://10.0.0.1:10001", "10.0.0.1:port"])
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(InputError, match="it is auto, or HOST:PORT"):
        connect(address)


def test_ray_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install \"colmap-netvlad\[cluster\]\""):
        connect("auto")


def test_a_machine_with_another_version(connected: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "VERSION", "9.9")
    with pytest.raises(InputError, match=r"The machine \S+ \(.*\) .* this one 9\.9 with"):
        connect(connected.address)


def test_a_machine_without_the_package(connected: Any, tmp_path: Path) -> None:
    hidden = 'import sys; sys.modules["colmap_netvlad"] = None'
    (tmp_path / "sitecustomize.py").write_text(hidden)
    node = connected.add_node(**{**NODE, "env_vars": {"PYTHONPATH": str(tmp_path)}})
    try:
        with pytest.raises(InputError, match="lacks colmap-netvlad"):
            connect(connected.address)
    finally:
        connected.remove_node(node, allow_graceful=False)


def take_nothing(database: Path, arguments: Sequence[Any], target: Path) -> None:
    target.touch()


def crash_or_write(
    advance: Callable[[int], None], database: Path, folder: Path, crash: bool
) -> None:
    if crash:
        os._exit(1)
    (folder / "inner").mkdir()
    (folder / "inner" / "done").write_text(database.name)
    advance(2)


def test_a_job_that_crashes_loses_itself_only(
    connected: Any, matched_database: Path, tmp_path: Path
) -> None:
    jobs = [
        Job(crash_or_write, (crash,), Source(matched_database, take_nothing), tmp_path / f"{crash}")
        for crash in (True, False)
    ]
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # nodes do not see the tests
    done: list[int] = []
    with on_cluster(connected.address):
        outcomes = workers.run(jobs, 2, done.append)
    assert "was lost 4 times" in (outcomes[0].fault or "") and outcomes[1].fault is None
    assert (tmp_path / "False" / "inner" / "done").read_text() == "part.db"
    assert done == [2]
