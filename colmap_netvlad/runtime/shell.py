"""Commands as the user's shell takes them."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Sequence


def command_line(words: Sequence[str]) -> str:
    """Return words as one line to copy into a shell: quoted for POSIX, or for Windows there."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)
