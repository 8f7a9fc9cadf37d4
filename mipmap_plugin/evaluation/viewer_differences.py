"""The difference between a checkpoint's look in common viewers and in its training."""

from __future__ import annotations

from statistics import fmean

import torch

from mipmap_plugin.adaptation.views.shown import seeing
from mipmap_plugin.camera import evenly
from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.metrics import SAME_DB, psnr
from mipmap_plugin.models.adapted_scale import adapted_scale
from mipmap_plugin.models.base import means_at, why_no_viewer
from mipmap_plugin.wrap import Wrapped

VIEWERS = ("spark", "playcanvas", "gaussian-splats-3d", "classic", "antialiased")
VIEWS = 3

# Limits of splats and pixels over all views, so that rendering them takes about three seconds on one processor.
SPLATS, PIXELS = 500_000, 4_000_000


@torch.no_grad()
def viewer_differences(wrapped: Wrapped) -> str:
    """Describe the mean PSNR in each viewer over a few views, at the scale that a file was adapted to, in one sentence, or why it was not measured.

    Both images are rendered by this package: the viewer's with its convention (`splatting.viewers`), the truth with that of the training.
    """
    model, scale = wrapped.model, adapted_scale(wrapped.model.source) or 1.0
    if reason := why_no_viewer(model):
        return f"not drawn: {reason}"
    if model.traits.placed:
        return "not drawn: its own project alone opens such a file; `mipmap-plugin adapt --scale 1 --viewer NAME --output NEW.ply` makes another"
    if "reference" in (wrapped.backend()[0].name, wrapped.backend(viewer=VIEWERS[0])[0].name):
        return "not drawn: only the reference backend can, which takes too long; `mipmap-plugin backends` says what others lack"
    cameras = wrapped.views()
    views = [view.zoomed(scale) for view in seeing(cameras, means_at(model, cameras[0]), wrapped.effects().near_plane)]
    count, pixels = len(model.gaussians(views[0])), views[0].width * views[0].height
    view_count = min(VIEWS, len(views), SPLATS // max(1, count), PIXELS // pixels)
    if view_count == 0:
        return f"not drawn: {plural(count, 'splat')} on {plural(pixels, 'pixel')} take too long; `mipmap-plugin render --viewer NAME` draws them"
    chosen = evenly(views, view_count)
    truths = [wrapped.render(view, scale).image for view in chosen]
    if all(torch.equal(truth, truth[:1, :1].expand_as(truth)) for truth in truths):
        return f"not compared: there is nothing in {plural(view_count, 'view')} of its cameras"
    parts = []
    for viewer in VIEWERS:
        mean_psnr = fmean(psnr(wrapped.render(view, scale, viewer=viewer).image, truth) for view, truth in zip(chosen, truths, strict=True))
        parts.append(f"{viewer} {'the same' if mean_psnr == SAME_DB else f'{mean_psnr:.1f} dB'}")
    return f"{', '.join(parts)}, compared with its training, at x{scale:g} in {plural(view_count, 'view')}"
