"""`georeference.json`: what lies beside a model to say where in the world it is."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from colmap_netvlad.geo.align import Alignment
from colmap_netvlad.geo.frames import LocalFrame
from colmap_netvlad.geo.gcp import ControlReport
from colmap_netvlad.geo.places import HEIGHTS
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically

FILE = "georeference.json"


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a model is.

    Attributes:
        frame: the local frame its coordinates are in; None: the cartesian system of the
            database's priors.
        alignment: how it came there, and its residuals at the photos.
        adjusted: whether the positions were part of the bundle adjustment.
        gps_std: the standard deviation that was given for all of them, m horizontal and vertical;
            None: what each photo states.
        control: how ground points lie; None where there are none.
    """

    frame: LocalFrame | None
    alignment: Alignment
    adjusted: bool = False
    gps_std: tuple[float, float] | None = None
    control: ControlReport | None = None

    def write(self, folder: Path) -> None:
        """Write `georeference.json` into a model's folder."""
        write_atomically(folder / FILE, json.dumps(self.content(), indent=1) + "\n")

    def lines(self) -> list[str]:
        """Return the sentences for a user."""
        alignment = self.alignment
        agreed = int((~alignment.outliers).sum())
        vertical = alignment.vertical
        where = "the system of the database's priors"
        if self.frame is not None:
            where = (
                f"m east, north, up of {self.frame.latitude:.6f}, {self.frame.longitude:.6f} "
                f"(UTM: EPSG {self.frame.epsg})"
            )
        lines = [f"Georegistered in {where}."]
        if self.frame is not None:
            lines.append(f"Heights are {HEIGHTS}.")
        if self.control is not None:
            lines += self.control.lines()
        if agreed:
            lines.append(
                f"{agreed:,} positions differ by {alignment.horizontal:.3f} m horizontally"
                + ("" if math.isnan(vertical) else f" and {vertical:.3f} m vertically")
                + " (root mean square)."
            )
        if alignment.outliers.any():
            named = _outliers(alignment)
            shown = ", ".join(f"{name} ({size:.1f} m)" for name, size in named[:5])
            more = f" and {len(named) - 5} more" if len(named) > 5 else ""
            lines.append(f"Positions that do not agree and had no say: {shown}{more}.")
        return lines + list(alignment.notes)

    def summary(self) -> dict[str, object]:
        """Return where the model is and how well it lies, without the photos one by one."""
        content = self.content()
        kept = ("origin", "epsg", "adjusted_with_positions", "residuals", "notes")
        return {key: content[key] for key in kept}

    def content(self) -> dict[str, object]:
        """Return what `georeference.json` holds."""
        alignment, frame = self.alignment, self.frame
        return {
            "frame": "cartesian priors" if frame is None else "local east-north-up, m",
            "origin": None
            if frame is None
            else {
                "latitude": frame.latitude,
                "longitude": frame.longitude,
                "height": frame.height,
            },
            "epsg": None if frame is None else frame.epsg,
            "heights": HEIGHTS,
            "world_from_model": alignment.world_from_model.matrix().tolist(),
            "scale": np.asarray(alignment.world_from_model.scale).item(),
            "adjusted_with_positions": self.adjusted,
            "gps_std": None if self.gps_std is None else list(self.gps_std),
            "residuals": {
                "photos": int((~alignment.outliers).sum()),
                "horizontal_rms": _number(alignment.horizontal),
                "vertical_rms": _number(alignment.vertical),
                "outliers": [name for name, _ in _outliers(alignment)],
            },
            "ground_points": None if self.control is None else _control(self.control),
            "notes": list(alignment.notes),
            "photos": {
                name: [_number(value) for value in residual]
                for name, residual in zip(
                    alignment.names, alignment.residuals.tolist(), strict=True
                )
            },
        }


@dataclass(frozen=True)
class Place:
    """What `georeference.json` says of how a model came where it is.

    Attributes:
        frame: its frame; None: the cartesian system of the database's priors.
        adjusted: whether the positions were part of the bundle adjustment.
        gps_std: standard deviation given for all of them, m horizontal and vertical; None: what
            each photo states.
        control: whether ground points placed it.
    """

    frame: LocalFrame | None
    adjusted: bool
    gps_std: tuple[float, float] | None
    control: bool


def read_place(folder: Path) -> Place | None:
    """Return where a model is, or None where it is not in the world.

    Raises:
        InputError: `georeference.json` is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        origin, frame = content["origin"], None
        if origin is not None:
            frame = LocalFrame(*(float(origin[key]) for key in ("latitude", "longitude", "height")))
        adjusted = bool(content.get("adjusted_with_positions"))
        given = content.get("gps_std")
        gps_std = None if given is None else (float(given[0]), float(given[1]))
        return Place(frame, adjusted, gps_std, content.get("ground_points") is not None)
    except (ValueError, LookupError, TypeError, AttributeError) as fault:
        raise InputError(f"{path} is damaged; run `colmap-netvlad georegister` again.") from fault


def read_frame(folder: Path) -> LocalFrame:
    """Return the frame of a georegistered model.

    Raises:
        InputError: the model is not georegistered, or not to geographic positions.
    """
    place = read_place(folder)
    if place is None:
        raise InputError(
            f"{folder} has no {FILE}: the model is not in the world yet; run "
            "`colmap-netvlad georegister` first."
        )
    if place.frame is not None:
        return place.frame
    raise InputError(
        f"The model in {folder} is in a cartesian system of its own, which has no place on the "
        "globe; positions in latitude and longitude are needed."
    )


def transformed(model: pycolmap.Reconstruction, alignment: Alignment) -> pycolmap.Reconstruction:
    """Return a copy of a model in the world."""
    copy = pycolmap.Reconstruction(model)
    copy.transform(alignment.world_from_model)
    return copy


def _outliers(alignment: Alignment) -> list[tuple[str, float]]:
    """Return names and sizes in m, largest first."""
    found = [
        (alignment.names[i], float(np.linalg.norm(np.nan_to_num(alignment.residuals[i]))))
        for i in np.flatnonzero(alignment.outliers).tolist()
    ]
    return sorted(found, key=lambda item: (-item[1], item[0]))


def _control(control: ControlReport) -> dict[str, object]:
    points = zip(
        control.names,
        control.check.tolist(),
        control.residuals.tolist(),
        control.pixels.tolist(),
        strict=True,
    )
    return {
        "control_rms": [_number(value) for value in control.rms(check=False)],
        "check_rms": [_number(value) for value in control.rms(check=True)],
        "points": {
            name: {
                "check": check,
                "residual": [_number(value) for value in residual],
                "pixels": _number(pixels),
            }
            for name, check, residual, pixels in points
        },
        "notes": list(control.notes),
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)
