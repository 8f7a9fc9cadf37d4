"""Header comments that name the screen filter and the provenance of a splat file, and their equivalents in exchange formats."""

from __future__ import annotations

import gzip
import json
import math
import re
import sys
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mipmap_plugin.formats import fvdb
from mipmap_plugin.screen_filters import COMPENSATED, SCREEN_FILTERS

PROVENANCE = "mipmap_plugin"

# Brush and splat-transform write the first, Postshot the second.
_RENDER_MODE = re.compile(r"SplatRenderMode:\s*(\w+)", re.IGNORECASE)
_ANTIALIASED = re.compile(r"antialiased\s+([01])\b", re.IGNORECASE)

# What web-splat reads. It opens no file whose first comment with "mip" in it does not end with =true or =false, nor one whose first with
# "kernel_size" does not end with = and a number (959a3ec, io/ply.rs); so these are before all others of this package.
_WEB_SPLAT = re.compile(r"(mip|kernel_size)=[\w.]+$")

# nerfstudio names its vertical so. Brush's exports had the same comment with y, whatever is up in them; since July 2026 they have the least variance
# of the cameras' places, of which the first two numbers are those of what is up, and the third is that of what is down (`estimate_up`, 018c949c).
# One that goes on from an export with y has (0, -1, 0).
_Z_UP = re.compile(r"vertical axis:\s*z\b", re.IGNORECASE)
_OF_BRUSH = re.compile(r"vertical axis: (\S+) (\S+) (\S+)$", re.IGNORECASE)
BRUSH = "Exported from Brush"

_MODES = {"default": "classic", "0": "classic", "mip": "antialiased", "1": "antialiased", "2dgs": "2dgs"}

# The tag of each screen filter. Filters that integrate over the pixel have none, as no other project's files name them.
_TAGS = {"classic": "default", "antialiased": "mip", "mip": "mip", "surfel": "2dgs"}

# Where the flags of an SPZ are, in all its versions, and the one of splats that were trained antialiased (nianticlabs/spz, load-spz.cc).
_SPZ_FLAGS, _SPZ_ANTIALIASED = 14, 1

# The most bytes that are read of a SOG's meta.json.
_MOST_OF_META = 1 << 20


# What a damaged file makes of the code that reads its header or its meta.json.
DAMAGE = (OSError, EOFError, ValueError, LookupError, AttributeError, TypeError, RecursionError, zlib.error, zipfile.BadZipFile)


def mode_in_exchange(path: Path, kind: str) -> str | None:
    """How an SPZ or SOG (`kind`) says that it is to be drawn, as `render_mode` of a PLY; None if it does not say."""
    try:
        if kind == "spz":
            with path.open("rb") as file:
                head = file.read(_SPZ_FLAGS + 1)
                if head.startswith(b"\x1f\x8b"):
                    file.seek(0)
                    head = gzip.GzipFile(fileobj=file).read(_SPZ_FLAGS + 1)
            return "antialiased" if head.startswith(b"NGSP") and head[_SPZ_FLAGS] & _SPZ_ANTIALIASED else None
        model = meta_of_sog(path).get("model") if kind == "sog" else None
        return model if model in ("antialiased", "2dgs") else None
    except DAMAGE:
        return None  # damaged, which is reported when its splats are read


def mark_antialiased(file: Path) -> None:
    """Say in an SPZ, of version 3 or older, or else in the header of a PLY, that its splats are to be drawn antialiased."""
    content = bytearray(file.read_bytes())
    if content.startswith(b"\x1f\x8b"):
        content = bytearray(gzip.decompress(content))
        content[_SPZ_FLAGS] |= _SPZ_ANTIALIASED
        file.write_bytes(gzip.compress(content, mtime=0))
    else:
        file.write_bytes(content.replace(b"element ", b"comment SplatRenderMode: mip\nelement ", 1))


def meta_of_sog(path: Path) -> Any:
    """The content of a SOG's meta.json, which is the file itself or in an archive."""
    if not zipfile.is_zipfile(path):
        return json.loads(path.read_bytes()[:_MOST_OF_META])
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.rpartition("/")[2] == "meta.json")
        with archive.open(name) as file:
            return json.loads(file.read(_MOST_OF_META))


def render_mode(comments: Iterable[str]) -> str | None:
    """The screen filter ("classic", "antialiased"), or "2dgs", that the last tag names; None without a known tag."""
    mode = None
    for comment in comments:
        tag = _tag(comment)
        mode = _MODES.get(tag[1].lower(), mode) if tag else mode
    return mode


def vertical_of(comments: Iterable[str]) -> tuple[float, float, float] | None:
    """What is up in a file that says so, of length 1; None in any other."""
    comments = list(comments)
    if any(map(_Z_UP.match, comments)):
        return (0.0, 0.0, 1.0)
    found = next(filter(None, map(_OF_BRUSH.match, comments)), None) if BRUSH in comments else None
    try:
        x, y, down = map(float, found.groups()) if found else (0.0, 0.0, 0.0)
    except ValueError:
        return None
    length = math.hypot(x, y, down)
    return (x / length, y / length, -down / length) if 0 < length < math.inf and (x, y, down) != (0, -1, 0) else None


def with_tags(comments: Iterable[str], screen_filter: str, provenance: dict[str, Any], eps2d: float | None = None) -> list[str]:
    """Foreign comments, followed by the lines of this package, which replace older ones. `eps2d`: dilation of the filter, px²."""
    foreign = [text for text in comments if not _tag(text) and not _WEB_SPLAT.match(text) and not text.startswith(PROVENANCE + " {")]
    tag = _TAGS.get(screen_filter)
    tags = [f"mip={'true' if screen_filter in COMPENSATED else 'false'}", *([] if eps2d is None else [f"kernel_size={eps2d:g}"])]
    tags += [f"SplatRenderMode: {tag}"] if tag else []
    if eps2d is not None and (screen_filter == "mip" or tag is None):
        provenance = {**provenance, "screen_filter": screen_filter, "kernel_size": eps2d}  # which the tag does not tell
    return [*fvdb.rewritten(foreign, screen_filter, eps2d), *tags, f"{PROVENANCE} {json.dumps(provenance, default=str)}"]


def provenance_of(comments: Iterable[str]) -> dict[str, Any] | None:
    """The provenance record of an adapted file; None if there is none."""
    for comment in comments:
        if comment.startswith(PROVENANCE + " {"):
            try:
                record: dict[str, Any] = json.loads(comment.removeprefix(PROVENANCE))
                return record
            except (ValueError, RecursionError):  # also an integer of more digits than Python reads
                return None
    return None


def recorded_filter(comments: Iterable[str]) -> tuple[str, float] | None:
    """Name and dilation (px²) of the screen filter that the provenance records where no tag tells both, or fVDB's settings; None without either.

    A tag that another program wrote since counts for more: with that of 3DGS there is None.
    """
    comments = list(comments)
    record, mode = provenance_of(comments) or {}, render_mode(comments)
    if not record and mode is None:
        return fvdb.filter_of(comments)
    size, name = record.get("kernel_size"), record.get("screen_filter", "mip")  # older versions record no name
    if not isinstance(name, str) or name not in SCREEN_FILTERS or mode != _MODES.get(_TAGS.get(name, "")):
        return None
    return (name, float(size)) if isinstance(size, (int, float)) and 0 <= size <= sys.float_info.max else None


def _tag(comment: str) -> re.Match[str] | None:
    return _RENDER_MODE.match(comment) or _ANTIALIASED.match(comment)
