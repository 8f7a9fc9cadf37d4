"""Header comments that say how a splat file was trained and where it comes from."""

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
    """The screen filter ("classic", "antialiased"), or "2dgs", that the last tag names; None without a tag that is known."""
    found = None
    for comment in comments:
        tag = _tag(comment)
        found = _MODES.get(tag[1].lower(), found) if tag else found
    return found


def with_tags(comments: Iterable[str], screen_filter: str, provenance: dict[str, Any]) -> list[str]:
    """Foreign comments, then our own two lines in place of any older ones."""
    foreign = [text for text in comments if not _tag(text) and not text.startswith(PROVENANCE + " {")]
    mode = {"classic": "default", "antialiased": "mip", "mip": "mip", "surfel": "2dgs"}.get(screen_filter)  # no tag stands for any other
    tags = [f"SplatRenderMode: {mode}"] if mode else []
    return [*foreign, *tags, f"{PROVENANCE} {json.dumps(provenance, default=str)}"]


def provenance_of(comments: Iterable[str]) -> dict[str, Any] | None:
    """The record of the adaptation that wrote a file, or None."""
    for comment in comments:
        if comment.startswith(PROVENANCE + " {"):
            try:
                return json.loads(comment.removeprefix(PROVENANCE))
            except (json.JSONDecodeError, RecursionError):
                return None
    return None


def _tag(comment: str) -> re.Match[str] | None:
    return _RENDER_MODE.match(comment) or _ANTIALIASED.match(comment)
