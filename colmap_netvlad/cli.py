"""The command line: parse, call one public function, print.

Every command is a thin function that imports what it needs inside its body, so that `--help`
stays fast and one broken dependency does not take the other commands down.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from colmap_netvlad import __version__
from colmap_netvlad.errors import EXIT_PARTIAL

Command = TypeVar("Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

# Options that several commands share, each worded once.

database_option = click.option(
    "--db",
    "--database_path",
    "database",
    type=click.Path(path_type=Path),
    help="COLMAP database.  [default: project.db or database.db in the current folder]",
)
images_option = click.option(
    "--images",
    "--image_path",
    "images",
    type=click.Path(path_type=Path),
    help="Folder that image names are relative to."
    "  [default: the folder used last, else images/ beside the database]",
)
k_option = click.option(
    "--k", default=30, show_default=True, help="Partners retrieved for each image."
)
model_option = click.option(
    "--model",
    type=FILE,
    help="Checkpoint (.safetensors) of the descriptor model, instead of a named --method.",
)
device_option = click.option(
    "--device", help="Where networks run: cpu, cuda, cuda:1, mps.  [default: the fastest there is]"
)
cache_option = click.option(
    "--cache",
    type=click.Path(path_type=Path),
    help="Our own file of descriptors and rankings.  [default: project.netvlad.db beside the"
    " database]",
)
seed_option = click.option(
    "--seed", default=0, show_default=True, help="Seed of every random choice."
)


def verbose_option(command: Command) -> Command:
    """Add -v, which lets pycolmap's own log through."""

    def set_verbosity(context: click.Context, parameter: click.Parameter, verbose: bool) -> None:
        if not context.resilient_parsing:
            from colmap_netvlad import progress

            progress.verbose = verbose

    return click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=set_verbosity,
        help="Show COLMAP's own log on standard error.",
    )(command)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, "--version", prog_name="colmap-netvlad")
def cli() -> None:
    """Deep image pair retrieval for COLMAP on drone flights.

    From a folder of photos to a sparse model:

    \b
      colmap-netvlad features --images photos --db project.db
      colmap-netvlad pairs --db project.db --k 30
      colmap-netvlad reconstruct --db project.db
    """


@cli.command()
@click.option(
    "--images",
    "--image_path",
    "images",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder of photos; subfolders are searched, names are relative to it.",
)
@click.option(
    "--db",
    "--database_path",
    "database",
    type=click.Path(path_type=Path),
    default=Path("project.db"),
    show_default=True,
    help="COLMAP database to write; made where it is not there.",
)
@click.option(
    "--camera",
    default="auto",
    show_default=True,
    help="Which photos share a camera: auto (equal make, model, focal length and size; without"
    " EXIF equal folder and size), single, per-folder, per-image.",
)
@click.option(
    "--camera-model",
    default="SIMPLE_RADIAL",
    show_default=True,
    help="COLMAP's model of new cameras, SIMPLE_RADIAL or OPENCV for example.",
)
@click.option(
    "--max-image-size",
    type=int,
    help="Longer side at which SIFT runs, px.  [default: COLMAP's, 3200]",
)
@click.option("--max-features", default=8192, show_default=True, help="Most features of a photo.")
@click.option(
    "--masks",
    type=click.Path(path_type=Path),
    help="Folder of masks in COLMAP's way (<photo>.png, black is ignored).",
)
@click.option(
    "--threads", type=int, help="Photos at once.  [default: as processors and memory allow]"
)
@verbose_option
def features(images: Path, database: Path, **options: Any) -> None:
    """Import photos into a COLMAP database and extract SIFT features.

    This writes the database; one of COLMAP 3.x is brought to the schema of COLMAP 4. Photos that
    have features are passed over, so a stopped run goes on where it stopped. Photos that are
    truncated, empty or no photos are listed at the end and left out (exit code 3).
    """
    from colmap_netvlad.features import FeatureOptions, extract_features
    from colmap_netvlad.project import Project
    from colmap_netvlad.retrieval.store import Store

    report = extract_features(images, database, FeatureOptions(**options))
    with Store(Project(database, images).cache) as store:
        store.remember_images(images)
    click.echo(
        f"Photos: {report.photos:,}, {report.already:,} with features before, "
        f"{report.extracted:,} extracted now ({report.features:,} features), "
        f"{report.cameras:,} camera{'s' if report.cameras != 1 else ''} in {database}."
    )
    click.echo(f"Next: colmap-netvlad pairs --db {quoted(database)}")
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.bad])


