"""What the decibels of a tradeoff are of, and on which views: photographs where there are any, else what the base itself knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views import choose_views, with_times
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.measure import resized_base, seen_before
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import PROTOCOLS, Judged, test_views
from mipmap_plugin.scenes import Scene, jittered
from mipmap_plugin.wrap import Wrapped

# Of a checkpoint without test views, one camera in so many is kept from adapting, as mip-NeRF 360 does.
HOLD_OUT = 8

# The seed of views that are generated to judge on; those to adapt on follow from seeds that a person chooses.
JUDGES_SEED = 8_128


@dataclass(frozen=True, eq=False)
class Yardstick:
    """Views that nothing is adapted to, and the truth in them."""

    label: str  # what the dB are of, as the axis says it
    views: list[Camera]  # of the base scale
    adapt_on: list[Camera]  # the cameras that are left to adapt on; none: an orbit is generated
    psnr: Callable[[Camera, Tensor], float]  # (one of the views, the image of it at the new scale) -> dB
    shrink_by: str  # the filter that made the truth smaller
    is_resized_base: bool  # the truth is the base's own image, made smaller


def photographs(model: Wrapped, scene: Scene, scale: float, most: int | None) -> Yardstick:
    """Real images, resized as protocol P3 does; `most` of them at most. Where every camera has one, each eighth is judged on.

    Raises SettingsError without any, where they are too small, and where no other camera is left to adapt to.
    """
    scene = model.place(scene)
    if not model.cameras:
        raise SettingsError("the checkpoint has no cameras, so its base scale is not known; give its model folder")
    judged: dict[Camera, Judged] = {view.camera: view for view in test_views(scene, model.cameras[0], model.background)}
    train = [camera for camera in model.cameras if camera.split == "train"] or model.cameras
    views, adapt_on = list(judged), _others(train, list(judged))
    if not adapt_on:
        views = views[::HOLD_OUT]
        adapt_on = _others(train, views)
    if not adapt_on:
        raise SettingsError("every camera of the checkpoint is one that is judged, so that none is left to adapt to; give photographs of fewer views")
    protocol, views = PROTOCOLS["P3"], evenly(views, most)
    truths = {view: judged[view].truth(scale, protocol) for view in views}
    label = f"real dB, protocol P3 on {len(views)} photographs"
    return Yardstick(label, views, adapt_on, lambda view, image: psnr(protocol.judged(image), truths[view]), protocol.shrink_by, False)


@torch.no_grad()
def base_itself(model: Wrapped, scale: float, most: int | None) -> Yardstick:
    """Without photographs. Zoom-out: the supersampled base. Zoom-in: the image, shrunk, against the base, for more is not known."""
    views, adapt_on = _held_out(model)
    views = evenly(views, most)
    shown = {view: model.render(view).image.clamp(0, 1) for view in views}
    if scale > 1:
        label = f"dB of the image, shrunk, against the base itself (no photographs), {len(views)} views"
        return Yardstick(label, views, adapt_on, lambda view, image: psnr(resize(image, view.size, "area"), shown[view]), "area", False)
    n = math.ceil(1 / scale)
    label = f"dB against the base supersampled {n} x {n} (no photographs), {len(views)} views"
    truths = {view: resized_base(image, view.zoomed(scale).size, shrink_by="area") for view, image in shown.items()}
    return Yardstick(label, views, adapt_on, lambda view, image: psnr(image, truths[view]), "area", True)


def _held_out(model: Wrapped) -> tuple[list[Camera], list[Camera]]:
    """Views to judge on and views to adapt on: the checkpoint's own split, every eighth camera, or generated ones."""
    generator = torch.Generator().manual_seed(JUDGES_SEED)
    test, train = ([camera for camera in model.cameras if camera.split == split] for split in ("test", "train"))
    if not model.cameras:
        judged = choose_views([], model.model.parameters()["means"], AdaptConfig(seed=JUDGES_SEED, extra_views=HOLD_OUT))[0]
    elif test and (rest := _others(train, test)):
        judged, train = test, rest
    elif rest := _others(model.cameras, model.cameras[::HOLD_OUT]):
        judged, train = model.cameras[::HOLD_OUT], rest
    else:
        judged, train = jittered(model.cameras, HOLD_OUT, generator), model.cameras
    return (with_times(judged, JUDGES_SEED)[0] if model.model.traits.moves else judged), train


def _others(cameras: list[Camera], judged: list[Camera]) -> list[Camera]:
    """The cameras that are none of the judged views."""
    seen = seen_before(cameras, judged)
    return [camera for camera in cameras if camera not in seen]
