"""Work done by the machines of a Ray cluster; Ray is connected (`runtime.cluster`).

Ray's tasks, not its actors: a task that is lost with its machine runs again on any other, machines
may join and leave, and nobody holds a place for nothing. What an actor would load in its
constructor a process keeps between tasks (`_order`).

Retried is what a machine did: a process or machine that is lost, an I/O fault. What our own code
says of its input is not. A loop over `ray.wait` keeps few shares under way, and fewer where the
parts of the database that they carry would fill this machine's object store.

Files in folders are read where they lie, or sent (`runtime.ray_files`).
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from colmap_netvlad.runtime import machine
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import scratch_folder
from colmap_netvlad.runtime.jobs import (
    AHEAD,
    Capacity,
    Item,
    Job,
    Load,
    Outcome,
    Result,
    Shares,
    Work,
)
from colmap_netvlad.runtime.processes import outcome_of
from colmap_netvlad.runtime.ray_files import File, Parcels, Sent, Unseen, own_name, unpacked, unseen
from colmap_netvlad.runtime.version import VERSION

TASK_SECONDS = 30.0
"""How long a task should take: long beside Ray's milliseconds, short beside a machine's life."""

RETRIES = 3
"""How often a task is run again whose process or machine is lost."""

CALLS = 100
"""Tasks after which a process is replaced: native libraries leak. Ray's own choice for tasks on
a GPU is 1, with which each would load its model."""

POLL_SECONDS = 0.5
"""How long to wait for a task before looking at Ctrl-C and at the machines."""

STORE_SHARE = 0.5
"""Share of this machine's object store that waiting parts of the database and files may take."""

CLEAR_SECONDS = 3.0
"""How long tasks that nobody waits for may take to clear up, before their processes are killed."""

ALONE_SECONDS = 60.0
"""How long to wait for a machine when none is left."""


@dataclass(frozen=True)
class Order:
    """What all tasks of one piece of work have in common."""

    function: Callable[..., Any]
    initialiser: Callable[[], None]
    take: Callable[[Path, Sequence[Any]], Any] | None
    load: Load
    places: tuple[Path | None, ...] = ()
    version: str = VERSION


@dataclass
class Done:
    """What a task hands back.

    Attributes:
        value: what the function returned.
        taken: what was written into its part of the database.
        seconds: how long the function ran, s.
    """

    value: Any
    taken: Any
    seconds: float


@dataclass(frozen=True)
class Call:
    """One task: a share, and who writes its part of the database."""

    share: Sequence[Any]
    part: Callable[[Sequence[Any], Path], None] | None = None


@dataclass
class JobDone:
    """What a job hands back: how it ended, the units done, its files by relative path."""

    outcome: Outcome
    units: int = 0
    files: dict[str, bytes] = field(default_factory=dict)


class RayTasks:
    """The machines of a cluster, as `jobs.Engine`."""

    def capacity(self) -> Capacity:
        """Return what the machines offer."""
        machines = _machines()
        processors = [resources.get("CPU", 0) for resources in machines]
        memory = sum(resources.get("memory", 0) for resources in machines)
        most = max(processors, default=1)
        return Capacity(max(1, int(sum(processors))), memory, max(1, int(most)))

    def results(
        self, work: Work[Item, Result], shares: Shares[Item], workers: int
    ) -> Generator[Result, None, None]:
        """Work at each share in a task."""
        shares.lengthen(TASK_SECONDS)
        source, load = work.source, _fitting(work.load)
        take = source.take if source else None
        order = Order(work.function, work.initialiser, take, load, work.places)
        parcels = Parcels(work.folders, shares.items)
        with contextlib.closing(_tasks(order, _calls(shares, work, load), parcels)) as tasks:
            for call, done in tasks:
                if isinstance(done, Exception):
                    raise done
                shares.learn(len(call.share), done.seconds)
                if source is not None and source.keep is not None:
                    source.keep(source.path, done.taken)
                yield done.value

    def stream(
        self, work: Work[Item, Iterable[Result]], items: Sequence[Item], first: int
    ) -> Generator[Result, None, None]:
        """Work at each share in a task."""
        shares = Shares(items, first, TASK_SECONDS)
        listed = replace(work, function=partial(_listed, work.function))
        with contextlib.closing(self.results(listed, shares, 0)) as results:
            for result in results:
                yield from result

    def run(
        self,
        jobs: Sequence[Job],
        workers: int,
        advance: Callable[[int], None],
        finished: Callable[[int, Outcome], None],
        initialiser: Callable[[], None],
    ) -> list[Outcome]:
        """Work at each job in a task; progress is told as it ends."""
        outcomes = [Outcome() for _ in jobs]
        if not jobs:
            return outcomes
        calls = (_call_of(number, job) for number, job in enumerate(jobs))
        order = Order(_do_job, initialiser, None, _fitting(jobs[0].load))
        with contextlib.closing(_tasks(order, calls, Parcels((), ()), workers)) as tasks:
            for call, done in tasks:
                (number, *_) = call.share[0]
                if isinstance(done, Exception):
                    outcomes[number] = Outcome(str(done))
                else:
                    outcomes[number] = done.value.outcome
                    advance(done.value.units)
                    _write_files(jobs[number].files[1], done.value.files)
                finished(number, outcomes[number])
        return outcomes


