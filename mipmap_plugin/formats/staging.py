"""Staging of outputs: a hidden folder beside the output, locked by the run that fills it.

`.NAME.<slot>.tmp` contains `new` while an output is being written; `new` is discarded if its run is killed. A single file is moved into
place by one rename, and a folder is exchanged with the old one, both atomically. If several steps are needed (a file and its companions,
or a system that cannot exchange folders), `new` is first renamed to `ready`: from then on it is complete, and the next run finishes the moves.
Before any of that everything in `new` is flushed to the disk, and after it the folder that it was moved to.
`spent` names what the output was made from, such as the state of its run, which is removed when the output is in its place, and not before.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import stat
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

# The most runs that may write to one output at the same time.
SLOTS = 8

# Seconds after which a folder counts as that of a killed run on disks without locks.
STALE_S = 24 * 3600.0

# Windows opens no folders. There a run holds this file in its folder open, which nobody can remove then; that of a killed run is closed.
HELD = "held"

# Linux: renameat2 with paths relative to the working folder, and the flag that exchanges them (linux/fs.h).
AT_FDCWD = -100
RENAME_EXCHANGE = 2

# Errors of systems that have no such call, or do not support it on this disk.
NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)


class Staging:
    """The hidden folder of one output, until the output has been moved into place."""

    def __init__(self, path: Path) -> None:
        """`path`: absolute. What killed runs left there is completed or removed first. Raises OSError."""
        self.path, self.place = path, path.parent
        settle(path)
        self._folder, self._lock = _free_slot(path)
        self.new = self._folder / "new"
        self.spent = list[Path]()  # absolute paths, to be removed once the output is in its place
        try:
            self.new.mkdir()
        except BaseException:  # of a full disk, or Ctrl-C
            release(self._folder, self._lock)
            raise

    def inside(self, path: Path) -> Path | None:
        """The staging path of `path` (absolute): here, if it is the output, beside it, or in a folder that is being written."""
        if path.is_relative_to(self.new):
            return path
        made, folder = self.new / os.path.relpath(path, self.place), self.new / self.path.name
        return made if path.parent == self.place or (folder in made.parents and folder.is_dir()) else None

    def commit(self) -> None:
        """Move what was written to `new` to its place, and remove what is spent with it. Raises OSError."""
        made = list(self.new.iterdir())
        for folder, _, names in os.walk(self.new):
            for path in (*(Path(folder, name) for name in names), Path(folder)):
                _flush(path)
        kept = {self.place / each.name for each in made} | {*self.path.parents}
        spent = [path for path in self.spent if os.path.lexists(path) and path not in kept]
        if self.new / self.path.name in made:
            _note_spent(self._folder, [path for path in spent if path.parent == self.place])
        if not (len(made) == 1 and _moved_at_once(made[0], self.place / made[0].name)):
            for target in (self.place / each.name for each in made):
                if os.path.lexists(target):
                    os.rename(target, target)  # nothing; an error on Windows, if it or a file in it is open: none is replaced unless all are
            ready = self._folder / "ready"
            os.rename(self.new, ready)
            try:
                _move_in(self._folder)
            except OSError:
                shutil.rmtree(ready, ignore_errors=True)
                raise
        _flush(self.place)
        for path in spent:
            _remove(path, self._folder)

    def close(self) -> None:
        """Take the hidden folder away. Moves that Ctrl-C broke off are finished first."""
        _finish(self._folder, self._lock)


def settle(path: Path) -> None:
    """Put right what dead runs left beside the output `path`: finish what was whole, and remove what was not."""
    for folder in _slots(path):
        if os.path.lexists(folder) and (lock := claim(folder)) is not None:
            _finish(folder, lock)


def claim(folder: Path) -> int | None:
    """Make `folder` this run's, also where a dead run left it: the descriptor of its lock. None where a living run has it."""
    while True:
        made = _made(folder)
        try:
            lock = os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_NOFOLLOW", 0))
        except FileNotFoundError:  # its run has ended at this moment
            continue
        except PermissionError:  # Windows
            try:
                return _held_file(folder / HELD)
            except FileNotFoundError:  # as above
                continue
        if not _locked(lock, made):
            os.close(lock)
            return None
        if _is_of(lock, folder):
            return lock
        os.close(lock)


def release(folder: Path, lock: int) -> None:
    """Give back what `claim` took, and remove it, if it is still there."""
    try:
        if _is_of(lock, folder):
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)
    with suppress(OSError):  # on Windows, what was open until now; another run may hold it already
        (folder / HELD).unlink()
        folder.rmdir()


