"""Ownership of the state files of interrupted runs: concurrent runs with the same output keep their states in separate files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.staging import SLOTS, claim, missing_folders, release, remove_empty


class StateFile:
    """A locked state file: no other run touches it until this run removes or releases it, or its process ends."""

    def __init__(self, path: Path, lock: int, made: Sequence[Path] = ()) -> None:
        """`made`: folders around it that were made for it, the innermost first."""
        self.path, self._made = path, made
        self._lock: int | None = lock

    @property
    def files(self) -> list[Path]:
        """The state and its lock, while they are this run's; none once they are released, as others may be there then."""
        return [] if self._lock is None else [self.path, _lock_of(self.path)]

    def remove(self) -> None:
        """Delete the state, which is no longer needed."""
        self.path.unlink(missing_ok=True)
        self.release()

    def release(self) -> None:
        """Unlock the state, if there is one, for the next run."""
        lock, self._lock = self._lock, None  # first, for Ctrl-C may break off what follows, and the lock is closed then
        if lock is not None:
            release(_lock_of(self.path), lock)
            remove_empty(self._made)

    def __del__(self) -> None:
        self.release()


def claim_state_file(requested: Path, whose: Callable[[Path], str]) -> StateFile:
    """Lock and return the state to resume, at `requested`, `requested`.2 and so on, or else the first of these that is free.

    `whose` says whose a state is and what to do with it; "" if it is of this run. Raises SettingsError if there are only states of other runs that
    have ended, which stay where they are, and OSError.
    """
    missing = missing_folders(requested.parent)
    requested.parent.mkdir(parents=True, exist_ok=True)
    free: StateFile | None = None
    foreign = list[tuple[Path, str]]()
    for path in (requested, *(requested.with_name(f"{requested.name}.{number}") for number in range(2, SLOTS + 1))):
        exists = os.path.lexists(path)
        if not exists and free is not None and not os.path.lexists(_lock_of(path)):
            continue
        if (lock := claim(_lock_of(path))) is None:
            continue  # a run that is still going on keeps its state there
        file = StateFile(path, lock, missing)
        others = whose(path) if exists else ""
        if exists and not others:
            return file
        if exists:
            foreign.append((path, others))
        elif free is None:
            free = file
    if foreign:
        raise SettingsError("{}: this state {}, or delete it to start anew".format(*foreign[0]))
    if free is None:
        raise SettingsError(f"{requested}: {SLOTS} other runs keep their states there; wait for one of them, or choose another output")
    return free


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")
