"""Long work says how far it is, in a log file as well."""

from __future__ import annotations

import pytest

from colmap_netvlad.runtime import progress


@pytest.fixture(autouse=True)
def _talkative(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.0)


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
    monkeypatch.setattr(progress, "LOG_SECONDS", 60.0)
    with progress.step("Matching pairs", 4) as bar:
        bar.advance()
    assert capsys.readouterr().err == ""
