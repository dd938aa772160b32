"""Jobs in processes of their own: one that crashes loses its own work only."""

import os
from collections.abc import Callable

from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.workers import Job


def succeed(advance: Callable[[int], None], count: int) -> None:
    advance(count)
    advance(1)


def complain(advance: Callable[[int], None]) -> None:
    raise InputError("The disk is full.")


def stumble(advance: Callable[[int], None]) -> None:
    raise ValueError("no such thing")


def crash(advance: Callable[[int], None], code: int) -> None:
    os._exit(code)


def vanish(advance: Callable[[int], None]) -> None:
    os.kill(os.getpid(), 9)


def test_faults_and_crashes_are_told_apart_and_lose_no_other_job() -> None:
    jobs = [
        Job(complain, ()),
        Job(stumble, ()),
        Job(crash, (7,)),
        Job(vanish, ()),
        Job(succeed, (4,)),
    ]
    done: list[int] = []
    ended: dict[int, str | None] = {}
    outcomes = workers.run(
        jobs, 2, done.append, lambda n, outcome: ended.update({n: outcome.fault})
    )
    assert [outcome.fault for outcome in outcomes] == [
        "The disk is full.",
        "ValueError: no such thing",
        "its process crashed (exit code 7)",
        "its process was killed, by the system for want of memory perhaps",
        None,
    ]
    assert sum(done) == 5
    assert ended == dict(enumerate(outcome.fault for outcome in outcomes))
    assert outcomes[4].peak_bytes > 0


def test_no_jobs_are_no_work() -> None:
    assert workers.run([], 4, lambda count: None) == []
