"""A model's quality report: what the command `report` does, and `reconstruct` at its end."""

from __future__ import annotations

import json
import logging
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_netvlad.colmap.database import image_names, open_database
from colmap_netvlad.colmap.positions import find_priors
from colmap_netvlad.geo.georeference import FILE as GEOREFERENCE
from colmap_netvlad.graph.lookalikes import Moves
from colmap_netvlad.graph.verified import with_matches
from colmap_netvlad.mapping.extend import largest_model, read_model
from colmap_netvlad.mapping.output import numbered, outputs
from colmap_netvlad.mapping.summary import of_database, put_aside
from colmap_netvlad.photos.positions import place
from colmap_netvlad.project import DATABASE_NAMES
from colmap_netvlad.report.flight_page import render_flight_page
from colmap_netvlad.report.quality import (
    Check,
    GroundPoint,
    Level,
    Quality,
    Run,
    Source,
    judge,
    measure,
    overall,
    verdict_lines,
)
from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.runtime.version import VERSION

logger = logging.getLogger(__name__)

PAGE = "report.html"
"""The page's name; it lies in the model's folder."""

RUN = "run.json"
"""How a model was made, in the model's folder."""


@dataclass(frozen=True, eq=False)
class FlightReport:
    """A report that was written.

    Attributes:
        page: the HTML file.
        quality: its figures.
        checks: the verdict's lines.
    """

    page: Path
    quality: Quality
    checks: list[Check]

    @property
    def verdict(self) -> Level:
        """The worst level of the checks."""
        return overall(self.checks)

    @property
    def lines(self) -> list[str]:
        """The verdict for the terminal."""
        return verdict_lines(self.quality, self.checks, self.page)


def report(
    sparse: Path,
    database: Path | None = None,
    images: Path | None = None,
    output: Path | None = None,
) -> FlightReport:
    """Write the quality report of a COLMAP model, made by whomever.

    Args:
        sparse: the model's folder (cameras, images, points3D), or a folder of models, of which
            the largest is taken.
        database: the COLMAP database it was made from; default: `project.db` or `database.db`
            in the model's folder or up to two above it. Without one the page says what it
            cannot show.
        images: the photo folder; default: `images` beside the database or the model.
        output: the page; default `report.html` in the model's folder.

    Raises:
        InputError: no model there, an argument that does not exist, a database of other photos,
            or a page that cannot be written.
    """
    folder = model_of(sparse)
    model = read_model(folder)
    places = [folder, *folder.absolute().parents[:2]]
    if database is None:
        beside = (place / name for place in places for name in DATABASE_NAMES)
        database = next((path for path in beside if path.is_file()), None)
        if database is not None and model.num_images() and not of_database(model, database):
            logger.warning(put_aside(database))
            database = None
        if database is not None:
            database = with_matches(database)
    elif not _same_photos(model, database):
        raise InputError(
            f"{database} has none of the photos of {folder}: it is another project's; mend "
            "`database`, or leave it out."
        )
    if images is None:
        near = [*([] if database is None else [database.parent]), *places]
        images = next((place / "images" for place in near if (place / "images").is_dir()), None)
    elif not images.is_dir():
        raise InputError(f"The photo folder {images} does not exist; mend `images`.")
    return write_report(model, folder, database, images, output)


def write_report(
    model: pycolmap.Reconstruction,
    folder: Path,
    database: Path | None,
    images: Path | None,
    output: Path | None = None,
    moves: Moves | None = None,
) -> FlightReport:
    """Write the report of a model that lies in `folder` (see `report`).

    Args:
        moves: of the database's pairs, where they were read before.

    Raises:
        InputError: the database cannot be read, or the page not be written.
    """
    source = Source(
        name=_name(folder, database),
        model=model,
        folder=folder,
        database=database,
        images=images,
        positions=find_positions(model, database, images),
        elsewhere=_elsewhere(model, folder),
        run=read_run(folder),
        ground=read_ground_points(folder),
        moves=moves,
    )
    quality = measure(source)
    checks = judge(quality)
    page = output or folder / PAGE
    write_atomically(page, render_flight_page(quality, checks))
    return FlightReport(page, quality, checks)


def read_ground_points(folder: Path) -> list[GroundPoint]:
    """Return how ground points lie in a georegistered model; none where it has none."""
    path = folder / GEOREFERENCE
    if not path.is_file():
        return []
    try:
        points = (json.loads(path.read_text("utf-8"))["ground_points"] or {}).get("points", {})
        return [
            GroundPoint(name, point["check"], point["residual"], point["pixels"])
            for name, point in points.items()
        ]
    except (ValueError, KeyError, TypeError, AttributeError):
        logger.warning("%s cannot be read; the report has no ground points.", path)
        return []


def model_of(sparse: Path) -> Path:
    """Return a model's folder: the one given, or the largest model in it.

    Raises:
        InputError: there is none.
    """
    if not sparse.is_dir():
        raise InputError(f"The folder {sparse} does not exist; `sparse` names that of a model.")
    if _holds_model(sparse):
        return sparse
    models = _models_in(sparse)
    if not models:
        raise InputError(
            f"{sparse} holds no COLMAP model (cameras, images and points3D, .bin or .txt)."
        )
    return largest_model(models)


