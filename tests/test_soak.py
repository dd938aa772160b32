"""Short runs of what `tests/soak/` does for hours; docs/reliability.md says what that found."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SOAK = Path(__file__).parent / "soak"


@pytest.mark.skipif(sys.platform == "win32", reason="the tries are forks, which Windows has not")
@pytest.mark.parametrize(
    "words",
    [
        ("fuzz.py", "short"),
        ("kill.py", "features", "--times", "1"),
        ("kill.py", "match", "--times", "1", "--signal", "INT"),
        pytest.param(
            ("full.py", "match", "--times", "1"),
            marks=pytest.mark.skipif(
                sys.platform != "linux" or os.geteuid() != 0, reason="only root mounts a small disk"
            ),
        ),
    ],
)
def test_nothing_crashes_and_nothing_is_lost(words: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, SOAK / words[0], *words[1:]], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 with faults" in done.stdout
