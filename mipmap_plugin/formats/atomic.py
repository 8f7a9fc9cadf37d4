"""Atomic outputs: they appear completely or not at all, and never replace files that must not be replaced."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import MipmapPluginError, OutputError, OutputExists, of_system
from mipmap_plugin.formats.nodes import kind_of_node
from mipmap_plugin.formats.staging import Staging, missing_folders, remove_empty, settle

# Files that operating systems leave in folders, and that may be deleted with them.
OF_SYSTEMS = {".DS_Store", "Thumbs.db", "desktop.ini"}

# The output that is being written, if any.
_open: ContextVar[Staging | None] = ContextVar("_open", default=None)


@contextlib.contextmanager
def together(path: Path, spent: Iterable[Path] = ()) -> Iterator[None]:
    """Make everything that the block writes to, into or beside `path` one atomic output: it appears if the block succeeds.

    `spent`: files and folders, such as the state of the run, that are removed with that, and else stay. A process that is killed while several
    files are moved into place leaves a record, from which the next run that writes to `path` or loads it moves the others, and removes what is
    spent beside `path` (`staging`).
    Raises OutputError.
    """
    with _as_output_error(path):
        place, holding = absolute(path), _open.get()
        if holding is not None and holding.inside(place) is not None:
            yield
            holding.spent += map(absolute, spent)
            return
        missing = missing_folders(place.parent)
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            with _staged(place, [*map(absolute, spent)]):
                yield
        finally:
            remove_empty(missing)


@contextlib.contextmanager
def _staged(place: Path, spent: Sequence[Path]) -> Iterator[None]:
    staging = Staging(place)
    token = _open.set(staging)
    try:
        yield
        staging.spent += spent
        staging.commit()
    except MipmapPluginError as error:  # which may name the hidden place
        error.args = tuple(str(each).replace(str(staging.new), str(staging.place)) for each in error.args)
        raise
    finally:
        _open.reset(token)
        staging.close()


@contextlib.contextmanager
def new_file(path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary path to write to, which becomes `path` if the block succeeds. Raises OutputExists, OutputError."""
    refuse_output(path, overwrite, is_file=True)
    with _made(path) as temporary:
        yield temporary


