"""Jobs in processes of their own: one that crashes loses its own work only."""

import logging
import os
from collections.abc import Callable, Iterator
from functools import partial

import pycolmap
import pytest

from colmap_netvlad.colmap import engine
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


def remember(value: int) -> None:
    global remembered
    remembered = value


def recall(advance: Callable[[int], None]) -> None:
    raise InputError(str(remembered))


def test_the_initialiser_runs_in_each_worker_before_its_job() -> None:
    outcomes = workers.run(
        [Job(recall, ()), Job(recall, ())], 2, lambda count: None, initialiser=partial(remember, 7)
    )
    assert [outcome.fault for outcome in outcomes] == ["7", "7"]


def log_level(advance: Callable[[int], None]) -> None:
    level = logging.getLogger("colmap_netvlad").level
    raise InputError(f"{level} {pycolmap.logging.minloglevel}")


def test_a_worker_is_as_talkative_as_its_parent(monkeypatch) -> None:
    said = []
    for level in (logging.INFO, logging.DEBUG):
        monkeypatch.setattr(logging.getLogger("colmap_netvlad"), "level", level)
        logging.getLogger("colmap_netvlad").manager._clear_cache()
        (outcome,) = workers.run(
            [Job(log_level, ())], 1, lambda count: None, initialiser=engine.initialiser()
        )
        said.append(outcome.fault)
    assert said == ["20 3", "10 0"]


def double(number: int) -> int:
    if number < 0:
        raise InputError(f"{number} is negative.")
    return 2 * number


def die_at(at: int, number: int) -> int:
    if number == at:
        os.kill(os.getpid(), 9)
    return number


def test_results_of_many_tasks_come_from_few_processes() -> None:
    taken = []

    def tasks() -> Iterator[int]:
        for number in range(40):
            taken.append(number)
            yield number

    results = workers.results(double, tasks(), 2)
    first = next(results)
    assert len(taken) <= 2 * workers.AHEAD + 2  # no more wait than are soon worked at
    assert sorted([first, *results]) == list(range(0, 80, 2))


def test_what_a_task_raises_ends_the_work() -> None:
    with pytest.raises(InputError, match=r"-1 is negative\."):
        list(workers.results(double, [1, 2, -1, *range(100)], 1))


def test_a_process_that_is_killed_is_said_and_results_before_it_come() -> None:
    came = []
    with pytest.raises(InputError, match="crashed or was killed"):
        for result in workers.results(partial(die_at, 5), range(9), 1):
            came.append(result)
    assert came and 5 not in came
