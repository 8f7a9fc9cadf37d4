"""How a checkpoint looks in the viewers that people open its file in, beside how it looked in training."""

from __future__ import annotations

from statistics import fmean

import torch

from mipmap_plugin.camera import evenly
from mipmap_plugin.evaluation.metrics import SAME_DB, psnr
from mipmap_plugin.models.base import why_no_viewer
from mipmap_plugin.wrap import Wrapped

VIEWERS = ("spark", "playcanvas", "gaussian-splats-3d", "classic", "antialiased")
VIEWS = 3

# What all views together may hold, so that drawing them takes some three seconds of one processor.
SPLATS, PIXELS = 500_000, 4_000_000


@torch.no_grad()
def looks(wrapped: Wrapped) -> str:
    """One sentence: dB in each viewer, the mean of a few views of the scale it was trained at; or why there is none.

    A viewer's picture is ours under its convention (`viewers`), and the truth is ours under that of training.
    """
    model, views = wrapped.model, wrapped.views()
    count, pixels = len(model.gaussians(views[0])), views[0].width * views[0].height
    if why := why_no_viewer(model):
        return f"not drawn: {why}"
    if model.traits.placed:
        return "not drawn: its own project alone opens such a file; `mipmap-plugin adapt --scale 1 --viewer NAME --output NEW.ply` makes another"
    if "reference" in (wrapped.backend()[0].name, wrapped.backend(viewer=VIEWERS[0])[0].name):
        return "not drawn: only the reference backend can, which takes too long; `mipmap-plugin backends` says what others lack"
    most = min(VIEWS, len(views), SPLATS // max(1, count), PIXELS // pixels)
    if most == 0:
        return f"not drawn: {count:,} splats on {pixels:,} pixels take too long; `mipmap-plugin render --viewer NAME` draws them"
    chosen = evenly(views, most)
    truths = [wrapped.render(view).image for view in chosen]
    told = []
    for viewer in VIEWERS:
        same = fmean(psnr(wrapped.render(view, viewer=viewer).image, truth) for view, truth in zip(chosen, truths, strict=True))
        told.append(f"{viewer} {'the same' if same == SAME_DB else f'{same:.1f} dB'}")
    return f"{', '.join(told)}, beside how it was trained, at x1 in {most} view{'s' if most > 1 else ''}"
