"""Ctrl-C and SIGTERM are heard whatever Python is at."""

from __future__ import annotations

import signal
import sys
import time
import weakref
from collections.abc import Iterator

import pytest

from colmap_netvlad.terminal import hear_interrupts


class Taken:
    """Something that is taken apart."""


@pytest.fixture(autouse=True)
def hearing(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    kept = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # put back at the end
    hear_interrupts()
    yield
    signal.signal(signal.SIGTERM, kept)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_meets_an_object_being_taken_apart_is_not_lost(
    sent: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    taken, met = Taken(), []

    def gone(_: object) -> None:
        met.append(time.monotonic())
        signal.raise_signal(sent)

    watched = weakref.ref(taken, gone)
    with pytest.raises(KeyboardInterrupt):
        del taken
        assert met and watched() is None
        time.sleep(30)
    assert time.monotonic() - met[0] < 10
    assert capsys.readouterr().err == ""


def test_other_faults_of_objects_being_taken_apart_are_shown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    taken = Taken()
    watched = weakref.ref(taken, lambda _: 1 / 0)
    del taken
    assert watched() is None
    assert "ZeroDivisionError" in capsys.readouterr().err
