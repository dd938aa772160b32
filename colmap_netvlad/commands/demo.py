"""`colmap-netvlad demo`: render a flight, reconstruct it, hold the result against the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pycolmap

from colmap_netvlad.colmap.features import FeatureOptions, extract_features
from colmap_netvlad.commands.pairs import make_pairs, summary
from colmap_netvlad.commands.reconstruct import (
    ReconstructOptions,
    ReconstructReport,
    reconstruct,
    report_lines,
)
from colmap_netvlad.demo.check import TruthCheck, check_against_truth
from colmap_netvlad.demo.picture import draw_result
from colmap_netvlad.demo.render import (
    SEEN_FILE,
    FlightOptions,
    RenderedFlight,
    flight_exists,
    read_flight,
    render_flight,
)
from colmap_netvlad.mapping.options import MappingOptions
from colmap_netvlad.matching.options import MatchOptions
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.options import RetrievalOptions
from colmap_netvlad.runtime.errors import InputError

DEMO_FLIGHT = FlightOptions(rows=5, columns=6, cross_rows=2)
"""42 photos: five lines, and two across them with the drone turned by 90 degrees."""

PARTNERS = 10
"""k of the demo."""

MAX_FEATURES = 2500
"""Features kept of a photo of 640 x 480 px."""

PICTURE = "result.png"


def run_demo(
    folder: Path,
    method: str,
    flight_options: FlightOptions = DEMO_FLIGHT,
    say: Callable[[str | ReconstructReport], None] = lambda item: None,
) -> TruthCheck:
    """Run the whole pipeline on a rendered flight in `folder` and compare it with the truth.

    A demo of the same options that was stopped goes on where it stopped.

    Args:
        folder: new or empty, or that of an earlier demo of the same options.
        method: retrieval method.
        flight_options: the flight to render.
        say: is told each line of the report, and the report of the reconstruction.

    Raises:
        InputError: `folder` holds something else or cannot be written; as the stages do.
    """
    seed = flight_options.seed
    flight = _flight(folder, flight_options)
    say(f"1. Rendered {len(flight.names)} photos of {flight.width} x {flight.height} px.")

    project = Project(folder / "project.db", flight.images)
    features = extract_features(
        flight.images, project.database, FeatureOptions(max_features=MAX_FEATURES)
    )
    say(f"2. SIFT features in {features.already + features.extracted} photos.")

    say(f"3. Image pairs by {method}:")
    pairs = make_pairs(project, method, RetrievalOptions(k=PARTNERS, seed=seed))
    for line in summary(project, pairs):
        if not line.startswith("Next"):
            say(f"   {line}")

    say("4. Matching and mapping:")
    options = ReconstructOptions(
        mapping=MappingOptions(seed=seed), matching=MatchOptions(seed=seed)
    )
    report = reconstruct(project, options=options)
    say(report)
    for line in report_lines(report):
        say(f"   {line}")

    models = [pycolmap.Reconstruction(report.output / str(i)) for i in range(len(report.models))]
    check = check_against_truth(models, flight)
    say(_verdict(check))
    draw_result(folder / PICTURE, flight, models)
    say(f"Picture: {folder / PICTURE}; photos, database and models are beside it.")
    return check


def _flight(folder: Path, options: FlightOptions) -> RenderedFlight:
    if flight_exists(folder, options):
        flight = read_flight(folder)
        whole = [folder / SEEN_FILE, *(flight.images / name for name in flight.names)]
        if all(file.is_file() for file in whole):
            return flight
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} holds something else; name a new folder with `output`.")
    return render_flight(folder, options)


def _verdict(check: TruthCheck) -> str:
    return (
        f"5. Against the truth: {check.registered} of {check.images} photos registered; camera "
        f"centres off by {check.mean:.3%} of the flight's extent of {check.extent:.0f} m in the "
        f"mean, {check.largest:.3%} at most: {'passed' if check.passed else 'NOT PASSED'}."
    )
