"""Long measurements that go on after Ctrl-C or a kill: where their finished cells are (`evaluation.cells`), and what is said of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mipmap_plugin.commands.voice import note
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.formats.atomic import settled

# The name of a cell's file, or of the folder in which it is written.
CELL = re.compile(r"[0-9a-f]{24}\.pt|\.[0-9a-f]{24}\.pt\.\d\.tmp")


@contextmanager
def resumable(folder: Path | None, unit: str) -> Iterator[None]:
    """Say what an earlier command left in `folder`; inside, Ctrl-C says how many cells are finished, and how to go on. `unit`: what a cell is.

    Raises SettingsError for a folder with other things in it, because it is deleted at the end.
    """
    if folder is not None and settled(folder).exists() and not (folder.is_dir() and all(CELL.fullmatch(path.name) for path in folder.iterdir())):
        raise SettingsError(f"{folder} is needed for what is finished, but is or holds something else; move it, or choose another output")
    if found := _cells(folder):
        note(f"{folder} has {plural(found, unit)} of a command that was interrupted; those of the same request are not measured again")
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if folder is None:
            raise KeyboardInterrupt("interrupted; nothing was kept, because neither an output nor a page was to be written") from interrupt
        raise KeyboardInterrupt(f"interrupted with {plural(_cells(folder), unit)} finished; run the same command again to go on") from interrupt


def _cells(folder: Path | None) -> int:
    return len(list(folder.glob("*.pt"))) if folder else 0
