"""Views that nothing can be adapted to: they see nothing, or only a speck, or are too large."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.views.remarks import LEAST_PIXELS, LEAST_SHARE, LOOKED_AT, SCALE_UP, too_small
from mipmap_plugin.adaptation.views.shown import showing
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.errors import SettingsError, some_of
from mipmap_plugin.limits import check_image
from mipmap_plugin.models.base import SplatModel, means_at
from mipmap_plugin.models.contract import row_opacities
from mipmap_plugin.progress import announced
from mipmap_plugin.render_settings import MIN_ALPHA


@announced("examining views")
def refuse_blind(views: Sequence[Camera], model: SplatModel, near: float, image_of: Callable[[Camera], Tensor], scale: float) -> None:
    """Raise SettingsError if the views show nothing, or a speck: the cameras may be of another scene, or no renderer draws the splats, for example.

    `near`: the near plane, in world units; `image_of`: a view's image [h, w, 3]; `scale`: the one adapted to, since a zoom-in makes specks large.
    """
    some, means = evenly(views, LOOKED_AT), means_at(model, views[0])
    if not showing(some, means, near):  # a few of many cameras may see what is left of a scene that was cut down
        some = evenly(showing(views, means, near), LOOKED_AT) or some
    if any(_draws(view, model, near) for view in some):
        if small := too_small(views, model, near, min(LEAST_PIXELS, LEAST_SHARE * min(views[0].size)) / max(1.0, scale)):
            raise SettingsError(small)
        return
    if all(torch.equal(image, image[:1, :1].expand_as(image)) for image in map(image_of, some)):  # nor a splat whose center lies outside
        wrong = "the cameras seem to be of another scene, or in other coordinates; give those of this scene"
        if showing(some, means, near):
            wrong = "all splats in view have an opacity below 1/255 and are never drawn; the training or the export failed"
        elif showing(some, means, 0.0):
            wrong = f"all splats lie nearer than {near:g} units, where renderers of 3DGS draw none; {SCALE_UP}"
        raise SettingsError(f"{some_of(0, len(views), 'view', 'show')} a splat: {wrong}")


def _draws(view: Camera, model: SplatModel, near: float) -> bool:
    """Whether a row of the parameters that is opaque enough to be drawn lies in the view's picture, farther than the near plane."""
    inside = view.in_picture(view.to_camera(means_at(model, view)), near)
    return bool(inside.any()) and bool((row_opacities(model, [view])[inside] >= MIN_ALPHA).any())


def refuse_large(views: Sequence[Camera], model: SplatModel, scale: float) -> None:
    """Raise SettingsError if the memory cannot hold the largest image that is adapted to."""
    largest = max(views, key=lambda camera: camera.width * camera.height).zoomed(scale)
    check_image(largest.width, largest.height, model.parameters()["means"].device)