@cli.command()
@database_option
@images_option
@click.option(
    "--pairs",
    type=click.Path(path_type=Path),
    help="Pairs list (COLMAP's, .csv or .json).  [default: pairs.txt beside the database]",
)
@click.option(
    "--output",
    "--output_path",
    "output",
    type=click.Path(path_type=Path),
    help="Folder of the models.  [default: sparse beside the database; sparse-2, sparse-3, ..."
    " where there are models already]",
)
@click.option(
    "--mapper",
    default="incremental",
    show_default=True,
    help="How the model is built.",
)
@click.option(
    "--copy",
    is_flag=True,
    help="Leave the database as it is and write matches into <name>.copy.db beside it.",
)
@seed_option
@verbose_option
def reconstruct(
    database: Path | None,
    images: Path | None,
    pairs: Path | None,
    output: Path | None,
    mapper: str,
    copy: bool,
    seed: int,
) -> None:
    """Match the pairs, verify them, and build the sparse model.

    This writes matches into the database, where COLMAP keeps them (--copy does not); one of
    COLMAP 3.x is brought to the schema of COLMAP 4. Pairs matched before are not matched again,
    so a stopped run goes on where it stopped.
    """
    from rich.console import Console

    from colmap_netvlad.mapping.options import MappingOptions
    from colmap_netvlad.matching import MatchOptions
    from colmap_netvlad.project import find_project
    from colmap_netvlad.reconstruct import (
        ReconstructOptions,
        check_mapper,
        report_lines,
        report_table,
        working_copy,
    )
    from colmap_netvlad.reconstruct import reconstruct as run

    check_mapper(mapper)
    project = find_project(database, images)
    pairs = pairs or project.pairs
    output = output or project.sparse
    if copy:
        project = working_copy(project)
    report = run(
        project,
        pairs,
        output,
        ReconstructOptions(mapper, MappingOptions(seed=seed), MatchOptions(seed=seed)),
    )
    Console().print(report_table(report))
    click.echo("\n".join(report_lines(report)))
    click.echo(f"Matches are in {project.database}, models in {report.output}.")


def quoted(path: Path) -> str:
    """Return a path as the user's shell takes it."""
    return shlex.quote(str(path))


@cli.command()
@database_option
@images_option
@k_option
@click.option(
    "--method", default=None, help="Retrieval method; `colmap-netvlad methods` lists them."
)
@model_option
@click.option(
    "--format",
    type=click.Choice(["colmap", "csv", "json"]),
    default="colmap",
    show_default=True,
    help="COLMAP's pairs list, or with scores and ranks.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    help="The pairs list.  [default: pairs.txt beside the database]",
)
@click.option(
    "--exact/--hnsw",
    default=None,
    help="Force exact or approximate (HNSW) search.  [default: by the number of images]",
)
@click.option("--vocab-tree", type=FILE, help="Vocabulary tree of the method bow.")
@cache_option
@device_option
@seed_option
@verbose_option
def pairs(
    database: Path | None,
    images: Path | None,
    k: int,
    method: str | None,
    model: Path | None,
    format: str,
    output: Path | None,
    exact: bool | None,
    vocab_tree: Path | None,
    cache: Path | None,
    device: str | None,
    seed: int,
) -> None:
    """Retrieve the k nearest partners of each image and write the pairs list.

    Never writes to the database. Descriptors are kept in project.netvlad.db beside it: a second
    run computes none, ten new photos cost ten.
    """
    from colmap_netvlad.models.catalogue import DEFAULT
    from colmap_netvlad.project import find_project
    from colmap_netvlad.retrieval.methods import RetrievalOptions
    from colmap_netvlad.retrieval.run import make_pairs, summary

    project = find_project(database, images, cache)
    options = RetrievalOptions(
        k=k, model=model, device=device, seed=seed, vocab_tree=vocab_tree, exact=exact
    )
    report = make_pairs(project, method or DEFAULT, options, format, output)
    for line in summary(project, report):
        click.echo(line)
    finish_partial([f"Left out: {name} {reason}" for name, reason in report.ranking.left_out])


@cli.command()
def methods() -> None:
    """List the retrieval methods and their sources."""
    from colmap_netvlad.retrieval.methods import METHODS

    width = max(map(len, METHODS))
    for method in METHODS.values():
        click.echo(f"{method.name:{width}}  {method.summary}")


@cli.command()
@click.option(
    "--output",
    type=FOLDER,
    default=Path("colmap-netvlad-demo"),
    show_default=True,
    help="Folder of the demo: new, or that of a demo to go on with.",
)
@click.option("--method", help="Retrieval method.  [default: as `pairs`]")
@seed_option
@verbose_option
def demo(output: Path, method: str | None, seed: int) -> None:
    """Render a small drone flight, reconstruct it, and check the result against the truth.

    Takes about two minutes. Exit code 1 where a photo is not registered, or a camera centre is
    off by more than 1 % of the flight's extent.
    """
    from dataclasses import replace

    from rich.console import Console

    from colmap_netvlad.demo.run import DEMO_FLIGHT, run_demo
    from colmap_netvlad.models.catalogue import DEFAULT

    console = Console(highlight=False, soft_wrap=True)
    flight = replace(DEMO_FLIGHT, seed=seed)
    if not run_demo(output, method or DEFAULT, flight, console.print).passed:
        sys.exit(1)


def finish_partial(left_out: list[str]) -> None:
    """List on standard error what a finished command left out, and exit with EXIT_PARTIAL."""
    if not left_out:
        return
    for line in left_out:
        click.echo(line, err=True)
    sys.exit(EXIT_PARTIAL)


def main() -> None:
    """Run the command line: the entry point `colmap-netvlad`."""
    cli()


if __name__ == "__main__":
    main()
