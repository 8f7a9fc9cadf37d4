"""The picture at the end of `adapt`, in terminals that can show one: a view before and after, as the viewer draws it."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, TextIO

from mipmap_plugin.commands.voice import VOICE, put, say

if TYPE_CHECKING:
    from torch import Tensor

    from mipmap_plugin.adaptation.adapted import Adapted
    from mipmap_plugin.camera import Camera
    from mipmap_plugin.formats.terminal import Protocol
    from mipmap_plugin.wrap import Wrapped

# px: small pictures are enlarged pixel by pixel up to this height; of large ones the middle is shown. And the gap between the two.
SHOWN, GAP = 240, 8


def show_before_and_after(base: Wrapped, adapted: Adapted) -> None:
    """Show a view of the base and of what it was adapted to, side by side; nothing where the terminal cannot, or is to be quiet."""
    protocol = protocol_here()
    if protocol is None:
        return
    from mipmap_plugin.formats.terminal import encoded

    view = shown_view(adapted)
    say(f"before and after{f', view {view.name}' if view.name else ''}:")
    put(encoded(before_and_after(base, adapted, view), protocol))


def protocol_here() -> Protocol | None:
    """How this terminal shows pictures; None if it does not."""
    if VOICE.get().quiet or not is_terminal(VOICE.get().out) or os.environ.get("TERM", "dumb") == "dumb":
        return None
    from mipmap_plugin.formats.terminal import has_sixels, protocol_by_name

    return protocol_by_name(os.environ) or ("sixel" if is_terminal(sys.stdin) and has_sixels(sys.stdin.fileno()) else None)


def is_terminal(stream: TextIO) -> bool:
    """Whether a stream is a terminal."""
    return stream.isatty()


def shown_view(adapted: Adapted) -> Camera:
    """The middle of the first test view at the new scale, or else of the first view."""
    views = adapted.views()
    return next((view for view in views if view.split == "test"), views[0]).window(SHOWN, SHOWN)


def before_and_after(base: Wrapped, adapted: Adapted, view: Camera) -> Tensor:
    """[H, W, 3]: the base and the adapted model, as the viewer that the file is for draws them, each pixel enlarged."""
    from mipmap_plugin.formats.images import beside_each_other

    viewer = next(iter(adapted.viewers), "") or None
    images = [base.render(view, viewer=viewer).image, adapted.render(view, viewer=viewer).image]
    return beside_each_other([image.clamp(0, 1) for image in images], SHOWN, GAP)