def missing_folders(folder: Path) -> list[Path]:
    """The folder and those around it, as far as they are missing, the innermost first."""
    return list(takewhile(lambda each: not os.path.lexists(each), (folder, *folder.parents)))


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those folders, the innermost first, that have nothing in them: an output that failed leaves none behind."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def exchange(one: Path, other: Path) -> bool:
    """Let two folders change their names in one step; False where the system cannot. Raises OSError."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if call is None:
        return False
    if call(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number))


def _flush(path: Path) -> None:
    """Write a file, or the names in a folder, to the disk now: else a power cut may leave the new name without the bytes. Raises OSError."""
    try:
        # Windows flushes only what is open for writing, so that folders and read-only files are left out there; links are left out everywhere.
        opened = os.open(path, (os.O_RDWR if os.name == "nt" else os.O_RDONLY) | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return
    try:
        os.fsync(opened)
    except OSError:
        if not path.is_dir():  # which some network disks do not flush
            raise
    finally:
        os.close(opened)


def _slots(path: Path) -> list[Path]:
    return [path.with_name(f".{path.name}.{slot}.tmp") for slot in range(SLOTS)]


def _free_slot(path: Path) -> tuple[Path, int]:
    for folder in _slots(path):
        if (lock := claim(folder)) is not None:
            return folder, lock
    raise OSError(errno.EBUSY, f"{SLOTS} other runs are writing to it")


def _made(folder: Path) -> bool:
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _locked(lock: int, made: bool) -> bool:
    """Whether this process owns the folder of this descriptor: it holds the lock, or, on a disk without locks, `made` it, or it is old."""
    import fcntl  # not on Windows, where no folder has a descriptor

    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return made or time.time() - os.fstat(lock).st_mtime > STALE_S
    return True


def _held_file(file: Path) -> int | None:
    """The descriptor of the new file by which this run holds a folder; None where a living run has it open. Raises FileNotFoundError."""
    try:
        file.unlink(missing_ok=True)
        return os.open(file, os.O_CREAT | os.O_EXCL | os.O_RDWR)
    except (PermissionError, FileExistsError):
        return None


def _is_of(lock: int, folder: Path) -> bool:
    """Whether the folder is the one of this descriptor, and not another one that has got its name since."""
    try:
        return stat.S_ISREG(os.fstat(lock).st_mode) or os.path.samestat(os.fstat(lock), os.stat(folder))
    except FileNotFoundError:
        return False


def _moved_at_once(made: Path, target: Path) -> bool:
    """Move `made` into place in one step of the system; return whether that was possible."""
    if not made.is_dir():
        os.replace(made, target)
        return True
    if os.path.lexists(target):
        return exchange(made, target)
    os.rename(made, target)
    return True


def _move_in(folder: Path) -> None:
    """Move what is ready into place: companions first, the output itself last. Raises OSError after restoring the old one."""
    for made in sorted((folder / "ready").iterdir(), key=lambda entry: entry.name == _output_of(folder).name):
        target, aside = folder.parent / made.name, folder / "old"
        if not made.is_dir():
            os.replace(made, target)
            continue
        if os.path.lexists(target):
            os.rename(target, aside)
        try:
            os.rename(made, target)
        except OSError:
            os.rename(aside, target)
            raise


def _output_of(folder: Path) -> Path:
    return folder.with_name(folder.name[1:].rsplit(".", 2)[0])


def _note_spent(folder: Path, spent: Iterable[Path]) -> None:
    """Note what is spent once the output is the file or folder that is `new` now: by inodes, as both names may be those of others after a kill."""
    for path in spent:
        (folder / "spent" / _inode(folder / "new" / _output_of(folder).name) / _inode(path) / path.name).mkdir(parents=True)


def _remove_spent(folder: Path) -> None:
    """Remove what a killed run had no time to, if its output is in its place."""
    for noted in (folder / "spent" / _inode(_output_of(folder))).glob("*/*"):
        if _inode(path := folder.with_name(noted.name)) == noted.parent.name:
            _remove(path, folder)


def _inode(path: Path) -> str:
    try:
        return str(path.lstat().st_ino)
    except OSError:
        return "missing"


def _remove(path: Path, folder: Path) -> None:
    """Remove a file or a folder with the hidden `folder`, into which it moves in one step: a part of it would be in the way of others."""
    try:
        (folder / "removed").mkdir(exist_ok=True)
        os.rename(path, folder / "removed" / path.name)
    except OSError:  # on another disk
        with suppress(OSError):  # the output is in its place, whatever stays
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _finish(folder: Path, lock: int) -> None:
    try:
        if (folder / "ready").is_dir():
            _move_in(folder)
            _flush(folder.parent)
        _remove_spent(folder)
    except BaseException:
        os.close(lock)  # so that whoever writes or loads next finishes the moves, this process too, before something newer is there
        raise
    release(folder, lock)
