"""Unpacks zip archives, no more than the disk has room for, and finds the PLY in an archive of one, as phones and web pages offer it."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from zipfile import ZipFile, ZipInfo

from mipmap_plugin.errors import TEMPORARY, CheckpointError
from mipmap_plugin.formats.magic import archive

# How many times as large as its archive a PLY may be. Those of captures are less than twice as large, and one without view-dependent color, whose
# columns are zeros, ten times; an archive that fills a disk has thousands.
MOST_TIMES = 100
TOO_LARGE = f"would be more than {MOST_TIMES} times as large unpacked, which no file of splats is"

# Errors of a write if the disk, or the user's quota, is full.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def only_ply(path: Path) -> ZipInfo | None:
    """The PLY in an archive that holds nothing else, but for what macOS adds; None for any other. Raises CheckpointError for a damaged one."""
    with archive(path) as opened:
        entries = [entry for entry in opened.infolist() if not entry.is_dir()]
    files = [entry for entry in entries if not entry.filename.startswith("__MACOSX/") and not entry.filename.endswith(".DS_Store")]
    return files[0] if len(files) == 1 and files[0].filename.lower().endswith(".ply") else None


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A temporary copy, for the duration of the block, of the only PLY in an archive, whatever it is called there. Raises CheckpointError."""
    entry = only_ply(path)
    if entry is None:
        raise CheckpointError(f"{path} is no zip archive of one PLY; unpack it and give the PLY or the folder in it")
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        refuse_large(path, entry.file_size, Path(folder))
        with archive(path) as opened:
            ply = copied(path, opened, entry, Path(folder, "unpacked.ply"))
        yield ply


def refuse_large(path: Path, size: int, folder: Path) -> None:
    """Raise CheckpointError if `size` bytes of an archive are more than an honest one holds, or than there is room for in `folder`."""
    if size > MOST_TIMES * path.stat().st_size:
        raise CheckpointError(f"{path} {TOO_LARGE}; do not open it")
    if size > shutil.disk_usage(folder).free:
        needed = f"{size / 2**30:,.1f} GiB"
        raise CheckpointError(f"{path} needs {needed} unpacked, for which {tempfile.gettempdir()} has no room; unpack it elsewhere")


def copied(path: Path, opened: ZipFile, entry: ZipInfo, file: Path) -> Path:
    """Unpack one entry of the archive at `path`, whatever it is called there, to the new file `file`; return that.

    Raises CheckpointError where the disk is full.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with opened.open(entry) as packed, file.open("xb") as out:
            shutil.copyfileobj(packed, out)  # no more bytes than the entry's file_size, and checks its checksum
    except OSError as error:
        if error.errno not in FULL:
            raise
        place = tempfile.gettempdir()
        raise CheckpointError(f"{path} cannot be unpacked in {place} ({error.strerror}); make room there, or unpack it elsewhere") from error
    return file
