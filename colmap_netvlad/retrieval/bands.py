"""Multispectral flights: shots are ranked, and their bands follow.

Bands of one shot show one place at one moment, so only one of them is described and compared. What
it finds holds for all: each band's partners are the same band of the shots found, since SIFT
matches blue to blue far better than to infrared, and before these the representative of its own
shot, which holds the bands together in one model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_netvlad.cache.ranking import NO_PARTNER, Ranking
from colmap_netvlad.flight import Flight
from colmap_netvlad.photos.bands import RGB, find_shots

PREFERRED = (RGB, "Panchro", "Green")
"""Bands that represent a shot, best first: the finest picture, else what is bright everywhere."""


@dataclass(frozen=True, eq=False)
class Shots:
    """What a multispectral flight is ranked by. Images are places in the flight's order.

    Attributes:
        representatives: (S,) one image of each shot, ascending; an image of no multispectral shot
            represents itself.
        shot: (N,) the shot of each image.
        band: (N,) the band of each image, a column of `images`; -1 for one of no shot.
        images: (S, B) image of each band of a shot, `NO_PARTNER` where there is none.
        note: a sentence for the report.
    """

    representatives: NDArray[np.int64]
    shot: NDArray[np.int64]
    band: NDArray[np.int64]
    images: NDArray[np.int64]
    note: str


def multispectral_shots(flight: Flight) -> Shots | None:
    """Return the shots of a flight; None where no photos are bands of one."""
    names = flight.names
    found = find_shots(names, flight.project.images)
    if not found:
        return None
    place = {name: i for i, name in enumerate(names)}
    bands = sorted({band for shot in found for band in shot})
    column = {band: b for b, band in enumerate(bands)}
    # A photo that COLMAP found nothing in represents nobody.
    usable = {row.name for row in flight.images if flight.keypoints.get(row.image_id)}
    ranked_by = [_representative(shot, usable) for shot in found]
    chosen = [shot[band] for shot, band in zip(found, ranked_by, strict=True)]
    inside = {name for shot in found for name in shot.values()}
    alone = [name for name in names if name not in inside]
    representatives = np.array(sorted(place[name] for name in [*chosen, *alone]))
    row = {image: s for s, image in enumerate(representatives.tolist())}
    shot_of, band_of = np.full(len(names), -1), np.full(len(names), -1)
    images = np.full((len(row), len(bands)), NO_PARTNER)
    for name in alone:
        shot_of[place[name]] = row[place[name]]
    for shot, name in zip(found, chosen, strict=True):
        s = row[place[name]]
        for band, member in shot.items():
            shot_of[place[member]], band_of[place[member]] = s, column[band]
            images[s, column[band]] = place[member]
    note = (
        f"{len(found):,} multispectral shots ({', '.join(bands)}), ranked by the band "
        f"{' or '.join(sorted(set(ranked_by)))}; each band is paired with the same "
        "band of these shots, and with its own shot's"
    )
    return Shots(representatives, shot_of, band_of, images, note)


def of_shots(flight: Flight, shots: Shots) -> Flight:
    """Return the flight with the representatives alone."""
    return replace(flight, images=tuple(flight.images[i] for i in shots.representatives))


def for_bands(ranking: Ranking, shots: Shots, names: Sequence[str]) -> Ranking:
    """Return the ranking of all images that follows from one of the representatives.

    Args:
        ranking: of the representatives, in their order.
        names: of all images.
    """
    shape = (len(names), ranking.depth + 1)
    partners = np.full(shape, NO_PARTNER, np.int32)
    scores = np.full(shape, -np.inf, np.float32)
    for image, (shot, band) in enumerate(zip(shots.shot, shots.band, strict=True)):
        own = shots.representatives[shot]
        row = ranking.partners[shot]
        known = row != NO_PARTNER
        others, score = row[known], ranking.scores[shot, known]
        if image == own:
            found = shots.representatives[others]
        else:
            found = shots.images[others, band]
            there = found != NO_PARTNER
            best = score[:1] if len(score) else np.ones(1, np.float32)
            found, score = np.append(own, found[there]), np.append(best, score[there])
        partners[image, : len(found)], scores[image, : len(found)] = found, score
    return replace(
        ranking,
        names=tuple(names),
        partners=partners,
        scores=scores,
        notes=(shots.note, *ranking.notes),
    )


def _representative(shot: dict[str, str], usable: set[str]) -> str:
    """Return the band by which a shot is ranked."""
    bands = [band for band in shot if shot[band] in usable] or list(shot)
    return next((band for band in PREFERRED if band in bands), bands[0])
