"""What is wrong with zip archives and gzip streams of splats, before another program reads them."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

from mipmap_plugin.formats.magic import GZIP
from mipmap_plugin.formats.zipped import MOST_TIMES, TOO_LARGE

# Bytes of a gzip stream that are unpacked at a time.
BLOCK = 1 << 14


def damage_of(path: Path) -> str:
    """What is wrong with a file that is a zip archive or a gzip stream, as SOG and SPZ are; "" if nothing.

    The tool does not look at checksums, and takes as much memory as such a file asks for.
    """
    most = MOST_TIMES * path.stat().st_size
    try:
        if not zipfile.is_zipfile(path):
            return _damage_of_gzip(path, most)
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > most:
                return f"it {TOO_LARGE}"
            wrong = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
        return str(error)
    return f"the checksum of {wrong} is wrong" if wrong else ""


def _damage_of_gzip(path: Path, most: int) -> str:
    """What is wrong with a gzip stream, which may have `most` bytes unpacked; "" if nothing, or if it is none. Another stream may follow it."""
    with path.open("rb") as file:
        if file.read(2) != GZIP:
            return ""
        file.seek(0)
        stream, size = zlib.decompressobj(zlib.MAX_WBITS | 16), 0
        while not stream.eof and (block := file.read(BLOCK)):
            size += len(stream.decompress(block))
            if size > most:
                return f"it {TOO_LARGE}"
        rest = stream.unused_data + file.read(len(GZIP))
    if not stream.eof:
        return "it is cut off"
    return "" if not rest or rest.startswith(GZIP) else "other bytes follow its end"
