"""Rankings -> a set of image pairs, and pairs lists on disk."""

from __future__ import annotations

import codecs
import csv
import io
import json
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from colmap_netvlad.pairs.union import ImagePair
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically

SUFFIXES = {"colmap": ".txt", "csv": ".csv", "json": ".json"}
"""The formats of pairs lists, and how the names of their files end."""

_WORD = re.compile(r'"([^"]+)"(?=\s|$)|(\S+)')


def write_pairs(path: Path, pairs: Sequence[ImagePair], format: str = "colmap") -> list[str]:
    """Write a pairs list whole or not at all, and return the names it could not hold.

    COLMAP's list splits a line on its first space, so a name with a space (or one that starts
    with `#`) cannot stand in it: such pairs are left out of that format and their names
    returned. CSV and JSON hold every name and the scores.
    """
    text, unwritable = _TEXT[format](pairs)
    write_atomically(path, text)
    return unwritable


def format_of(path: Path) -> str:
    """Return the format that a pairs list is read in: known by its suffix, else COLMAP's."""
    suffix = path.suffix.lower()
    return next((format for format, own in SUFFIXES.items() if own == suffix), "colmap")


def in_colmap_list(name: str) -> bool:
    """Whether COLMAP's pairs list can express an image name."""
    return not (name.startswith("#") or any(c.isspace() for c in name))


def read_pairs(path: Path, names: Collection[str]) -> list[tuple[str, str]]:
    """Read a pairs list in any of our formats (known by its suffix, else COLMAP's).

    Pairs twice in either order are taken once; blank lines and lines starting with `#` are
    skipped as COLMAP does. As spreadsheets write them, names may stand between tabs or in double
    quotes, columns between semicolons, and the text begin with a byte order mark.

    Raises:
        InputError: the file is missing or malformed, or names an image not in `names`.
    """
    if not path.is_file():
        raise InputError(f"The pairs list {path} does not exist; `colmap-netvlad pairs` makes it.")
    try:
        raw = _READERS[format_of(path)](_decoded(path.read_bytes()))
    except OSError as fault:
        raise InputError(f"Cannot read {path}: {fault.strerror or fault}.") from fault
    except (ValueError, csv.Error, RecursionError) as fault:
        raise InputError(f"{path} is not a pairs list: {fault}.") from fault
    known = set(names)
    unknown = sorted({name for pair in raw for name in pair} - known)
    if unknown:
        raise InputError(
            f"{path} names {len(unknown)} image{'s' if len(unknown) > 1 else ''} that the database "
            f"does not have (first: {unknown[0]}); make the list from this database."
        )
    unique: dict[frozenset[str], tuple[str, str]] = {}
    for a, b in raw:
        if a != b:
            unique.setdefault(frozenset((a, b)), (a, b))
    return list(unique.values())


def _colmap_text(pairs: Iterable[ImagePair]) -> tuple[str, list[str]]:
    lines, unwritable = [], set()
    for pair in pairs:
        bad = [name for name in (pair.name1, pair.name2) if not in_colmap_list(name)]
        unwritable.update(bad)
        if not bad:
            lines.append(f"{pair.name1} {pair.name2}\n")
    return "".join(lines), sorted(unwritable)


def _csv_text(pairs: Iterable[ImagePair]) -> tuple[str, list[str]]:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["name1", "name2", "score", "rank"])
    writer.writerows([p.name1, p.name2, f"{p.score:.6g}", p.rank] for p in pairs)
    return out.getvalue(), []


def _json_text(pairs: Iterable[ImagePair]) -> tuple[str, list[str]]:
    rows = [
        {"name1": p.name1, "name2": p.name2, "score": round(p.score, 6), "rank": p.rank}
        for p in pairs
    ]
    return json.dumps(rows, indent=1, ensure_ascii=False) + "\n", []


def _read_colmap(text: str) -> list[tuple[str, str]]:
    pairs = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = [quoted or plain for quoted, plain in _WORD.findall(line)]
        if len(words) != 2:
            raise ValueError(f"line {number} has {len(words)} names, not 2")
        pairs.append((words[0], words[1]))
    return pairs


def _read_csv(text: str) -> list[tuple[str, str]]:
    header = text.partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    return _pairs_of(csv.DictReader(io.StringIO(text, newline=""), delimiter=delimiter))


def _read_json(text: str) -> list[tuple[str, str]]:
    return _pairs_of(json.loads(text))


def _pairs_of(rows: Any) -> list[tuple[str, str]]:
    if not isinstance(rows, Iterable):
        raise ValueError("it is no list")
    pairs = []
    for number, row in enumerate(rows, start=1):
        a, b = (row.get("name1"), row.get("name2")) if isinstance(row, dict) else (None, None)
        if not (isinstance(a, str) and isinstance(b, str)):
            raise ValueError(f"row {number} has no texts name1 and name2")
        pairs.append((a, b))
    return pairs


def _decoded(data: bytes) -> str:
    """Return a file's text: UTF-8, or UTF-16 where it says so ("Unicode text" of Excel)."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig")


_TEXT = {"colmap": _colmap_text, "csv": _csv_text, "json": _json_text}
_READERS = {"colmap": _read_colmap, "csv": _read_csv, "json": _read_json}
