"""A comparison as CSV, and in sentences."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from colmap_netvlad.comparison.result import EXHAUSTIVE, Comparison, MethodResult
from colmap_netvlad.report.measures import MEASURES, OF_MODEL
from colmap_netvlad.runtime.files import write_atomically

RETRIEVAL_COLUMNS = (
    "pairs", "correct", "accuracy", "recall", "components", "largest_component",
    "articulation_images", "bridges",
)  # fmt: skip


def reference_sentence(comparison: Comparison) -> str:
    """Say what recall and average precision are measured against."""
    pairs = f"{comparison.reference_pairs:,} pairs with more than 15 verified matches"
    if comparison.reference == EXHAUSTIVE:
        return f"Recall and average precision are against all {pairs} of exhaustive matching."
    return (
        f"Recall and average precision are against the union of the methods' own {pairs}: "
        "without exhaustive matching nobody knows the others, so they are upper bounds."
    )


def partners_words(comparison: Comparison) -> str:
    """Say at which k the figures are, and the models where these were made at another."""
    words = f"k = {comparison.k}"
    if comparison.model_k in (None, comparison.k):
        return words
    return f"{words}, mapping, total time and model at k = {comparison.model_k}"


def write_csv(path: Path, comparison: Comparison) -> None:
    """Write a row for each method and k; times and the model stand in the rows they belong to.

    Raises:
        InputError: the file cannot be written.
    """
    rest = [m for m in MEASURES if m.key not in RETRIEVAL_COLUMNS]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["method", "k", *RETRIEVAL_COLUMNS, *(m.key for m in rest), "failed"])
    for method in comparison.methods:
        failed = method.failed or (method.model.failed if method.model else None) or ""
        blank = [""] * len(rest)
        if not method.at_k:
            writer.writerow([method.name, "", *[""] * len(RETRIEVAL_COLUMNS), *blank, failed])
        for figures in method.at_k:
            row = [_cell(getattr(figures, column)) for column in RETRIEVAL_COLUMNS]
            last = figures is method.best_k
            mapped = method.model is not None and figures.k == method.model.k
            figures_of_method = [
                _cell(m.value(method) if (mapped if m.key in OF_MODEL else last) else None)
                for m in rest
            ]
            writer.writerow(
                [method.name, figures.k, *row, *figures_of_method, failed if last else ""]
            )
    write_atomically(path, out.getvalue())


def notes_of(method: MethodResult) -> list[str]:
    """Return what has to be said about a method's figures."""
    notes = list(method.notes)
    if method.timed_earlier:
        notes.append("Its descriptors were reused; the time of describing is the earlier run's.")
    if method.match_measured < 1:
        notes.append(
            f"Matching was timed on {100 * method.match_measured:.0f} % of its pairs and "
            "scaled to all of them."
        )
    if method.failed:
        notes.append(f"Not compared: {method.failed}")
    if method.model and method.model.failed:
        notes.append(f"Mapping failed: {method.model.failed}")
    if method.model and not method.model.failed and not method.model.registered:
        notes.append("Mapping ended without a model: no image could be registered.")
    return notes


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"
