"""Tables 5, 6 and 8 of the paper from comparisons of our own, as Markdown.

    python scripts/paper_tables.py sheffield/compare.json sarawak/compare.json > tables.md

Each argument is a scene's `compare.json`, with a name of its own where `name=path` is given.
The published figures stand in their own columns: other photos, other features, so they are
there to see what moves in the same direction, not to be beaten.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from colmap_netvlad.comparison.result import Comparison, MethodResult, read_json
from colmap_netvlad.terminal import Command

Figure = str
Published = tuple[Figure, Figure, Figure]

SOURCE = "UAVPairs: A Challenging Benchmark for Match Pair Retrieval of Large-scale UAV Images"

PUBLISHED_SETS = (
    "The paper's dataset 1 has 3,743, dataset 2 has 4,030 and dataset 3 has 4,318 photos; "
    "retrieval number 30; models trained on UAVPairs (21,622 photos), which is not public."
)

# Rows of the paper: what it calls them, our method of the same recipe, its figures. Models of the
# training grid are compared by path: `netvlad-triplet-global.safetensors` has that name.
TABLE_5: tuple[tuple[str, str | None, Published], ...] = (
    ("NetVLAD, VGG-16, Pittsburgh", "netvlad", ("81.37", "87.29", "72.80")),
    ("NetVLAD, VGG-16, UAVPairs", "netvlad-triplet-global", ("85.74", "88.30", "73.14")),
    ("GeM, VGG-16, Flickr", "gem", ("73.02", "83.38", "63.56")),
    ("GeM, VGG-16, UAVPairs", "gem-triplet-global", ("82.09", "85.52", "67.02")),
    ("MIRorR, ResNet-50, GL3D", None, ("73.68", "80.31", "62.61")),
    ("MIRorR, ResNet-50, UAVPairs", "mirror-triplet-global", ("84.44", "87.92", "72.30")),
)

TABLE_6: tuple[tuple[str, str | None, Published], ...] = (
    (
        "NetVLAD, triplet, global hard negative",
        "netvlad-triplet-global",
        ("85.74", "88.30", "73.14"),
    ),
    (
        "NetVLAD, triplet, batched nontrivial",
        "netvlad-triplet-nontrivial",
        ("85.71", "88.58", "72.07"),
    ),
    ("NetVLAD, ranked list, batched nontrivial", "netvlad-o", ("86.84", "89.62", "74.01")),
    ("GeM, triplet, global hard negative", "gem-triplet-global", ("82.09", "85.52", "67.02")),
    ("GeM, triplet, batched nontrivial", "gem-triplet-nontrivial", ("80.46", "85.32", "65.89")),
    ("GeM, ranked list, batched nontrivial", "gem-o", ("82.32", "85.86", "68.04")),
    ("MIRorR, triplet, global hard negative", "mirror-triplet-global", ("84.44", "87.92", "72.30")),
    (
        "MIRorR, triplet, batched nontrivial",
        "mirror-triplet-nontrivial",
        ("83.08", "85.67", "71.46"),
    ),
    ("MIRorR, ranked list, batched nontrivial", "mirror-o", ("85.75", "88.51", "73.24")),
)

TABLE_8: dict[str, dict[str, Published]] = {
    "Registered images": {
        "bow": ("3,716", "4,029", "4,267"),
        "vlad": ("3,730", "4,027", "4,248"),
        "netvlad": ("3,709", "4,029", "4,266"),
        "netvlad-o": ("3,732", "4,029", "4,297"),
    },
    "3D points": {
        "bow": ("1,002,275", "1,514,668", "2,087,310"),
        "vlad": ("965,066", "1,477,146", "2,080,135"),
        "netvlad": ("919,939", "1,514,529", "2,069,065"),
        "netvlad-o": ("936,819", "1,523,979", "2,088,319"),
    },
    "Mean reprojection error, px": {
        "bow": ("0.703", "0.809", "0.758"),
        "vlad": ("0.695", "0.793", "0.758"),
        "netvlad": ("0.673", "0.776", "0.757"),
        "netvlad-o": ("0.676", "0.780", "0.758"),
    },
}
"""Published figures of BoW, VLAD, NetVLAD and NetVLAD-O under our names of these methods."""

MISSING = "–"


@dataclass(frozen=True)
class Scene:
    """One comparison under the name it has in the tables."""

    name: str
    comparison: Comparison

    def method(self, name: str | None) -> MethodResult | None:
        """Return a method's figures, or None where it was not compared or failed."""
        found = (m for m in self.comparison.methods if m.name == name and not m.failed)
        return next(found, None)


