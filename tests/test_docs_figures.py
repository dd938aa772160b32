"""The docs' figures can be drawn again: what `scripts/make_figures.py` uses is still there."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from colmap_netvlad.demo.render import RenderedFlight
from colmap_netvlad.project import Project
from colmap_netvlad.retrieval.places import agreeing_matches

SCRIPT = Path(__file__).parents[1] / "scripts" / "make_figures.py"


def test_the_figures_of_a_small_flight(
    flight: RenderedFlight,
    project_copy: Callable[..., Project],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    spec = importlib.util.spec_from_file_location("make_figures", SCRIPT)
    assert spec is not None and spec.loader is not None
    figures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figures)
    monkeypatch.setattr(figures, "CLUSTER", 6)
    project = project_copy(matched=True)

    rounds = figures.draw_rounds(flight, project)
    cut = figures.draw_cut(flight, project)
    assert len(rounds.axes) == 3 and len(cut.axes) == 2
    figures.save(cut, tmp_path / "cut.png")
    assert (tmp_path / "cut.png").stat().st_size > 1000

    (one, *_), (other, *_) = figures.places_of(project, flight.names[:2]).values()
    matches, agree = figures.agreement(one, other)
    assert len(matches) == len(agree) and agree.sum() == agreeing_matches(one, other)
