"""Train the grid of the paper's table 6 (model x loss x mining) and print it beside the paper's.

    python scripts/train_grid.py annotations --validation sarawak_palm \\
        --validation corpus_christi --weights vgg16=vgg16.safetensors --output runs/grid

The paper trains on 21,622 photos, 20 epochs of 2,000 batches, on a graphics card. The size here
is chosen by --epochs, --iterations, --views and --width, and stands above the table; what can be
compared is the order of the rows, not the figures, since photos and truth differ. Rows done
before are not trained again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import write_atomically
from colmap_netvlad.terminal import Command
from colmap_netvlad.training.options import TrainOptions
from colmap_netvlad.training.run import TrainReport, train
from colmap_netvlad.training.scenes import load_dataset
from colmap_netvlad.training.validate import Score, mean_score


@dataclass(frozen=True)
class Model:
    """A model of the paper: its trunk here, and the last stage frozen in kept features."""

    name: str
    trunk: str
    aggregation: str
    frozen: str


MODELS = {
    model.name: model
    for model in (
        Model("NetVLAD", "vgg16", "netvlad", "conv5_2"),
        Model("GeM", "vgg16", "gem", "conv5_2"),
        Model("MIRorR", "resnet50", "max", "layer3"),
        # The laptop's trunk, for all three: no ImageNet weights of ResNet-50 come with us.
        Model("MIRorR (Lite0)", "efficientnet-lite0-stage5", "max", "block9"),
        Model("NetVLAD (Lite0)", "efficientnet-lite0-stage5", "netvlad", "block9"),
        Model("GeM (Lite0)", "efficientnet-lite0-stage5", "gem", "block9"),
    )
}

RECIPES = (("triplet", "global"), ("triplet", "nontrivial"), ("ranked-list", "nontrivial"))
"""Loss and sample mining of the table's rows."""

PAPER = {
    ("NetVLAD", "triplet", "global"): (85.74, 88.30, 73.14),
    ("NetVLAD", "triplet", "nontrivial"): (85.71, 88.58, 72.07),
    ("NetVLAD", "ranked-list", "nontrivial"): (86.84, 89.62, 74.01),
    ("GeM", "triplet", "global"): (82.09, 85.52, 67.02),
    ("GeM", "triplet", "nontrivial"): (80.46, 85.32, 65.89),
    ("GeM", "ranked-list", "nontrivial"): (82.32, 85.86, 68.04),
    ("MIRorR", "triplet", "global"): (84.44, 87.92, 72.30),
    ("MIRorR", "triplet", "nontrivial"): (83.08, 85.67, 71.46),
    ("MIRorR", "ranked-list", "nontrivial"): (85.75, 88.51, 73.24),
}
"""Accuracy at k = 30 on the paper's three test datasets, % (table 6)."""


@click.command(cls=Command, help=__doc__)
@click.argument("datasets", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--validation", "held_out", multiple=True, required=True, help="Name of a scene.")
@click.option("--weights", multiple=True, help="TRUNK=FILE; a trunk without is downloaded.")
@click.option("--model", "models", multiple=True, default=["NetVLAD", "GeM", "MIRorR"])
@click.option("--output", required=True, type=click.Path(path_type=Path))
@click.option("--epochs", default=20, show_default=True)
@click.option("--iterations", default=2000, show_default=True)
@click.option("--views", default=0, show_default=True, help="Kept views; 0: train all layers.")
@click.option("--width", default=480, show_default=True)
@click.option("--height", default=320, show_default=True)
@click.option("--learning-rate", default=1e-5, show_default=True)
@click.option("--rotations", default=4, show_default=True)
def main(
    datasets: tuple[Path, ...],
    held_out: tuple[str, ...],
    weights: tuple[str, ...],
    models: tuple[str, ...],
    output: Path,
    epochs: int,
    iterations: int,
    views: int,
    width: int,
    height: int,
    learning_rate: float,
    rotations: int,
) -> None:
    scenes = load_dataset(datasets)
    training = load_dataset(datasets, held_out)
    validation = [scene for scene in scenes if scene.name in held_out]
    files = dict(pair.split("=", 1) for pair in weights)
    rows = []
    for name in models:
        if name not in MODELS:
            raise InputError(f"No model is called {name!r}: there are {', '.join(MODELS)}.")
        model = MODELS[name]
        for loss, mining in RECIPES:
            options = TrainOptions(
                trunk=model.trunk,
                weights=files.get(model.trunk),
                aggregation=model.aggregation,
                frozen=model.frozen if views else None,
                loss=loss,
                mining=mining,
                positives=1 if mining == "global" else 3,
                epochs=epochs,
                iterations=iterations,
                views=views,
                width=width,
                height=height,
                long_side=width,
                learning_rate=learning_rate,
                rotations=rotations,
            )
            folder = output / f"{name}-{loss}-{mining}".replace(" ", "-")
            report = train(training, validation, options, folder, cache=output / "cache")
            rows.append((name, loss, mining, report))
            write_atomically(output / "grid.md", table(rows, options, len(training)))
    click.echo((output / "grid.md").read_text(encoding="utf-8"), nl=False)


def table(rows: list[tuple[str, str, str, TrainReport]], options: TrainOptions, scenes: int) -> str:
    """Return the grid as Markdown: last epoch, and before training; mAP / accuracy@10 / @20."""
    lines = [
        f"{scenes} training scenes, {options.epochs} epochs of {options.iterations} batches, "
        f"{options.width} x {options.height} px, "
        + (f"{options.views} kept views a photo." if options.views else "all layers trained."),
        "",
        "| model | loss | mining | before | after | best epoch | paper's accuracy, datasets 1-3 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, loss, mining, report in rows:
        best = max(report.history, key=lambda entry: entry.figure)
        paper = PAPER.get((name.split(" ")[0], loss, mining), ())
        cells = [
            name,
            loss,
            mining,
            _cell(list(report.history[0].scores.values())),
            _cell(list(report.history[-1].scores.values())),
            f"{_cell(list(best.scores.values()))} ({best.epoch})",
            " / ".join(f"{value:.2f}" for value in paper),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(scores: list[Score]) -> str:
    mean = mean_score(scores)
    return (
        f"{100 * mean.mean_average_precision:.1f} / {100 * mean.accuracy10:.1f} / "
        f"{100 * mean.accuracy20:.1f}"
    )


if __name__ == "__main__":
    main()
