"""The descriptor cache: nothing computed twice, nothing lost, nothing corrupted."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import textwrap
import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from colmap_netvlad.cache.cells import Cells
from colmap_netvlad.cache.store import Store, remembered_images
from colmap_netvlad.retrieval.described import missing
from colmap_netvlad.runtime.errors import InputError


def unit_vectors(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "project.netvlad.db"


def test_descriptors_come_back_in_the_order_asked_for(cache: Path) -> None:
    vectors = unit_vectors(3, 64)
    with Store(cache) as store:
        store.add_descriptors("m", ["a", "b", "c"], ["1", "2", "3"], vectors, 0.3)
    with Store(cache) as store:
        stored = store.vectors("m", ["c", "a"])
        assert stored.shape == (2, 64)
        np.testing.assert_allclose(stored[0:2], vectors[[2, 0]], atol=3e-3)
        assert store.seconds("m", ["a", "b"]) == pytest.approx(0.2)


@pytest.mark.parametrize(("dim", "most"), [(512, 2e-3), (4096, 1e-3), (32768, 1e-3)])
def test_a_byte_a_value_changes_inner_products_little(cache: Path, dim: int, most: float) -> None:
    vectors = unit_vectors(40, dim)
    with Store(cache) as store:
        names = [str(i) for i in range(40)]
        store.add_descriptors("m", names, names, vectors, 0)
        kept = store.read_vectors("m", names)
    assert np.abs(kept @ kept.T - vectors @ vectors.T).max() < most


def test_only_new_and_changed_photos_are_missing(cache: Path) -> None:
    with Store(cache) as store:
        store.add_descriptors("m", ["a", "b"], ["1", "2"], unit_vectors(2, 8), 0)
        assert missing(store, "m", {"a": "1", "b": "2"}) == []
        assert missing(store, "m", {"a": "1", "b": "changed", "new": "3"}) == ["b", "new"]
        assert missing(store, "other model", {"a": "1"}) == ["a"]


def test_a_changed_photo_replaces_its_old_descriptor(cache: Path) -> None:
    old, new = unit_vectors(2, 8)
    with Store(cache) as store:
        store.add_descriptors("m", ["a"], ["1"], old[None], 0)
        store.add_descriptors("m", ["a"], ["2"], new[None], 0)
        assert store.described("m") == {"a": "2"}
        np.testing.assert_allclose(store.read_vectors("m", ["a"])[0], new, atol=5e-3)


def test_equal_basenames_in_different_folders_are_kept_apart(cache: Path) -> None:
    vectors = unit_vectors(2, 8)
    with Store(cache) as store:
        store.add_descriptors("m", ["east/1.jpg", "west/1.jpg"], ["x", "y"], vectors, 0)
        np.testing.assert_allclose(
            store.read_vectors("m", ["west/1.jpg"])[0], vectors[1], atol=5e-3
        )


def test_settings_are_remembered_and_reading_them_makes_no_file(cache: Path) -> None:
    assert remembered_images(cache) is None
    assert not cache.exists()
    with Store(cache) as store:
        store.remember("images", "photos")
    assert remembered_images(cache) == cache.parent / "photos"


def test_a_cache_of_another_version_is_refused(cache: Path) -> None:
    Store(cache).close()
    with closing(sqlite3.connect(cache)) as connection:
        connection.execute("PRAGMA user_version = 99")
    with pytest.raises(InputError, match=r"format 99.*delete"):
        Store(cache)


def test_a_file_that_is_not_sqlite_is_called_damaged(cache: Path) -> None:
    cache.write_bytes(b"not a database at all" * 100)
    with pytest.raises(InputError, match=r"damaged.*delete it"):
        Store(cache)


def test_a_cache_damaged_inside_is_called_damaged(cache: Path) -> None:
    with Store(cache) as store:
        names = [str(i) for i in range(20)]
        store.add_descriptors("m", names, names, unit_vectors(20, 4096), 0)
    with closing(sqlite3.connect(cache)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    data = bytearray(cache.read_bytes())
    data[32768:] = b"\xab" * (len(data) - 32768)
    cache.write_bytes(data)
    with pytest.raises(InputError, match="damaged"), Store(cache) as store:
        store.read_vectors("m", names)


def test_another_sqlite_file_is_never_taken_for_a_cache(cache: Path) -> None:
    with closing(sqlite3.connect(cache)) as connection:
        connection.execute("CREATE TABLE images (name TEXT)")
    before = cache.read_bytes()
    with pytest.raises(InputError, match="not a cache"):
        Store(cache)
    assert cache.read_bytes() == before


def test_a_place_that_cannot_be_written_is_said_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="`cache`"):
        Store(tmp_path / "no such folder" / "project.netvlad.db")


def test_a_full_disk_is_said_and_what_was_there_stays(cache: Path) -> None:
    with Store(cache) as store:
        store.add_descriptors("m", ["a"], ["1"], unit_vectors(1, 64), 0)
        pages = store._pragma("page_count")
        store._db.execute(f"PRAGMA max_page_count = {pages}")
        names = [str(i) for i in range(50)]
        with pytest.raises(InputError, match="disk is full"):
            store.add_descriptors("m", names, names, unit_vectors(50, 4096), 0)
    with Store(cache) as store:
        assert store.described("m") == {"a": "1"}


WRITER = """
    import sys
    from pathlib import Path
    import numpy as np
    from colmap_netvlad.cache.cells import Cells
    from colmap_netvlad.cache.store import Store
    me = sys.argv[2]
    cells = [Cells(np.ones((2, 2, 4), np.int8))] * 4
    with Store(Path(sys.argv[1])) as store:
        for batch in range(int(sys.argv[3])):
            names = [f"{me}-{batch}-{i}" for i in range(4)]
            vectors = np.full((4, 512), 0.5, np.float32)
            store.add_descriptors("m", names, names, vectors, 0, cells)
            store.number("features", dict(zip(names, names)))
            print(batch, flush=True)
