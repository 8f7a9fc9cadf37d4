"""What a path leads to, asked before it is opened: a pipe or a device may block forever."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def kind_of_node(status: os.stat_result) -> str:
    """The kind of a path that is neither a regular file nor a folder."""
    kinds = {stat.S_ISFIFO: "a pipe", stat.S_ISCHR: "a device", stat.S_ISBLK: "a device", stat.S_ISSOCK: "a socket"}
    return next((name for test, name in kinds.items() if test(status.st_mode)), "no regular file")


def no_file(path: Path) -> str:
    """Why `path` cannot be read as a file, "" if it can."""
    status = os.stat(path)
    return "" if stat.S_ISREG(status.st_mode) else f"is {'a folder' if stat.S_ISDIR(status.st_mode) else kind_of_node(status)}, not a file"


def refuse_named_pipe(path: Path) -> None:
    """Raise OSError for a pipe with a name, which may block forever; one of the shell's, as in <(ls) and /dev/stdin, has its other end."""
    real = Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for a link to itself before Python 3.13
    if real.is_fifo() and not real.is_relative_to("/dev"):  # where macOS has those of the shell, which Linux has nowhere
        raise OSError(errno.EINVAL, "a pipe with a name, whose other end nobody may open", str(path))


def is_file(path: Path) -> bool:
    """Whether there is a file; False also for names that the system does not accept, which lists of images may contain."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