def _calls(shares: Shares[Item], work: Work[Item, Any], load: Load) -> Iterator[Call]:
    part = None if work.source is None else partial(work.source.part, work.source.path)
    while shares:
        yield Call(shares.next(max(1, _slots(load))), part)


def _call_of(number: int, job: Job) -> Call:
    source = job.source
    assert source is not None  # `workers.run` keeps other jobs on this machine

    def part(share: Sequence[Any], target: Path) -> None:
        source.part(source.path, job.arguments, target)

    return Call([(number, job.function, job.arguments)], part)


@dataclass(frozen=True)
class _Running:
    """A task under way.

    Attributes:
        stored: what it was sent; that stays while it may be retried.
        size: of that, bytes.
    """

    call: Call
    stored: Any
    size: int


def _tasks(
    order: Order, calls: Iterator[Call], parcels: Parcels[Any], most: float = math.inf
) -> Generator[tuple[Call, Done | Exception], None, None]:
    """Yield calls and what they handed back, or why they failed, as they end; at most `most` are
    under way."""
    load = order.load
    task = ray.remote(
        num_cpus=load.processors,
        num_gpus=int(load.gpu),
        memory=load.memory,
        max_calls=CALLS,
        max_retries=RETRIES,
        retry_exceptions=[OSError, MemoryError],
    )(work)
    reference = ray.put(order)
    running: dict[Any, _Running] = {}
    store = STORE_SHARE * _own_store()
    todo: deque[Call] = deque()
    slots, looked, lonely = _slots(load), time.monotonic(), 0.0
    try:
        while True:
            while len(running) < min(most, max(1, AHEAD * slots)) and (
                sum(other.size for other in running.values()) < store or not running
            ):
                todo.extend(itertools.islice(calls, 0 if todo else 1))
                if not todo:
                    break
                call = todo.popleft()
                if parcels.sent:
                    count = parcels.fitting(call.share, store / max(1, AHEAD * slots))
                    if count < len(call.share):
                        todo.appendleft(replace(call, share=call.share[count:]))
                        call = replace(call, share=call.share[:count])
                running |= _started(task, reference, call, parcels)
            if not running:
                break
            ready, _ = ray.wait(list(running), timeout=POLL_SECONDS)
            for ended in ready:
                call = running.pop(ended).call
                done = _handed_back(ended)
                if isinstance(done, Unseen):
                    parcels.send(done)
                    todo.appendleft(call)
                else:
                    yield call, done
            now = time.monotonic()
            if now - looked > POLL_SECONDS:
                slots = _slots(load)
                lonely = 0.0 if slots or ready else lonely + now - looked
                looked = now
            if lonely > ALONE_SECONDS:
                raise InputError(
                    "No machine of the cluster is left that could do the work; what was done "
                    "stays. Start some and run the command again."
                )
    finally:
        _give_up(list(running))


def _started(task: Any, reference: Any, call: Call, parcels: Parcels[Any]) -> dict[Any, _Running]:
    """Start the task of a call."""
    part, files = _part(call), list(parcels.files(call.share))
    stored = None if part is None else ray.put(part)
    sent = list(parcels.packed(files)) if parcels.sent else None
    size = len(part or b"") + sum(file.size for file, _ in sent or ())
    # What lies in a list is fetched by the task itself, if it wants it.
    started = task.remote([reference], call.share, stored, files, sent)
    return {started: _Running(call, (stored, sent), size)}


