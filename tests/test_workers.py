"""Jobs in processes of their own: one that crashes loses its own work only."""

import logging
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pycolmap
import pytest

from colmap_netvlad.colmap import engine
from colmap_netvlad.runtime import processes, workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.jobs import AHEAD, Enclosed, Job, Shares, Source


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


def is_deaf(share: Sequence[int] = ()) -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def be_deaf(advance: Callable[[int], None]) -> None:
    assert is_deaf()


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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signal masks")
def test_a_worker_that_loads_is_not_interrupted_and_this_process_is() -> None:
    """Ctrl-C reaches the whole group; a worker interrupted while it imports prints a traceback."""
    (outcome,) = workers.run([Job(be_deaf, ())], 1, lambda count: None)
    assert outcome.fault is None
    assert list(workers.results(is_deaf, [1], 1)) == [True]
    assert not is_deaf()
    heard = []
    before = signal.signal(signal.SIGTERM, lambda *arguments: heard.append("after"))
    try:
        with processes._heard_later():
            os.kill(os.getpid(), signal.SIGTERM)
            heard.append("in the block")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == ["in the block", "after"]


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


def double(numbers: list[int]) -> list[int]:
    if min(numbers) < 0:
        raise InputError(f"{min(numbers)} is negative.")
    return [2 * number for number in numbers]


def die_at(at: int, numbers: list[int]) -> list[int]:
    if at in numbers:
        os.kill(os.getpid(), 9)
    return numbers


class Watched(list[int]):
    """Says how far it was read."""

    taken = 0

    def __getitem__(self, part):  # type: ignore[override, no-untyped-def]
        self.taken = max(self.taken, part.stop)
        return super().__getitem__(part)


def test_results_of_many_shares_come_from_few_processes() -> None:
    numbers = Watched(range(40))
    results = workers.results(double, numbers, 2)
    first = next(results)
    assert numbers.taken <= 2 * AHEAD + 2  # no more wait than are soon worked at
    assert sorted([*first, *(number for result in results for number in result)]) == list(
        range(0, 80, 2)
    )


def wait_until_unwanted(share: Sequence[int]) -> int:
    start = time.monotonic()
    while share[0] and not workers.unwanted() and time.monotonic() - start < 60:
        time.sleep(0.01)
    return share[0]


def test_shares_whose_results_nobody_waits_for_can_stop() -> None:
    results = workers.results(wait_until_unwanted, range(20), 2)
    assert next(results) == 0
    start = time.monotonic()
    results.close()
    assert time.monotonic() - start < 5
    assert not workers.unwanted()


def test_what_a_share_raises_ends_the_work() -> None:
    with pytest.raises(InputError, match=r"-1 is negative\."):
        list(workers.results(double, [1, 2, -1, *range(100)], 1))


def test_a_process_that_is_killed_is_said_and_results_before_it_come() -> None:
    came: list[int] = []
    with pytest.raises(InputError, match="crashed or was killed"):
        for result in workers.results(partial(die_at, 5), range(9), 1):
            came += result
    assert came and 5 not in came


def test_shares_grow_until_they_take_as_long_as_they_should_and_end_small() -> None:
    shares, sizes = Shares(range(10_000), first=10, seconds=30.0), []
    while shares:
        share = shares.next(workers=4)
        sizes.append(len(share))
        shares.learn(len(share), len(share) * 0.03)  # 1,000 would take 30 s
    assert sum(sizes) == 10_000
    assert sizes[:5] == [10, 40, 160, 640, 1000]
    assert sizes[-2] == 10, "all workers end together"


def test_shares_of_a_fixed_size() -> None:
    shares = Shares("abcdefgh", first=3, seconds=None)
    assert [shares.next(1), shares.next(1), shares.next(1), bool(shares)] == ["abc", "def", "gh", 0]


def read_part(path: Path, share: list[int]) -> str:
    return f"{path.name} {share}"


def test_this_machine_s_processes_work_at_the_source_itself(tmp_path: Path) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("a part was made")

    source = Source(tmp_path / "whole.db", refuse)
    (result,) = workers.results(read_part, [1, 2], 1, source=source, first=2)
    assert result == "whole.db [1, 2]"


def test_a_stream_is_one_share_of_this_process() -> None:
    def count(share: list[int]) -> Iterator[int]:
        yield len(share)
        yield os.getpid()

    assert list(workers.stream(count, [1, 2, 3])) == [3, os.getpid()]


def test_an_enclosed_file_goes_along_when_it_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "model.bin"
    path.write_bytes(b"weights")
    here = Enclosed(path)
    with here.opened() as opened:
        assert opened == path
    there = pickle.loads(pickle.dumps(here))
    path.unlink()
    with there.opened() as opened:
        assert opened.name == "model.bin" and opened.read_bytes() == b"weights"
    assert not opened.exists()