@contextlib.contextmanager
def new_folder(path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary folder to fill, which becomes `path` if the block succeeds; an old folder is removed only then."""
    refuse_output(path, overwrite)
    with _made(path) as temporary:
        temporary.mkdir()
        yield temporary


@contextlib.contextmanager
def _made(path: Path) -> Iterator[Path]:
    staging = _open.get()
    if staging is None or (temporary := staging.inside(absolute(path))) is None:
        with together(path), _made(path) as temporary:
            yield temporary
        return
    with _as_output_error(path):
        temporary.parent.mkdir(parents=True, exist_ok=True)
        yield temporary


def staged(path: Path) -> Path:
    """Where the file `path` is now: in the output that is being written, or in its place."""
    staging = _open.get()
    hidden = None if staging is None else staging.inside(absolute(path))
    return path if hidden is None or not hidden.exists() else hidden


@contextlib.contextmanager
def _as_output_error(path: Path) -> Iterator[None]:
    try:
        yield
    except MipmapPluginError:
        raise
    except OSError as error:
        file = next((parent for parent in path.parents if os.path.isfile(parent)), None)
        reason = f"{file} is a file, not a folder; choose another path" if file else of_system(error)
        raise OutputError(f"{path} cannot be written: {reason}") from error


def absolute(path: Path) -> Path:
    """`path` as an absolute path with links resolved except in its last part, which is replaced.

    Raises OutputError for a root, and for what is no path.
    """
    last = path.name not in ("", "..")
    try:
        real = Path(os.path.realpath(path.parent), path.name) if last else Path(os.path.realpath(path))
    except ValueError as error:
        raise _is_no_path(path, error) from None
    if not real.name:
        raise OutputError(f"{path} is the root of a disk; choose a path below it")
    return real


def named(path: Path) -> Path:
    """`path` with a name in its last part, such as the folder's name for ".". Raises OutputError for a root."""
    return path if path.name not in ("", "..") else absolute(path)


def refuse_output(path: Path, overwrite: bool, base: Iterable[Path] = (), *, is_file: bool = False) -> None:
    """Raise OutputExists if `path` may not be written to, or not without `overwrite`; OutputError if the system does not accept it.

    An output is a new path, a regular file or a folder (`is_file`: not a folder), and not one of the files `base` under any name (a
    link, a hard link, another case), nor a folder around one. What killed runs left at `path` is completed or removed first.
    """
    with _as_output_error(path):
        place = absolute(path)  # where it is written to: the system does not find `missing/..`, which this resolves
        settle(place)
        status = _stat(place)
    if status is None:
        return
    if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
        raise OutputExists(f"{path} is {kind_of_node(status)}, which is never replaced; choose another path")
    if any(os.path.samestat(status, each) for file in base for each in _around(file, stat.S_ISDIR(status.st_mode))):
        reason = "holds the base checkpoint itself" if stat.S_ISDIR(status.st_mode) else "is the base checkpoint itself, or read with it"
        raise OutputExists(f"{path} {reason}, which is never replaced; choose another path")
    if is_file and stat.S_ISDIR(status.st_mode):
        raise OutputExists(f"{path} is a folder, which no file replaces; choose the path of a file")
    if not overwrite:
        raise OutputExists(f"{path} exists already; pass --overwrite (overwrite=True) to replace it, or choose another path")


def refuse_unwritable(path: Path, room: int = 0, *, what: str = "the base takes", why: str = "") -> None:
    """Raise OutputError if `path` could not be written: no permission, a read-only disk, fewer than `room` bytes free.

    `what` needs the bytes and `why`, a remark on them, are parts of the message.
    """
    with _as_output_error(path):
        place = absolute(path)
        there = next(folder for folder in place.parents if os.path.lexists(folder))
        if not there.is_dir():
            raise OSError(errno.ENOTDIR, f"{there} is not a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise OSError(errno.EACCES, f"no permission to write to {there}")
        Staging(there / place.relative_to(there).parts[0]).close()  # as the system may refuse for a reason of its own
        free = shutil.disk_usage(there).free
    if free < room:
        reason = f"its disk has {free:,} bytes free, and {what} {room:,}{why}"
        raise OutputError(f"{path} cannot be written: {reason}; free some, or choose another disk")


def settled(path: Path) -> Path:
    """`path`, after what a killed run left there was completed or removed, if possible."""
    with contextlib.suppress(OSError, ValueError):
        settle(absolute(path))
    return path


def delete(folder: Path) -> None:
    """Delete a folder of unfinished work, as far as the system lets this run. It is moved away before, in one step: a part of it, which a killed run
    leaves, would be in the way of others. Whoever asks for the folder next removes what is left (`settled`)."""
    with contextlib.suppress(OSError):
        staging = Staging(absolute(folder))
        try:
            os.rename(folder, staging.new / folder.name)
        finally:
            staging.close()
    shutil.rmtree(folder, ignore_errors=True)


def _stat(path: Path) -> os.stat_result | None:
    """The status of `path`, None if nothing is there. Raises OutputExists for a broken link, OSError."""
    try:
        return os.stat(path)
    except FileNotFoundError:
        if path.is_symlink():
            raise OutputExists(f"{path} is a link to something that is not there; remove it, or choose another path") from None
        return None
    except ValueError as error:
        raise _is_no_path(path, error) from None


def _is_no_path(path: Path, error: ValueError) -> OutputError:
    """What is said of a path with a zero byte, or with a character that no file's name can have."""
    return OutputError(f"{str(path)!r} is no path: {error}")


def _around(file: Path, folders: bool) -> Iterator[os.stat_result]:
    """The file itself, or the folders around it."""
    real = Path(os.path.realpath(file))
    for place in real.parents if folders else [real]:
        with contextlib.suppress(OSError):
            yield os.stat(place)


def write_json(path: Path, facts: Any, overwrite: bool) -> None:
    """Write `facts` as an indented JSON file (`json_text`). Raises OutputExists, OutputError."""
    with new_file(path, overwrite) as temporary:
        temporary.write_text(json_text(facts) + "\n", encoding="utf-8", newline="\n")  # the same bytes on every system


def json_text(facts: Any) -> str:
    """`facts` as indented JSON that every parser accepts: infinity and NaN, such as the PSNR of equal images, become null."""
    return json.dumps(_without_infinities(facts), indent=2, allow_nan=False, default=str)


def _without_infinities(facts: Any) -> Any:
    if isinstance(facts, dict):
        return {name: _without_infinities(value) for name, value in facts.items()}
    if isinstance(facts, (list, tuple)):
        return [_without_infinities(value) for value in facts]
    return None if isinstance(facts, float) and not math.isfinite(facts) else facts


def sha256(*paths: Path) -> str:
    """The sha256 of the files' bytes, one after the other, hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
    return digest.hexdigest()


def refuse_to_lose(target: Path, source: Path | None, holds: str, ours: Sequence[str]) -> None:
    """Raise OutputExists if the folder `target` holds the base checkpoint, is of another kind, or has other things in it.

    Replacing a folder deletes its contents. `holds`: what a folder of this kind has. `ours`: patterns (fnmatch) of its files' paths in it.
    """
    place = absolute(target)
    with _as_output_error(target):
        for name in {pattern.partition("/")[0] for pattern in ours}:  # written into it by a run that was killed
            settle(place / name)
    if source is not None and place.is_dir() and any(os.path.samestat(place.stat(), each) for each in _around(source / "x", folders=True)):
        raise OutputExists(f"{target} holds the base checkpoint itself, which --overwrite would delete; choose another folder")
    if place.is_dir() and any(place.iterdir()) and not (place / holds).exists():
        raise OutputExists(f"{target} is a folder with other things in it, which --overwrite would delete; choose another folder")
    found = (file for file in place.rglob("*") if file.is_symlink() or not file.is_dir())
    files = (file.relative_to(place).as_posix() for file in found if file.name not in OF_SYSTEMS)
    if other := next((name for name in files if not any(fnmatchcase(name, pattern) for pattern in ours)), None):
        raise OutputExists(f"{target} has other things in it, such as {other}, which --overwrite would delete; move them, or choose another folder")
    if place.is_file():
        raise OutputExists(f"{target} is a file; choose another folder, or the path of a file")
