"""The file system of Windows, as strict as it is there: what is open or mapped is not moved, replaced or removed, and no folder is opened."""

import errno
import mmap
import os
import shutil
import tempfile
from pathlib import Path

import pytest

# What Python lacks on Windows, of what this package uses.
LACKING = {os: ("register_at_fork", "sched_getaffinity", "sysconf", "O_DIRECTORY", "O_NOFOLLOW"), mmap: ("MADV_DONTNEED",)}


def users(path: str | os.PathLike[str]) -> list[str]:
    """The files at or below a path that this process has open or mapped."""
    place = os.path.join(os.path.realpath(os.path.dirname(os.path.abspath(path))), os.path.basename(path))
    used = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if os.path.lexists(link)]
    mapped = Path("/proc/self/maps").read_text(errors="replace")
    used += [line.split(maxsplit=5)[5] for line in mapped.splitlines() if place in line] if place in mapped else []
    return [file for file in used if file == place or file.startswith(f"{place}/")]


def pretend(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Be as strict from now on; returns the list to which files are added that were in use when they were to be moved or removed."""
    refused: list[str] = []

    def free(path):
        if os.path.lexists(path) and (found := users(path)):
            refused.extend(found)
            raise PermissionError(errno.EACCES, "it is being used by another process", str(path))

    def replace(source, target, real=os.replace):
        free(source)
        free(target)
        if os.path.isdir(target):
            raise PermissionError(errno.EACCES, "Access is denied", str(target))
        real(source, target)

    def rename(source, target, real=os.rename):
        free(source)
        if os.path.lexists(target) and source != target:
            raise FileExistsError(errno.EEXIST, "it exists already", str(target))
        real(source, target)

    def unlink(path, *, dir_fd=None, real=os.unlink):
        free(path)
        real(path)

    def rmdir(path, *, dir_fd=None, real=os.rmdir):
        free(path)
        real(path)

    def opened(path, flags, mode=0o777, *, dir_fd=None, real=os.open):
        if os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, flags, mode)

    monkeypatch.setattr(shutil, "_use_fd_functions", False)
    monkeypatch.setattr(tempfile, "TemporaryFile", tempfile.NamedTemporaryFile)  # with it numba asks once for all tests what folder it can write to
    for name, stand_in in {"replace": replace, "rename": rename, "unlink": unlink, "remove": unlink, "rmdir": rmdir, "open": opened}.items():
        monkeypatch.setattr(os, name, stand_in)
    for module, names in LACKING.items():
        for name in names:
            monkeypatch.delattr(module, name)
    return refused
