"""Multispectral shots: which photos are bands of one press of the shutter.

A multispectral camera writes a file for each of its lenses. Their names say what belongs together,
and so does XMP, which also holds where files were renamed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import networkx as nx

from colmap_netvlad.photos.files import BadPhoto, read_header
from colmap_netvlad.runtime.progress import step

RGB = "RGB"

BAND_SUFFIXES = (".tif", ".tiff")
"""Files of single bands. A project without any has no multispectral shots: none are looked for."""


@dataclass(frozen=True)
class _Pattern:
    """File names of one maker: a shot and one of its bands, and what the bands are called."""

    name: re.Pattern[str]
    bands: Mapping[str, str] = field(default_factory=dict)


_PATTERNS = (
    # MicaSense: IMG_0000_1.tif to IMG_0000_10.tif; but for 2, models differ in what numbers mean.
    _Pattern(re.compile(r"(IMG_\d{4})_(\d{1,2})\.tiff?", re.I), {"2": "Green"}),
    # Parrot Sequoia: IMG_160914_155525_0000_NIR.TIF, and _RGB.JPG.
    _Pattern(
        re.compile(r"(IMG_\d{6}_\d{6}_\d+)_(GRE|RED|REG|NIR|RGB)\.(?:tiff?|jpe?g)", re.I),
        {"GRE": "Green", "RED": "Red", "REG": "RedEdge"},
    ),
    # DJI Mavic 3 Multispectral: DJI_20230601120000_0001_MS_NIR.TIF, and _D.JPG.
    _Pattern(
        re.compile(r"(DJI_\d+_\d+)_(?:MS_(G|R|RE|NIR)\.tiff?|(D)\.jpe?g)", re.I),
        {"G": "Green", "R": "Red", "RE": "RedEdge", "D": RGB},
    ),
    # DJI Phantom 4 Multispectral: DJI_0011.TIF to DJI_0015.TIF, and DJI_0010.JPG.
    _Pattern(
        re.compile(r"(DJI_\d{3})(?:([1-5])\.tiff?|(0)\.jpe?g)", re.I),
        {"0": RGB, "1": "Blue", "2": "Green", "3": "Red", "4": "RedEdge", "5": "NIR"},
    ),
)


def find_shots(names: Sequence[str], images: Path | None) -> list[dict[str, str]]:
    """Return the shots of several bands: image name by band, both in the order of the names.

    Photos are bands of one shot where their names in one folder say so, or the number of the
    exposure in XMP. Of two photos of one band the later is of another shot: a copy.

    Args:
        names: of the images, relative to `images`.
        images: photo folder, for XMP; None: names alone.
    """
    if not any(name.lower().endswith(BAND_SUFFIXES) for name in names):
        return []
    stated = _stated(names, images)
    graph: nx.Graph = nx.Graph()
    for place, (name, (exposure, _)) in enumerate(zip(names, stated, strict=True)):
        said = named_band(name)
        graph.add_edges_from((place, key) for key in (said and said[0], exposure) if key)
    shots: dict[tuple[int, int], dict[str, str]] = {}
    for number, members in enumerate(nx.connected_components(graph)):
        copies: Counter[str] = Counter()
        for place in sorted(member for member in members if isinstance(member, int)):
            band = band_name(names[place], stated[place][1]) or RGB
            shots.setdefault((number, copies[band]), {})[band] = names[place]
            copies[band] += 1
    return [shot for shot in shots.values() if len(shot) > 1]


def band_name(name: str, stated: str | None) -> str | None:
    """Return the band of a photo: as XMP states it, else as its name does, or None."""
    if stated:
        return "".join(stated.split())
    said = named_band(name)
    return said[1] if said else None


def named_band(name: str) -> tuple[str, str] | None:
    """Return shot and band that an image name states, or None."""
    path = PurePosixPath(name)
    for pattern in _PATTERNS:
        found = pattern.name.fullmatch(path.name)
        if found:
            shot, *band = (part.upper() for part in found.groups() if part)
            return str(path.parent / shot), pattern.bands.get(band[0], band[0])
    return None


def lens_band(name: str, stated: str | None) -> str | None:
    """Return the band of a file of a single band, which tells a camera's lenses apart, or None.

    Any DJI drone may call a photo DJI_0010.JPG: colour photos do not count.
    """
    return band_name(name, stated) if name.lower().endswith(BAND_SUFFIXES) else None


def _stated(names: Sequence[str], images: Path | None) -> list[tuple[str | None, str | None]]:
    """Return number of the exposure and band that each photo's XMP states."""
    if images is None or not images.is_dir():
        return [(None, None)] * len(names)

    def read(name: str) -> tuple[str | None, str | None]:
        try:
            header = read_header(images / name)
        except BadPhoto:
            return None, None
        return header.exposure, header.band

    stated = []
    with step("Looking for multispectral shots", len(names)) as bar, ThreadPoolExecutor() as pool:
        for said in pool.map(read, names):
            stated.append(said)
            bar.advance()
    return stated