"""


def writer(cache: Path, name: str, batches: int) -> subprocess.Popen[str]:
    code = textwrap.dedent(WRITER)
    command = [sys.executable, "-c", code, str(cache), name, str(batches)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_two_processes_writing_at_once_lose_nothing(cache: Path) -> None:
    processes = [writer(cache, name, 30) for name in ("one", "two")]
    for process in processes:
        process.communicate(timeout=120)
        assert process.returncode == 0
    with Store(cache) as store:
        assert len(store.described("m")) == 2 * 30 * 4
        assert store._db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"


def test_two_processes_that_describe_the_same_photos_leave_each_others_cells(cache: Path) -> None:
    first = writer(cache, "same", 30)
    assert first.stdout is not None and first.stdout.readline() == "0\n"
    second = writer(cache, "same", 30)
    names = [f"same-0-{i}" for i in range(4)]
    with Store(cache) as store:
        before = [store.cell_numbers(kind)[name] for kind in ("m", "features") for name in names]
        for process in (first, second):
            process.communicate(timeout=120)
            assert process.returncode == 0
        after = [store.cell_numbers(kind)[name] for kind in ("m", "features") for name in names]
        assert after == before
        assert store.read_cells(before[0]).codes.shape == (2, 2, 4)
        assert len(store.cell_numbers("m")) == len(store.cell_numbers("features")) == 30 * 4


def test_cells_that_another_run_replaced_are_no_damage(cache: Path) -> None:
    cells = [Cells(np.ones((2, 2, 4), np.int8))]
    with Store(cache) as store, Store(cache) as other:
        store.add_descriptors("m", ["a"], ["1"], unit_vectors(1, 8), 0, cells)
        number = store.cell_numbers("m")["a"]
        other.add_descriptors("m", ["a"], ["changed"], unit_vectors(1, 8), 0, cells)
        assert store.cell_numbers("m")["a"] != number
        with pytest.raises(InputError, match=r"Another run has changed .*run the command again"):
            store.read_cells(number)


def test_a_new_cache_waits_for_another_process_that_makes_it_too(cache: Path) -> None:
    other = sqlite3.connect(cache, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    other.execute("CREATE TABLE half (made INTEGER)")
    done = threading.Timer(0.5, lambda: other.execute("ROLLBACK"))
    done.start()
    with Store(cache) as store:
        assert store.described("m") == {}
    done.join()
    other.close()


def test_a_killed_run_leaves_whole_batches_only(cache: Path) -> None:
    process = writer(cache, "one", 100_000)
    assert process.stdout is not None
    for _ in range(5):
        process.stdout.readline()
    process.kill()
    process.communicate(timeout=60)
    with Store(cache) as store:
        count = len(store.described("m"))
        assert count >= 5 * 4
        assert count % 4 == 0
        assert store._db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
