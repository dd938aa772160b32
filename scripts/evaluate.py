"""Measure methods and checkpoints on annotated scenes: mAP, accuracy at k = 10 and 20, time.

    python scripts/evaluate.py annotations/sarawak_palm --databases matched \\
        --method bow --method vlad --method netvlad-o --method runs/try/best.safetensors

Scenes must have been annotated from exhaustively matched databases (`annotate --databases`),
which are their truth. All methods run on the same photos in one run; a Markdown table is printed.
"""

from __future__ import annotations

from pathlib import Path

import click

from colmap_netvlad.retrieval.options import COMPARED, RetrievalOptions
from colmap_netvlad.terminal import Command
from colmap_netvlad.training.evaluate import evaluate, markdown
from colmap_netvlad.training.scenes import load_dataset


@click.command(cls=Command, help=__doc__)
@click.argument("datasets", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--databases", required=True, type=click.Path(path_type=Path))
@click.option("--method", "methods", multiple=True, default=["bow", "vlad"], show_default=True)
@click.option("--rerank", default=COMPARED, show_default=True, help="As in `pairs`.")
def main(
    datasets: tuple[Path, ...], databases: Path, methods: tuple[str, ...], rerank: int
) -> None:
    options = RetrievalOptions(rerank=rerank)
    click.echo(markdown(evaluate(methods, load_dataset(datasets), databases, options)), nl=False)


if __name__ == "__main__":
    main()
