"""Whose a file of an interrupted run is: runs that write to one output at the same time keep their states in files of their own."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.staging import SLOTS, claim, release


class StateFile:
    """The path of a state that no other run touches until this one has removed it, or is dead."""

    def __init__(self, path: Path, lock: int) -> None:
        self.path = path
        self._lock: int | None = lock

    def remove(self) -> None:
        """The state is of no more use."""
        self.path.unlink(missing_ok=True)
        self.release()

    def release(self) -> None:
        """Leave the state, if there is one, to whoever comes next."""
        if self._lock is not None:
            release(_lock_of(self.path), self._lock)
            self._lock = None

    def __del__(self) -> None:
        self.release()


def own_state_file(wanted: Path, fits: Callable[[Path], bool]) -> StateFile:
    """The state to go on from, at `wanted`, `wanted`.2 and so on, or the first of these that is free; `fits` tells ours from others'.

    Raises SettingsError where only states of other runs are there, all of them dead.
    """
    free: StateFile | None = None
    others = []
    for path in (wanted, *(wanted.with_name(f"{wanted.name}.{number}") for number in range(2, SLOTS + 1))):
        there = os.path.lexists(path)
        if not there and free is not None and not os.path.lexists(_lock_of(path)):
            continue
        if (lock := claim(_lock_of(path))) is None:
            continue  # a living run keeps its state there
        file = StateFile(path, lock)
        if there and fits(path):
            return file
        if there:
            others.append(path)
        elif free is None:
            free = file
    if others or free is None:
        told = others[0] if others else wanted
        raise SettingsError(f"{told}: it belongs to another base, other settings or other views; repeat those, or delete the file to start anew")
    return free


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")
