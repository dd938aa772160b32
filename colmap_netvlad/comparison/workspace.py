"""The folder of a comparison: what is kept there so that a killed run goes on where it stopped.

compare.html, compare.json, compare.csv   the result
work/project.json     which project this is: a fingerprint of image names and features; who matches
work/methods.json     the methods asked for so far
work/union.db         the project's features, and every distinct pair matched once
work/seconds.db       what matching each pair took
work/rankings/        each method's ranking with its times
work/models/          each method's reconstruction and its figures
"""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import Ranking
from colmap_netvlad.colmap.copies import copy_database
from colmap_netvlad.flight import Flight
from colmap_netvlad.graph.pair import Pair
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import atomic_path, write_atomically


def check_comparable(flight: Flight) -> None:
    """Make sure that methods can be compared on a flight.

    Raises:
        InputError: it has no two images, or no image has features.
    """
    database, count = flight.project.database, len(flight.images)
    if count < 2:
        raise InputError(
            f"{database} has {count} image{'s' if count != 1 else ''}; a comparison needs two at "
            "least. Import photos with `colmap-netvlad features`."
        )
    if not flight.keypoints:
        raise InputError(
            f"{database} has no features, so no pair can be verified; extract them with "
            "`colmap-netvlad features`."
        )


def flight_fingerprint(flight: Flight) -> str:
    """Return the sha256 of image names and features: other photos or features, other flight."""
    rows = (
        f"{image.name}\t{flight.keypoints.get(image.image_id, 0)}"
        f"\t{flight.features.get(image.image_id, '')}"
        for image in flight.images
    )
    return hashlib.sha256("\n".join(rows).encode("utf-8")).hexdigest()


