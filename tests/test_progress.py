"""Long work says how far it is, in a log file as well; the library itself is silent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from colmap_netvlad import terminal
from colmap_netvlad.runtime import progress


@pytest.fixture(autouse=True)
def _talkative(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(terminal, "LOG_SECONDS", 0.0)
    with progress.report_to(terminal.show_step):
        yield


def test_a_log_file_gets_what_is_done_and_what_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.step("Matching pairs", 4) as bar:
        bar.advance(3)
    assert "Matching pairs 3/4, about 0.0 min to go" in capsys.readouterr().err


def test_work_of_unknown_length_says_how_long_it_took(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with progress.step("Mapping globally", 0) as bar:
        bar.advance(0)
    assert capsys.readouterr().err == "Mapping globally, 0.0 min so far\n"


def test_a_log_file_is_not_flooded(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "LOG_SECONDS", 60.0)
    with progress.step("Matching pairs", 4) as bar:
        bar.advance()
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_a_step_within_a_step(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with progress.step("Mapping 2 clusters", 2) as outer, progress.step("Matching", 4) as inner:
        inner.advance(4)
        outer.advance(1)
        assert terminal._bars is not None
        terminal._bars.refresh()
    shown = capsys.readouterr().err
    assert "Mapping 2 clusters" in shown and "Matching" in shown and "4/4" in shown
    assert terminal._bars is None


def test_a_reporter_of_ones_own_is_told_everything_and_nothing_else_is_shown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    told: list[object] = []

    class Told:
        def advance(self, count: int = 1) -> None:
            told.append(count)

    @contextmanager
    def reporter(title: str, total: int) -> Iterator[progress.Step]:
        told.append((title, total))
        yield Told()
        told.append("end")

    with progress.report_to(reporter), progress.step("Matching pairs", 3) as bar:
        bar.advance()
        bar.advance(2)
    assert told == [("Matching pairs", 3), 1, 2, "end"]
    assert capsys.readouterr().err == ""


def test_silence_is_the_default(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.report_to(progress.silent), progress.step("Matching pairs", 3) as bar:
        bar.advance(3)
    assert capsys.readouterr().err == ""
