"""Header comments that name the screen filter and the provenance of a splat file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

PROVENANCE = "mipmap_plugin"

# Brush and splat-transform write the first, Postshot the second.
_RENDER_MODE = re.compile(r"SplatRenderMode:\s*(\w+)", re.IGNORECASE)
_ANTIALIASED = re.compile(r"antialiased\s+([01])\b", re.IGNORECASE)

_MODES = {"default": "classic", "0": "classic", "mip": "antialiased", "1": "antialiased", "2dgs": "2dgs"}


def render_mode(comments: Iterable[str]) -> str | None:
    """The screen filter ("classic", "antialiased"), or "2dgs", that the last tag names; None without a known tag."""
    mode = None
    for comment in comments:
        tag = _tag(comment)
        mode = _MODES.get(tag[1].lower(), mode) if tag else mode
    return mode


def with_tags(comments: Iterable[str], screen_filter: str, provenance: dict[str, Any], eps2d: float | None = None) -> list[str]:
    """Foreign comments, followed by the two lines of this package, which replace older ones. `eps2d`: dilation of the filter, px²."""
    foreign = [text for text in comments if not _tag(text) and not text.startswith(PROVENANCE + " {")]
    mode = {"classic": "default", "antialiased": "mip", "mip": "mip", "surfel": "2dgs"}.get(screen_filter)  # others have no tag
    tags = [f"SplatRenderMode: {mode}"] if mode else []
    if screen_filter == "mip" and eps2d is not None:
        provenance = {**provenance, "kernel_size": eps2d}  # which the tag does not tell
    return [*foreign, *tags, f"{PROVENANCE} {json.dumps(provenance, default=str)}"]


def provenance_of(comments: Iterable[str]) -> dict[str, Any] | None:
    """The provenance record of an adapted file; None if there is none."""
    for comment in comments:
        if comment.startswith(PROVENANCE + " {"):
            try:
                record: dict[str, Any] = json.loads(comment.removeprefix(PROVENANCE))
                return record
            except (json.JSONDecodeError, RecursionError):
                return None
    return None


def kernel_size(comments: Iterable[str]) -> float | None:
    """The dilation (px²) that the provenance of a file with the tag of compensation records; None for one that has that of 3DGS, or no record."""
    comments = list(comments)
    size = (provenance_of(comments) or {}).get("kernel_size") if render_mode(comments) == "antialiased" else None
    return float(size) if isinstance(size, (int, float)) and size >= 0 else None


def _tag(comment: str) -> re.Match[str] | None:
    return _RENDER_MODE.match(comment) or _ANTIALIASED.match(comment)
