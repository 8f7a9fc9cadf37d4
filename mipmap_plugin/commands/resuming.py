"""Long measurements that go on after Ctrl-C or a kill: where their finished cells are (`evaluation.cells`), and what is said of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mipmap_plugin.progress import note


def resume_path(output: Path) -> Path:
    """The folder with the finished cells of a command that writes to `output`."""
    return output.with_name(f"{output.name}.resume")


@contextmanager
def resumable(folder: Path | None, unit: str) -> Iterator[None]:
    """Say what an earlier command left in `folder`; inside, Ctrl-C says how many cells are finished, and how to go on. `unit`: what a cell is."""
    if found := _cells(folder):
        note(f"{folder} has {_counted(found, unit)} of a command that was interrupted; those of the same request are not measured again")
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if folder is None:
            raise KeyboardInterrupt("interrupted; nothing was kept, because neither an output nor a page was to be written") from interrupt
        raise KeyboardInterrupt(f"interrupted with {_counted(_cells(folder), unit)} finished; run the same command again to go on") from interrupt


def _cells(folder: Path | None) -> int:
    return len(list(folder.glob("*.pt"))) if folder else 0


def _counted(count: int, unit: str) -> str:
    return f"{count} {unit}{'' if count == 1 else 's'}"
