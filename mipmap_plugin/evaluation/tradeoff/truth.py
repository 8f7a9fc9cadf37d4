"""The truth and the views of a tradeoff: photographs if there are any, otherwise images of the base itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views.moments import with_times
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError, plural, warn
from mipmap_plugin.evaluation.judged import photographed_views
from mipmap_plugin.evaluation.measure import RESIZED, resized_base, supersampled, views_seen
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.other_scene import of_another_scene, of_another_size
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.scenes import Scene, jittered
from mipmap_plugin.scenes.trajectories import with_company
from mipmap_plugin.wrap import Wrapped

# Of a checkpoint without test views, one camera in this many is held out, as mip-NeRF 360 does.
HELD_OUT_EVERY = 8

# The seed of generated views to evaluate on; views to adapt to have the user's seed.
EVALUATION_SEED = 8_128


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Views that nothing is adapted to, and their truth."""

    label: str  # what the dB are measured against; the label of the axis
    views: list[Camera]  # at the base scale
    adapt_on: list[Camera]  # the other cameras, to adapt to; none: an orbit is generated
    psnr: Callable[[Camera, Tensor], float]  # (one of the views, the image of it at the new scale) -> dB
    shrink_by: str  # the filter that made the truth smaller
    itself: tuple[str, ...] = ()  # the baselines that are the truth itself, and so no rivals


def photographs(model: Wrapped, scene: Scene, scale: float, most: int | None) -> GroundTruth:
    """At most `most` photographs of a placed scene (`Wrapped.place`), resized by protocol P3. If every camera has one, only every eighth is used.

    Raises SettingsError if there are none, if they are too small, and if no other camera is left to adapt to.
    """
    if doubt := of_another_size(model, scene):
        warn(doubt)
    judged = {view.camera: view for view in photographed_views(model, scene)}
    train = [camera for camera in model.cameras if camera.split == "train"] or model.cameras
    views, adapt_on = list(judged), _others(train, list(judged))
    if not adapt_on:
        views = views[::HELD_OUT_EVERY]
        adapt_on = _others(train, views)
    if not adapt_on:
        raise SettingsError("every camera of the checkpoint is evaluated, so that none is left to adapt to; give photographs of fewer views")
    protocol, views = PROTOCOLS["P3"], evenly(views, most)
    if doubt := of_another_scene(model, [judged[view] for view in views]):
        model.doubted = True  # at other scales it would be told again
        warn(doubt)
    truths = {view: judged[view].truth(scale, protocol) for view in views}
    label = f"real dB, protocol P3 on {plural(len(views), 'photograph')}"
    return GroundTruth(label, views, adapt_on, lambda view, image: psnr(protocol.as_saved(image), truths[view]), protocol.shrink_by)


@torch.no_grad()
def base_itself(model: Wrapped, scale: float, most: int | None, views: Sequence[Camera] = ()) -> GroundTruth:
    """The truth without photographs. Zoom-out: the base's image, made smaller, which is the supersampled base where whole pixels of it fit.
    Zoom-in: the base, with which images are compared after shrinking.

    `views`: to evaluate on, instead of at most `most` that are held out here.
    """
    held_out, adapt_on = _held_out(model)
    views = list(views) or evenly(held_out, most)
    base_images = {view: model.render(view).image.clamp(0, 1) for view in views}
    counted = f"(no photographs), {plural(len(views), 'view')}"
    if scale > 1:
        label = f"dB of the image, shrunk, against the base itself {counted}"
        return GroundTruth(label, views, adapt_on, lambda view, image: psnr(resize(image, view.size, "area"), base_images[view]), "area", (RESIZED,))
    n, itself = math.ceil(1 / scale), [RESIZED]
    made = "the base's image, made smaller"
    if all(view.size == tuple(n * side for side in view.zoomed(scale).size) for view in views):
        made, itself = f"the base supersampled {n} x {n}", [RESIZED, supersampled(n)]
    label = f"dB against {made} {counted}"
    truths = {view: resized_base(image, view.zoomed(scale).size, shrink_by="area") for view, image in base_images.items()}
    return GroundTruth(label, views, adapt_on, lambda view, image: psnr(image, truths[view]), "area", tuple(itself))


def unseen(model: Wrapped, adapted_to: Sequence[Camera]) -> list[Camera]:
    """Views that nothing was adapted to: the cameras that are not among those `adapted_to` or, if all are, a generated one."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    views = _others(model.cameras, adapted_to) or jittered(with_company(model.views(), model.viewpoints.orbit), 1, generator)
    return with_times(views, EVALUATION_SEED)[0] if model.model.traits.moves else views


def _held_out(model: Wrapped) -> tuple[list[Camera], list[Camera]]:
    """Views to evaluate on and views to adapt to: the checkpoint's own split, every eighth camera, or generated ones."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    test, train = ([camera for camera in model.cameras if camera.split == split] for split in ("test", "train"))
    if not model.cameras:
        judged = choose_views([], model.viewpoints, AdaptConfig(seed=EVALUATION_SEED, extra_views=HELD_OUT_EVERY))[0]
    elif test and (rest := _others(train, test)):
        judged, train = test, rest
    elif rest := _others(model.cameras, model.cameras[::HELD_OUT_EVERY]):
        judged, train = model.cameras[::HELD_OUT_EVERY], rest
    else:
        judged, train = jittered(with_company(model.cameras, model.viewpoints.orbit), HELD_OUT_EVERY, generator), model.cameras
    return (with_times(judged, EVALUATION_SEED)[0] if model.model.traits.moves else judged), train


def _others(cameras: list[Camera], judged: Sequence[Camera]) -> list[Camera]:
    """The cameras that are not among the `judged` views."""
    seen = {*views_seen(cameras, judged)}
    return [camera for camera in cameras if camera not in seen]