def find_positions(
    model: pycolmap.Reconstruction, database: Path | None, images: Path | None
) -> dict[str, NDArray[np.float64]]:
    """Return east, north and up of every photo whose position is known, m.

    Position priors of the database come first, then GPS in the photos.
    """
    names = {image.name for image in model.images.values()}
    if database is not None:
        names.update(image_names(database))
    listed = sorted(names)
    metres = place(find_priors(listed, database, images), listed).metres
    return {name: row for name, row in zip(listed, metres, strict=True) if np.isfinite(row).all()}


def save_run(folder: Path, run: Run) -> None:
    """Write beside a model how it was made, so that its report can say so."""
    write_atomically(folder / RUN, json.dumps(asdict(run), indent=1) + "\n")


def save_runs(output: Path, run: Run) -> None:
    """Write into each model of a folder of models how they were made."""
    for folder in _models_in(output):
        save_run(folder, run)


def made_before(output: Path, run: Run) -> Path | None:
    """Return the newest of `output`, `output`-2, ... where its models are what `run` would make.

    They are: the same program made them from the same matches with the same options.
    """
    made = [path for path in outputs(output) if path.is_dir() and _models_in(path)]
    if not made:
        return None
    runs = [read_run(folder) for folder in _models_in(made[-1])]
    same = all(
        one is not None
        and (one.source, one.options, one.versions) == (run.source, run.options, run.versions)
        for one in runs
    )
    return made[-1] if same else None


def all_reported(output: Path) -> bool:
    """Whether each model of a folder of models has its page."""
    return all((folder / PAGE).is_file() for folder in _models_in(output))


def _models_in(output: Path) -> list[Path]:
    own = numbered(output)
    others = sorted(set(output.iterdir()).difference(own))
    return [folder for folder in (*own, *others) if _holds_model(folder)]


def read_run(folder: Path) -> Run | None:
    """Return how a model was made, or None where its folder does not say."""
    try:
        return Run(**json.loads((folder / RUN).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _same_photos(model: pycolmap.Reconstruction, database: Path) -> bool:
    with open_database(database) as opened:
        names = {row.name for row in opened.images()}
    return not model.num_images() or any(i.name in names for i in model.images.values())


def _holds_model(folder: Path) -> bool:
    return any(
        all((folder / f"{part}{kind}").is_file() for part in ("cameras", "images", "points3D"))
        for kind in (".bin", ".txt")
    )


def _elsewhere(model: pycolmap.Reconstruction, folder: Path) -> dict[str, str]:
    """Return images that the models beside this one have and it has not, by model."""
    if not folder.name.isdigit():
        return {}
    own = {model.image(i).name for i in model.reg_image_ids()}
    found: dict[str, str] = {}
    for other in numbered(folder.absolute().parent):
        if other.name != folder.name and _holds_model(other):
            beside = read_model(other)
            names = {beside.image(i).name for i in beside.reg_image_ids()}
            found.update(dict.fromkeys(names - own, f"model {other.name}"))
    return found


def _name(folder: Path, database: Path | None) -> str:
    """Name the project by the folder a surveyor would name it by."""
    workspace = database.absolute().parent if database is not None else folder.absolute()
    while workspace.name in ("sparse", "colmap", "") or workspace.name.isdigit():
        if workspace.parent == workspace:
            break
        workspace = workspace.parent
    return workspace.name or str(folder)


def report_models(
    output: Path, database: Path, images: Path | None, moves: Moves | None = None
) -> list[FlightReport]:
    """Write the report of every model of a run, each into its folder, the largest first.

    A report that cannot be written is no reason to lose a model: the fault is said, and the
    others are written.

    Args:
        moves: of the database's pairs, where they were read before.
    """
    found = [(read_model(folder), folder) for folder in _models_in(output)]
    found.sort(key=lambda item: -item[0].num_reg_images())
    reports = []
    for model, folder in found:
        try:
            reports.append(write_report(model, folder, database, images, moves=moves))
        except InputError as fault:
            logger.warning("No quality report of %s: %s", folder, fault.message)
    return reports


def run_of(command: str, seconds: Mapping[str, float], options: Mapping[str, Any]) -> Run:
    """Return what a report says about how its model was made.

    Args:
        command: the command line, or what stands for it.
        seconds: duration by stage, s.
        options: of dataclasses; groups within are written as `group.option`, None is a default.
    """
    return Run(command, dict(seconds), dict(_flat(options)), versions())


def versions() -> dict[str, str]:
    """Return the versions of the programs a model depends on."""
    return {
        "colmap-netvlad": VERSION,
        "pycolmap": pycolmap.__version__,
        "Python": platform.python_version(),
        "system": platform.platform(terse=True),
    }


def _flat(options: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, str]]:
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{group}{name}.")
        elif name != "command":
            yield f"{group}{name}", "default" if value is None else str(value)
