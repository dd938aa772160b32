"""Files of this machine for work on others: read where they lie, or sent.

Which machine a task gets is not known before, and machines join: so the first that does not see
its files says so, and from then on they go along with each share. They wait in the object store
of the machine that sends them; who sees them where they lie does not fetch them.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import socket
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple

import ray

from colmap_netvlad.runtime.jobs import Folder, Item

logger = logging.getLogger(__name__)

SENT_BYTES = 256 * 2**20
"""Files that a share carries at most: about what 30 seconds of extraction read."""

NETWORK_BYTES = 110 * 2**20
"""What a network of 1 Gbit/s carries, bytes a second."""


class File(NamedTuple):
    """A file that a share needs: in which of the folders, its name there, how large, bytes."""

    folder: int
    name: str
    size: int


Sent = Sequence[tuple[File, Any]]
"""Files, and where Ray keeps what is in them."""

Places = tuple[Path | None, ...]
"""Where the folders lie."""


@dataclass(frozen=True)
class Unseen:
    """What a task hands back whose machine does not see its files."""

    machine: str
    place: Path


class Parcels(Generic[Item]):
    """The files that items need, and whether they are sent.

    Attributes:
        sent: whether some machine does not see them.
    """

    def __init__(self, folders: Sequence[Folder[Item] | None], items: Sequence[Item]) -> None:
        self._folders, self._items = folders, items
        self.sent = False

    def files(self, share: Iterable[Item]) -> Iterator[File]:
        """Yield the files of a share. Those that are gone are not among them: whoever works at it
        finds out."""
        for item in share:
            for number, folder in enumerate(self._folders):
                if folder is None:
                    continue
                for name in folder.files(folder.path, item):
                    with contextlib.suppress(OSError):
                        yield File(number, name, (folder.path / name).stat().st_size)

    def fitting(self, share: Sequence[Item], most: float) -> int:
        """Return how many of the first items may be sent at once in `most` bytes, at least 1."""
        each = (sum(file.size for file in self.files([item])) for item in share)
        limit = min(most, SENT_BYTES)
        return max(1, sum(1 for _ in itertools.takewhile(limit.__ge__, itertools.accumulate(each))))

    def send(self, unseen: Unseen) -> None:
        """Send files from now on, and say once what that costs."""
        if self.sent:
            return
        self.sent = True
        sizes = [file.size for file in self.files(self._items)]
        minutes = round(sum(sizes) / NETWORK_BYTES / 60)
        logger.info(
            "The machine %s of the cluster does not see %s: photos are sent there, at most %s "
            "files (%s MiB%s).",
            unseen.machine,
            unseen.place,
            f"{len(sizes):,}",
            f"{sum(sizes) / 2**20:,.1f}",
            f", {minutes} min of a network of 1 Gbit/s" if minutes else "",
        )

    def packed(self, files: Iterable[File]) -> Iterator[tuple[File, Any]]:
        """Yield files and where Ray now keeps what is in them."""
        for file in files:
            folder = self._folders[file.folder]
            assert folder is not None
            with contextlib.suppress(OSError):  # as in `files`
                yield file, ray.put((folder.path / file.name).read_bytes())


# On the other machines


def unseen(places: Places, files: Sequence[File]) -> Path | None:
    """Return a place that is not here, or not with these files, or None."""
    place: Path | None = None
    try:
        for place in places:
            if place is not None and not place.is_dir():
                return place
        for number, name, size in files:
            place = places[number]
            if place is not None and (place / name).stat().st_size != size:
                return place
    except OSError:
        return place
    return None


def unpacked(sent: Sent, places: Places, folder: Path) -> Places:
    """Write files below a folder, and return what stands there for each of the places."""
    own = tuple(place and folder / str(number) for number, place in enumerate(places))
    try:
        for place in own:
            if place is not None:
                place.mkdir()
        for (number, name, _), content in sent:
            target = folder / str(number) / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(ray.get(content))
    except OSError as fault:
        said = f"the machine {own_name()} cannot keep files in {folder.parent}: {fault.strerror}"
        raise OSError(fault.errno, said) from fault
    return own


def own_name() -> str:
    """Return the name and the address of this machine."""
    return f"{socket.gethostname()} ({ray.util.get_node_ip_address()})"