class Workspace:
    """A comparison's folder. Made by `open_workspace`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._work = folder / "work"

    @property
    def html(self) -> Path:
        """The report page."""
        return self.folder / "compare.html"

    @property
    def json(self) -> Path:
        """All figures."""
        return self.folder / "compare.json"

    @property
    def csv(self) -> Path:
        """All figures as a table, a row for each method and k."""
        return self.folder / "compare.csv"

    @property
    def union(self) -> Path:
        """The copy of the user's database in which all pairs are matched."""
        return self._work / "union.db"

    @property
    def project(self) -> Path:
        """Says which project the folder belongs to."""
        return self._work / "project.json"

    def model_folder(self, method: str) -> Path:
        """Where a method's reconstruction lies."""
        return self._work / "models" / file_name(method)

    # Methods asked for

    def methods(self) -> list[str]:
        """Return the methods of earlier runs, in the order they were first asked for."""
        path = self._work / "methods.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []

    def add_methods(self, names: Iterable[str]) -> list[str]:
        """Add methods to the comparison, and return all of them."""
        methods = list(dict.fromkeys([*self.methods(), *names]))
        write_atomically(self._work / "methods.json", json.dumps(methods, ensure_ascii=False))
        return methods

    # Who matches

    def matcher(self) -> str | None:
        """Return the label (`MatchOptions`) of the matcher of all pairs, None before the first."""
        content = json.loads(self.project.read_text(encoding="utf-8"))
        first = "colmap" if self.methods() else None  # the only one there was
        matcher: str | None = content.get("matcher", first)
        return matcher

    def keep_matcher(self, label: str) -> None:
        """Write down who matches all pairs."""
        content = json.loads(self.project.read_text(encoding="utf-8"))
        text = json.dumps({**content, "matcher": label}, indent=1)
        write_atomically(self.project, text + "\n")

    # Rankings

    def load_ranking(self, key: str) -> tuple[Ranking, bool] | None:
        """Return a kept ranking and whether its times were an earlier run's, or None."""
        path = self._ranking_path(key)
        if not path.is_file():
            return None
        with np.load(path, allow_pickle=False) as kept:
            ranking = Ranking(
                tuple(kept["names"].tolist()),
                kept["partners"],
                kept["scores"],
                str(kept["method"]),
                float(kept["seconds_describe"]),
                float(kept["seconds_search"]),
                tuple(kept["notes"].tolist()),
                _reasons(kept["left_out"]),
                "compared" in kept and bool(kept["compared"]),
                "every_pair" in kept and bool(kept["every_pair"]),
                _reasons(kept["unseen"]) if "unseen" in kept else (),
            )
            return ranking, bool(kept["timed_earlier"])

    def save_ranking(self, key: str, ranking: Ranking, timed_earlier: bool) -> None:
        """Keep a ranking and its times."""
        with atomic_path(self._ranking_path(key)) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                names=np.array(ranking.names, dtype=np.str_),
                partners=ranking.partners,
                scores=ranking.scores,
                method=np.array(ranking.method, dtype=np.str_),
                seconds_describe=ranking.seconds_describe,
                seconds_search=ranking.seconds_search,
                notes=np.array(ranking.notes, dtype=np.str_),
                left_out=np.array(ranking.left_out, dtype=np.str_).reshape(-1, 2),
                compared=ranking.compared,
                every_pair=ranking.every_pair,
                unseen=np.array(ranking.unseen, dtype=np.str_).reshape(-1, 2),
                timed_earlier=timed_earlier,
            )

    def latest_key(self, column: str) -> str | None:
        """Return the key of the ranking that a column had last; None where it had none."""
        path = self._latest_path(column)
        return path.read_text(encoding="utf-8") if path.is_file() else None

    def keep_latest_key(self, column: str, key: str) -> None:
        """Keep the key of the ranking that a column has."""
        write_atomically(self._latest_path(column), key)

    def _latest_path(self, column: str) -> Path:
        return self._work / "rankings" / f"{file_name(column)}.key"

    def _ranking_path(self, key: str) -> Path:
        return self._work / "rankings" / f"{file_name(key)}.npz"

    # What matching took

    def add_seconds(self, pairs: Sequence[Pair], seconds: float) -> None:
        """Write down that matching these pairs together took `seconds`."""
        share = seconds / max(len(pairs), 1)
        with closing(self._seconds()) as ledger, ledger:
            ledger.executemany(
                "INSERT OR REPLACE INTO pairs VALUES (?, ?, ?)", [(a, b, share) for a, b in pairs]
            )

    def pair_seconds(self) -> dict[Pair, float]:
        """Return what matching each pair took, s; pairs whose time was lost are absent."""
        with closing(self._seconds()) as ledger:
            return {(a, b): seconds for a, b, seconds in ledger.execute("SELECT * FROM pairs")}

    def _seconds(self) -> sqlite3.Connection:
        ledger = sqlite3.connect(self._work / "seconds.db")
        ledger.execute(
            "CREATE TABLE IF NOT EXISTS pairs"
            " (name1 TEXT, name2 TEXT, seconds REAL, PRIMARY KEY (name1, name2)) WITHOUT ROWID"
        )
        return ledger


def open_workspace(folder: Path, flight: Flight) -> Workspace:
    """Make a comparison's folder, or go on in an earlier one of the same project.

    Raises:
        InputError: the folder is another project's or holds something else, the database's
            photos or features have changed since, or the folder cannot be written.
    """
    workspace, database = Workspace(folder), flight.project.database
    fingerprint = flight_fingerprint(flight)
    if workspace.project.is_file():
        kept = json.loads(workspace.project.read_text(encoding="utf-8"))
        if kept.get("fingerprint") != fingerprint:
            raise InputError(
                f"{folder} holds a comparison of another project ({kept.get('database')}), or its "
                "photos or features have changed since; name another folder with `output`."
            )
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder} exists and is no comparison's folder; name another with `output`."
        )
    else:
        text = json.dumps({"database": str(database), "fingerprint": fingerprint}, indent=1)
        write_atomically(workspace.project, text + "\n")
    if not workspace.union.exists():
        copy_database(database, workspace.union, matches=False)
    return workspace


def file_name(key: str) -> str:
    """Return a file name for any key, another one for each."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", key).strip("-.")[-80:]
    if plain == key:
        return plain
    return f"{plain}-{hashlib.sha256(key.encode('utf-8')).hexdigest()[:8]}"


def _reasons(kept: NDArray[np.str_]) -> tuple[tuple[str, str], ...]:
    return tuple((name, reason) for name, reason in kept.tolist())