def read_scene(argument: str) -> Scene:
    """Read `name=path` or a path, whose scene is named after its folder.

    Raises:
        InputError: no such file, or not a comparison.
    """
    name, _, given = argument.rpartition("=")
    path = Path(given)
    folder = path.resolve().parent
    if not name:
        name = folder.parent.name if folder.name.endswith("-compare") else folder.name
    return Scene(name, read_json(path))


def tables(scenes: Sequence[Scene]) -> str:
    """Return tables 5, 6 and 8 and what they are made from, as Markdown."""
    parts = [
        "# Tables 5, 6 and 8 of the paper, made again",
        "\n".join(_scene_line(scene) for scene in scenes),
        f"Published figures (P 1 to P 3): {SOURCE}. {PUBLISHED_SETS} Ours are measured on other, "
        "smaller scenes with COLMAP's features and mapper; the columns cannot be compared number "
        "by number, only which row is ahead. Rows without ours were not among the methods "
        "compared.",
        _accuracy_table("Table 5: retrieval accuracy by training data, %", TABLE_5, scenes),
        _accuracy_table("Table 6: retrieval accuracy by loss and sampling, %", TABLE_6, scenes),
        _model_table(scenes),
        _others(scenes),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _scene_line(scene: Scene) -> str:
    c = scene.comparison
    mapped = sorted({m.model.k for m in c.methods if m.model})
    models = f", models at k = {mapped[0]}" if mapped else ", no models"
    return f"- {scene.name}: {c.images:,} photos, k = {c.k}{models}, seed {c.seed}"


def _accuracy_table(
    title: str, rows: Sequence[tuple[str, str | None, Published]], scenes: Sequence[Scene]
) -> str:
    lines = [_row(label, [_accuracy(s.method(ours)) for s in scenes], p) for label, ours, p in rows]
    return "\n".join([f"## {title}", "", *_head("Model", scenes), *lines])


def _model_table(scenes: Sequence[Scene]) -> str:
    read: dict[str, Callable[[MethodResult], Figure]] = {
        "Registered images": lambda m: f"{m.model.registered:,}" if m.model else MISSING,
        "3D points": lambda m: f"{m.model.points:,}" if m.model else MISSING,
        "Mean reprojection error, px": lambda m: (
            f"{m.model.mean_reprojection_error:.3f}"
            if m.model and m.model.mean_reprojection_error is not None
            else MISSING
        ),
    }
    lines = []
    for measure, published in TABLE_8.items():
        for name, figures in published.items():
            methods = [scene.method(name) for scene in scenes]
            ours = [MISSING if m is None else read[measure](m) for m in methods]
            lines.append(_row(f"{measure}: {name}", ours, figures))
    return "\n".join(
        ["## Table 8: reconstruction", "", *_head("Metric and method", scenes), *lines]
    )


def _others(scenes: Sequence[Scene]) -> str:
    """Methods that were compared and that the paper does not have, in one table of our own."""
    known = {name for _, name, _ in (*TABLE_5, *TABLE_6)} | set(TABLE_8["3D points"])
    names = dict.fromkeys(m.name for s in scenes for m in s.comparison.methods)
    ours = [name for name in names if name not in known]
    if not ours:
        return ""
    head = "| Method | " + " | ".join(f"{s.name}, accuracy, % | registered" for s in scenes) + " |"
    lines = [f"## Methods that the paper does not have\n\n{head}"]
    lines.append("|---|" + "---:|---:|" * len(scenes))
    for name in ours:
        cells = []
        for scene in scenes:
            method = scene.method(name)
            model = method.model if method else None
            cells += [_accuracy(method), f"{model.registered:,}" if model else MISSING]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _accuracy(method: MethodResult | None) -> Figure:
    figures = method.best_k if method else None
    return MISSING if not figures or figures.accuracy is None else f"{100 * figures.accuracy:.2f}"


def _head(first: str, scenes: Sequence[Scene]) -> list[str]:
    columns = [first, *(f"{scene.name} (ours)" for scene in scenes), "P 1", "P 2", "P 3"]
    return ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * (len(columns) - 1)]


def _row(label: str, ours: Sequence[Figure], published: Published) -> str:
    return "| " + " | ".join([label, *ours, *published]) + " |"


@click.command(cls=Command, help=__doc__)
@click.argument("comparisons", nargs=-1, required=True)
def main(comparisons: tuple[str, ...]) -> None:
    """Print the tables on standard output."""
    sys.stdout.write(tables([read_scene(argument) for argument in comparisons]))


if __name__ == "__main__":
    main()
