"""Functions that several commands use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.voice import put, say
from mipmap_plugin.errors import warn
from mipmap_plugin.formats.atomic import json_text
from mipmap_plugin.formats.here import from_here, typed
from mipmap_plugin.process.garbage import leave_loaded, uncollected
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.jobs.base import Base
    from mipmap_plugin.scenes import Scene
    from mipmap_plugin.wrap import Wrapped


# Columns of a name, before what it names.
KEY = 14

# The words of this command, which its page shows.
WORDS: ContextVar[tuple[str, ...]] = ContextVar("WORDS", default=())


def this_command() -> str:
    """The command as a shell takes it."""
    return typed(["mipmap-plugin", *WORDS.get()])


@contextmanager
def starting() -> Iterator[None]:
    """Inside, a command imports what it needs: torch takes seconds on a busy machine."""
    with announced("starting"), uncollected():
        yield


def wrap(base: Base, threads: int | None = None, images: Path | None = None) -> Wrapped:
    """`Base.load`, for whatever is done in this process. `threads`: for torch too."""
    with announced(f"reading {base.checkpoint.name}"), uncollected():
        wrapped = base.load(threads, images)
        leave_loaded()
        if threads is not None:
            from mipmap_plugin.process.threads import limit_torch  # here, for it imports torch

            limit_torch(threads)  # also for what is measured: on a busy machine small images take many times as long on torch's threads
        return wrapped


def base_cameras(wrapped: Wrapped, given: Path | None) -> str:
    """Where the cameras were found, if they are those of the base of an adapted file; "" if they lay beside the file or in it, or were `given`."""
    from mipmap_plugin.models.zipped_folder import with_archives_named

    place = wrapped.cameras_from.get("scene", "")
    own = [with_archives_named(path.absolute()) for path in (wrapped.model.folder, wrapped.model.source) if path is not None]
    return "" if given is not None or not place or place in own else from_here(Path(place))


def scene(base: Base, path: Path) -> Scene:
    """The scene at `path`, whose photographs judge a checkpoint; a warning tells of absent and masked ones. Raises CheckpointError, SceneError."""
    read = base.photographs(path)
    for note in read.warnings():
        warn(f"{path}: {note}")
    return read


def without_none(**options: Any) -> dict[str, Any]:
    """The options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def print_json(facts: Any) -> None:
    """Print facts as JSON, quiet or not."""
    put(json_text(facts))


def print_facts(facts: dict[str, Any]) -> None:
    """Print facts, each behind its name; of a list each entry on a line of its own."""
    for name, value in facts.items():
        lines = value if isinstance(value, list) else [value]
        hanging = None if name == "file" else KEY + 2 * (len(lines) > 1)  # a path is not wrapped, to be copied
        for line in lines:
            say(f"{name + ':' if name else '':{KEY}}{f'{line:,}' if isinstance(line, int) else line}", hanging)
            name = ""
