"""The screen filter that the file of another project is for, once it was adapted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mipmap_plugin.formats.tags import recorded_filter, render_mode
from mipmap_plugin.models.base import TrainedScale


def as_tagged(trained: TrainedScale, comments: Sequence[str]) -> TrainedScale:
    """`trained` with the screen filter that the comments of an adapted file name (`tags.with_tags`), if they name one."""
    name, eps2d = recorded_filter(comments) or (render_mode(comments) or trained.screen_filter, trained.eps2d)
    return replace(trained, screen_filter=name, eps2d=eps2d)
