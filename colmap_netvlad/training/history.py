"""The record of a training run: learning rate, loss and scores of its epochs."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from colmap_netvlad.runtime.files import atomic_path, write_atomically
from colmap_netvlad.training.validate import Score, mean_score


@dataclass(frozen=True)
class Epoch:
    """A validated epoch.

    Attributes:
        epoch: epochs trained so far; 0 is the network before training.
        learning_rate: of the coming epoch.
        loss: mean over the epoch's batches; NaN before training.
        scores: by validation scene.
    """

    epoch: int
    learning_rate: float
    loss: float
    scores: dict[str, Score]

    @property
    def figure(self) -> float:
        """What the best epoch is chosen by: the mean of the scenes' mAP."""
        if not self.scores:
            return -math.inf
        return mean_score(list(self.scores.values())).mean_average_precision

    def line(self) -> str:
        """Return one line for the terminal."""
        text = f"epoch {self.epoch}"
        if not math.isnan(self.loss):
            text += f": loss {self.loss:.4f}"
        if self.scores:
            mean = mean_score(list(self.scores.values()))
            each = ", ".join(
                f"{name} {100 * score.mean_average_precision:.1f}"
                for name, score in self.scores.items()
            )
            text += (
                f", mAP {100 * mean.mean_average_precision:.1f} ({each}), accuracy@10 "
                f"{100 * mean.accuracy10:.1f}, @20 {100 * mean.accuracy20:.1f}"
            )
        return text

    def as_dict(self) -> dict[str, Any]:
        """Plain data; JSON has no NaN, so an absent loss is null."""
        record = asdict(self)
        record["loss"] = None if math.isnan(self.loss) else self.loss
        return record

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Epoch:
        """Read back what `as_dict` made."""
        loss = math.nan if record["loss"] is None else record["loss"]
        scores = {name: Score(**score) for name, score in record["scores"].items()}
        return cls(record["epoch"], record["learning_rate"], loss, scores)


def write_history(folder: Path, history: Sequence[Epoch]) -> None:
    """Write history.json, history.csv and curves.png into a run's folder."""
    write_atomically(
        folder / "history.json", json.dumps([entry.as_dict() for entry in history], indent=1)
    )
    write_atomically(folder / "history.csv", _table(history))
    draw_curves(folder / "curves.png", history)


def _table(history: Sequence[Epoch]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    figures = ("mean_average_precision", "accuracy10", "accuracy20")
    scenes = list(history[0].scores)
    columns = [f"{scene} {figure}" for scene in scenes for figure in figures]
    writer.writerow(["epoch", "learning_rate", "loss", *columns])
    for entry in history:
        values = [getattr(entry.scores[scene], figure) for scene in scenes for figure in figures]
        loss = "" if math.isnan(entry.loss) else f"{entry.loss:.6g}"
        row = [entry.epoch, f"{entry.learning_rate:.6g}", loss]
        writer.writerow([*row, *(f"{value:.5f}" for value in values)])
    return out.getvalue()


def draw_curves(path: Path, history: Sequence[Epoch]) -> None:
    """Draw loss and mAP over the epochs into a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    FigureCanvasAgg(figure)
    losses, scores = figure.subplots(1, 2)
    epochs = [entry.epoch for entry in history]
    losses.plot(epochs, [entry.loss for entry in history], marker=".")
    losses.set(xlabel="epoch", ylabel="loss", title="Training")
    for scene in history[0].scores:
        values = [100 * entry.scores[scene].mean_average_precision for entry in history]
        scores.plot(epochs, values, marker=".", label=scene)
    if history[0].scores:
        mean = [100 * entry.figure for entry in history]
        scores.plot(epochs, mean, color="black", linewidth=2, label="mean")
        scores.legend(fontsize="small")
    scores.set(xlabel="epoch", ylabel="mAP, %", title="Validation scenes")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
