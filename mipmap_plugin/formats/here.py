"""Paths and sizes as people are told them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Sequence
from pathlib import Path


def from_here(path: Path) -> str:
    """A path from the current directory if it lies in it; any other as it is."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def told_from_here(text: str) -> str:
    """A text whose paths, as jobs have them, are told as `from_here` tells them."""
    try:
        here = re.escape(f"{Path.cwd()}{os.sep}")
    except FileNotFoundError:  # the current directory was deleted: no path lies in it
        return text
    return re.sub(rf"(?<![^\s'\"(]){here}", "", text)


def typed(words: Sequence[str]) -> str:
    """The words of a command as they are typed in a shell: that of Windows knows double quotes only."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


def size_in_bytes(count: int) -> str:
    """A size in kB or MB."""
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"
