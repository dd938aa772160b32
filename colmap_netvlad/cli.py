"""The command line: parse, call one public function, print.

Every command is a thin function that imports what it needs inside its body, so that `--help`
stays fast and one broken dependency does not take the other commands down.
"""

from __future__ import annotations

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
