"""Photographs that are of another scene than the checkpoint, or of a smaller size: all figures would be of no use, or of another scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import torch

from mipmap_plugin.adaptation.target.photographs import names_of
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import evenly
from mipmap_plugin.evaluation.measure import resized_base, views_seen
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import Protocol, TruthView
from mipmap_plugin.models.adapted_scale import adapted_scale
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import Scene
from mipmap_plugin.scenes.cameras_json import photographs_folder, trained_size
from mipmap_plugin.wrap import Wrapped

# So many views are looked at; they tell as much as all do.
MOST_VIEWS = 8

# px: a size that was rounded in other ways is no other size.
ROUNDING = 4


@torch.no_grad()
def of_another_scene(model: Wrapped, views: Sequence[TruthView], scale: float, protocol: Protocol) -> str:
    """That the base shows photographs worse than the mean of the others does, in a sentence; "" if it shows them better.

    A model of the scene wins by far, and one of another scene loses, whatever both look like. It needs photographs from different places.
    """
    views = _from_different_places(evenly(views, MOST_VIEWS))
    if len(views) < 2:
        return ""
    size = views[0].camera.zoomed(scale).size
    truths = [resize(view.truth(scale, protocol), size, "bilinear") for view in views]  # some are a pixel wider, or taken upright
    total = torch.stack(truths).sum(0)
    by_others = fmean(psnr((total - truth) / (len(truths) - 1), truth) for truth in truths)
    own = adapted_scale(model.model.source) or 1.0  # at which alone an adapted file looks right
    shown = (resized_base(model.render(view.camera.zoomed(own), own).image, size, shrink_by=protocol.shrink_by) for view in views)
    by_base = fmean(psnr(image.to(truth), truth) for image, truth in zip(shown, truths, strict=True))
    if by_base > by_others:
        return ""
    compared = f"the base has {by_base:.1f} dB against the photographs, and the mean of the other photographs {by_others:.1f}"
    return f"{compared}: they may be of another scene, or their cameras in another frame; check --images"


def of_another_size(model: Wrapped, scene: Scene) -> str:
    """That a training on these photographs has smaller pictures than the base's cameras, in a sentence; "" if it has not.

    A cameras.json states the size that COLMAP saw, which the photographs of Tanks and Temples in 3DGS's own download have not:
    they are half of it (graphdeco-inria/gaussian-splatting, issue 692).
    Larger ones are no such doubt: a zoom-in is judged against the photographs that smaller ones for the training were made from.
    """
    cfg = read_options(model.model.folder)[0]
    whole = (view for view, file in scene.images.items() if file.parent.name == photographs_folder(cfg) and file not in scene.lenses)
    view = next(whole, None)
    if not cfg or view is None:
        return ""
    own, names = scene.image_size(view), names_of(view)
    trained, there = trained_size(*own, {**cfg, "images": "", "ds": 1}), [base for base in model.cameras if names_of(base)[0] in names]
    if not there or any(max(base.width - trained[0], base.height - trained[1]) <= ROUNDING for base in there):
        return ""
    said, found, expected = (f"{width} x {height} px" for width, height in ((there[0].width, there[0].height), own, trained))
    doubt = f"the base's cameras are of {said}, but a training on the photographs (of {found}) has pictures of {expected}"
    return f"{doubt}: if these are what it was trained on, x1 is another scale than is taken here; add --cameras {scene.source}"


def _from_different_places(views: Sequence[TruthView]) -> list[TruthView]:
    """The views without those whose pose another one had: a camera that stands still sees the mean of its photographs."""
    found: list[TruthView] = []
    for view in views:
        if not views_seen([replace(view.camera, time=None)], [each.camera for each in found]):
            found.append(view)
    return found
