"""Processors and memory are those of the container, where there is one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from colmap_netvlad.runtime import machine

GIB = 2**30


@pytest.fixture(autouse=True)
def large_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """16 processors, 64 GiB, and an empty tree of control groups."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)), raising=False)
    monkeypatch.setattr(machine, "_machine_bytes", lambda: 64.0 * GIB)
    monkeypatch.setattr(machine, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "MEMBERSHIP", tmp_path / "membership")


def write(tmp_path: Path, membership: str, files: dict[str, str]) -> None:
    (tmp_path / "membership").write_text(membership)
    for name, content in files.items():
        path = tmp_path / "cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content + "\n")


def test_without_control_groups_the_machine_is_ours() -> None:
    assert machine.usable_processors() == 16
    assert machine.usable_memory() == 64 * GIB


def test_a_container_of_version_2_sees_itself_at_the_root(tmp_path: Path) -> None:
    write(tmp_path, "0::/\n", {"cpu.max": "250000 100000", "memory.max": f"{4 * GIB}"})
    assert machine.usable_processors() == 3
    assert machine.usable_memory() == 4 * GIB


def test_the_tightest_of_the_groups_around_us_counts(tmp_path: Path) -> None:
    files = {
        "user.slice/job/cpu.max": "max 100000",
        "user.slice/job/memory.max": f"{6 * GIB}",
        "user.slice/cpu.max": "200000 100000",
        "user.slice/memory.max": f"{3 * GIB}",
        "other/cpu.max": "100000 100000",
        "other/memory.max": "1024",
    }
    write(tmp_path, "0::/user.slice/job\n", files)
    assert machine.usable_processors() == 2
    assert machine.usable_memory() == 3 * GIB


def test_version_1_keeps_each_controller_apart(tmp_path: Path) -> None:
    membership = "5:memory:/docker/abc\n4:cpu,cpuacct:/docker/abc\n1:name=systemd:/docker/abc\n"
    files = {
        "cpu/cpu.cfs_quota_us": "150000",
        "cpu/cpu.cfs_period_us": "100000",
        "memory/memory.limit_in_bytes": f"{2 * GIB}",
    }
    write(tmp_path, membership, files)
    assert machine.usable_processors() == 2
    assert machine.usable_memory() == 2 * GIB


def test_no_limit_is_no_limit(tmp_path: Path) -> None:
    membership = "5:memory:/\n4:cpu,cpuacct:/\n0::/\n"
    files = {
        "cpu.max": "max 100000",
        "memory.max": "max",
        "cpu/cpu.cfs_quota_us": "-1",
        "cpu/cpu.cfs_period_us": "100000",
        "memory/memory.limit_in_bytes": "9223372036854771712",
    }
    write(tmp_path, membership, files)
    assert machine.usable_processors() == 16
    assert machine.usable_memory() == 64 * GIB


def test_a_part_of_a_processor_is_one(tmp_path: Path) -> None:
    write(tmp_path, "0::/\n", {"cpu.max": "20000 100000"})
    assert machine.usable_processors() == 1
