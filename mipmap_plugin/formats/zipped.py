"""A PLY in a zip archive, as phones and web pages hand it out. A model folder in an archive has to be unpacked: more is read of it than its PLY."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from zipfile import ZipInfo

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.magic import archive

# How many times as large as its archive a PLY may be. Those of captures are less than twice as large, and one without view-dependent color, whose
# columns are zeros, ten times; an archive that fills a disk has thousands.
MOST_TIMES = 100


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
    if entry.file_size > MOST_TIMES * path.stat().st_size:
        raise CheckpointError(f"{path} would be more than {MOST_TIMES} times as large unpacked, which no file of splats is; do not open it")
    with tempfile.TemporaryDirectory(prefix="mipmap-plugin-") as folder:
        if entry.file_size > shutil.disk_usage(folder).free:
            needed = f"{entry.file_size / 2**30:,.1f} GiB"
            raise CheckpointError(f"{path} needs {needed} unpacked, for which {tempfile.gettempdir()} has no room; unpack it elsewhere")
        ply = Path(folder, "unpacked.ply")
        with archive(path) as opened, opened.open(entry) as packed, ply.open("xb") as out:
            shutil.copyfileobj(packed, out)  # no more bytes than the entry's file_size, and checks its checksum
        yield ply
