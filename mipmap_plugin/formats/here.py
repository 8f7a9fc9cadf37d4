"""Paths as people are told them."""

from __future__ import annotations

from pathlib import Path


def from_here(path: Path) -> str:
    """A path from the current directory if it lies in it; any other as it is."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