def _give_up(tasks: list[Any]) -> None:
    """End tasks: they are asked to, so that they leave nothing on their machines' disks; those that
    do not are killed."""
    if not tasks:
        return
    with contextlib.suppress(Exception):
        for task in tasks:
            ray.cancel(task)
        _, deaf = ray.wait(tasks, num_returns=len(tasks), timeout=CLEAR_SECONDS)
        for task in deaf:
            ray.cancel(task, force=True)


def _part(call: Call) -> bytes | None:
    if call.part is None:
        return None
    with scratch_folder() as folder:
        target = folder / "part.db"
        call.part(call.share, target)
        return target.read_bytes()


def _handed_back(ended: Any) -> Done | Unseen | Exception:
    try:
        done: Done | Unseen = ray.get(ended)
        return done
    except RayTaskError as fault:
        cause = fault.cause
        if isinstance(cause, RayError):  # it could not even begin
            return InputError(
                "A machine of the cluster cannot do this work; compare what is installed there: "
                f"{str(cause).strip().splitlines()[0]}"
            )
        return cause if isinstance(cause, Exception) else fault
    except RayError as fault:
        return InputError(
            f"A task was lost {RETRIES + 1} times with its process or machine "
            f"({type(fault).__name__}), for want of memory perhaps; what was done stays: run the "
            "command again."
        )


def _machines() -> list[dict[str, float]]:
    return [machine["Resources"] for machine in ray.nodes() if machine["Alive"]]


def _own_store() -> float:
    own = ray.get_runtime_context().get_node_id()
    (resources,) = (node["Resources"] for node in ray.nodes() if node["NodeID"] == own)
    return float(resources.get("object_store_memory", 0))


def _fitting(load: Load) -> Load:
    """Return a load that some machine can take: no more than the largest has."""
    machines = _machines()
    with_gpu = [resources for resources in machines if resources.get("GPU", 0) >= 1]
    if load.gpu and with_gpu:
        each = min(int(resources.get("CPU", 1) // resources["GPU"]) for resources in with_gpu)
        return Load(max(1, each), 0.0, True)
    most = max((resources.get("CPU", 0) for resources in machines), default=1)
    memory = max((resources.get("memory", 0) for resources in machines), default=0.0)
    processors = max(1, min(load.processors, int(most)))
    return Load(processors, int(min(load.memory, memory)))


def _slots(load: Load) -> int:
    """Return how many tasks of a load the machines can do at once."""
    wanted = {"CPU": load.processors, "memory": load.memory, "GPU": int(load.gpu)}
    return sum(
        int(min(resources.get(kind, 0) // count for kind, count in wanted.items() if count))
        for resources in _machines()
    )


# What runs on the other machines

_kept: tuple[str, Order] | None = None
"""The order this process works at; its initialiser was called."""


def work(
    references: list[Any],
    share: Sequence[Any],
    part: bytes | None,
    files: Sequence[File],
    sent: Sent | None,
) -> Done | Unseen:
    """Do a task: one share of an order (in a worker of Ray)."""
    order = _order(references[0])
    with scratch_folder() as folder:
        places, missing = order.places, unseen(order.places, files)
        if missing is not None:
            if sent is None:
                return Unseen(own_name(), missing)
            places = unpacked(sent, places, folder)
        parts: list[Path] = []
        if part is not None:
            parts.append(folder / "part.db")
            parts[0].write_bytes(part)
        start = time.monotonic()
        value = order.function(*parts, *places, share)
        seconds = time.monotonic() - start
        taken = None if order.take is None else order.take(parts[0], share)
    return Done(value, taken, seconds)


def _order(reference: Any) -> Order:
    """Return the order, fetched once by this process, which is made ready for it."""
    global _kept
    if _kept is None or _kept[0] != reference.hex():
        order: Order = ray.get(reference)
        if order.version != VERSION:
            raise InputError(
                f"The machine {own_name()} of the cluster has colmap-netvlad {VERSION}, the one "
                f"that asks {order.version}; install the same on all."
            )
        machine.allot(order.load.processors)
        order.initialiser()
        _kept = reference.hex(), order
    return _kept[1]


def _listed(function: Callable[..., Iterable[Result]], *arguments: Any) -> list[Result]:
    return list(function(*arguments))


def _do_job(part: Path, share: Sequence[Any]) -> JobDone:
    ((_, function, arguments),) = share
    units = 0

    def advance(count: int = 1) -> None:
        nonlocal units
        units += count

    with scratch_folder() as folder:
        outcome = outcome_of(partial(function, advance, part, folder, *arguments))
        return JobDone(outcome, units, {} if outcome.fault else _read_files(folder))


def _read_files(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def _write_files(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
