"""Connect to a Ray cluster, and see that its machines can do our work."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from colmap_netvlad.runtime import workers
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.version import VERSION

LISTEN_SECONDS = 3.0
"""How long a machine may take to say that it listens."""

SETTINGS = b"\x04"
GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0" + SETTINGS + b"\0\0\0\0\0"
"""How HTTP/2, which Ray's head speaks, begins (RFC 9113, 3.4); the answer is a frame of settings
too. Ray itself asks whoever else listens for minutes."""

ANSWER_SECONDS = 60.0
"""How long a machine may take to start a process and answer."""


@contextmanager
def on_cluster(address: str = "auto") -> Iterator[None]:
    """Let the machines of a Ray cluster do the work while the block runs.

    Photos lie in a folder that all machines see under the same path, or are sent to those that do
    not; database and cache are written by this machine alone. This machine is one of the cluster's.

    Args:
        address: HOST:PORT of the cluster's head, or "auto": the cluster this machine is in.

    Raises:
        InputError: Ray is not installed, nobody listens at the address, this machine is not in
            the cluster, or a machine has no colmap-netvlad or not this version.
    """
    try:
        import ray

        from colmap_netvlad.runtime.ray_tasks import RayTasks
    except ImportError as fault:
        raise InputError(
            "Work on many machines needs Ray, which is not installed here; install it with "
            '`pip install "colmap-netvlad[cluster]"`.'
        ) from fault
    if address != "auto":
        _check_address(address)
    connected_before = ray.is_initialized()
    if not connected_before:
        _connect(ray, address)
    try:
        _check_machines(ray)
        with workers.using(RayTasks()):
            yield
    finally:
        if not connected_before:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except ConnectionError as fault:
        where = "in no Ray cluster" if address == "auto" else f"not in the Ray cluster at {address}"
        raise InputError(
            f"This machine is {where}, or has another token (~/.ray/auth_token) than it; start "
            "one with `ray start --head`, or join one with `ray start --address HOST:PORT`."
        ) from fault
    except Exception as fault:
        lines = str(fault).strip().splitlines()
        raise InputError(
            f"Ray could not connect to the cluster at {address}: {lines[0] if lines else fault!r}"
        ) from fault
    finally:
        _restore_sigterm(before)


def _restore_sigterm(before: Any) -> None:
    """Ray takes SIGTERM to exit; what was there is put back."""
    try:
        signal.signal(signal.SIGTERM, before)
    except ValueError:  # not in the main thread
        return


def _check_address(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise InputError(
            f"`cluster` is {address}; it is auto, or HOST:PORT of the cluster's head "
            "(10.0.0.1:6379), on a machine of the cluster."
        )
    try:
        with socket.create_connection((host, int(port)), LISTEN_SECONDS) as connection:
            connection.settimeout(LISTEN_SECONDS)
            connection.sendall(GREETING)
            answer = connection.recv(9)
    except (OSError, OverflowError):
        answer = b""
    if answer[3:4] != SETTINGS and os.environ.get("RAY_USE_TLS") != "1":
        raise InputError(
            f"No Ray cluster listens at {address}; start it there with `ray start --head`, or mend "
            "`cluster`."
        )


def _check_machines(ray: Any) -> None:
    """Make sure that every machine has this version of us and of pycolmap."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    # Defined here, so that it goes as code and not as a name in a package that is not there.
    def versions() -> tuple[str, str] | str:
        import importlib.metadata

        try:
            from colmap_netvlad.runtime.version import VERSION

            return VERSION, importlib.metadata.version("pycolmap")
        except ImportError as fault:  # PackageNotFoundError too
            return str(fault)

    ask = ray.remote(num_cpus=0, max_retries=0)(versions)
    machines = [machine for machine in ray.nodes() if machine["Alive"]]
    if not any(machine["Resources"].get("CPU") for machine in machines):
        raise InputError("No machine of the cluster has a processor to lend; start one with some.")
    asked = {
        ask.options(
            scheduling_strategy=NodeAffinitySchedulingStrategy(machine["NodeID"], soft=False)
        ).remote(): f"{machine['NodeManagerHostname']} ({machine['NodeManagerAddress']})"
        for machine in machines
    }
    own = VERSION, importlib.metadata.version("pycolmap")
    answered, silent = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER_SECONDS)
    for answer in answered:
        name = asked[answer]
        try:
            found = ray.get(answer)
        except ray.exceptions.RayTaskError as fault:
            raise InputError(
                f"The machine {name} of the cluster cannot work with this one: {fault.cause}"
            ) from fault
        except ray.exceptions.RayError:
            continue  # it has just gone away
        if isinstance(found, str):
            raise InputError(
                f"The machine {name} of the cluster lacks colmap-netvlad ({found}); install "
                f"version {VERSION} there, in the environment that Ray runs in."
            )
        if found != own:
            raise InputError(
                f"The machine {name} of the cluster has colmap-netvlad {found[0]} with pycolmap "
                f"{found[1]}, this one {own[0]} with {own[1]}; install the same on all."
            )
    if silent:
        raise InputError(f"The machine {asked[silent[0]]} of the cluster does not answer.")
