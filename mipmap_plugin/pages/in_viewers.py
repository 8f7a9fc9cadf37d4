"""What viewers on the web will show of the base and of the adapted file, drawn with their conventions (`splatting.viewers`)."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.evaluation.metrics import psnr, ssim
from mipmap_plugin.evaluation.viewer_differences import VIEWERS
from mipmap_plugin.models.base import why_no_viewer
from mipmap_plugin.pages.record import Picture, Quality, ViewerPictures
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import Wrapped

# Pixels of a picture. A larger one is drawn as the window around its middle.
PIXELS = 1_000_000


def why_not(base: Wrapped) -> str:
    """Why no viewer's picture is drawn, in a sentence; "" if they are."""
    if reason := why_no_viewer(base.model):
        return f"No viewer: {reason}."
    if base.model.traits.placed:
        return "No viewer: its own project alone opens such a file."
    try:
        backend, _ = base.backend(viewer=VIEWERS[0])
    except BackendUnavailable as error:
        return f"Not drawn: {error}."
    return "Not drawn: only the reference backend could, which takes too long here." if backend.name == "reference" else ""


@torch.no_grad()
def viewer_pictures(base: Wrapped, adapted: Adapted, camera: Camera, truth: Tensor | None) -> list[ViewerPictures]:
    """Pictures in each viewer at the camera (of the new scale), compared with the truth [h, w, 3]; of a large image its middle."""
    side = max(camera.width, camera.height) if camera.width * camera.height <= PIXELS else int(PIXELS**0.5)
    view = camera.window(side, side)
    part = None if truth is None else middle(truth, view)
    file = Wrapped(adapted.model, base.cameras, adapted.backend.name, base.trained)
    made_for = made_for_viewers(adapted)
    names = dict.fromkeys((*made_for, *VIEWERS))
    return [_in_viewer(name, (base, file), view, part, name in made_for) for name in names]


def made_for_viewers(adapted: Adapted) -> list[str]:
    """The names of the viewers that a file was made for; without one asked for, those that draw it as it was adapted."""
    if asked := [name for name in adapted.viewers if name]:
        return asked
    return [name for name in VIEWERS if adapted.effects.screen_filter == name]


def middle(image: Tensor, view: Camera) -> Tensor:
    """The central crop of an image [h, w, 3] that `Camera.window` looks at."""
    top, left = (image.shape[0] - view.height) // 2, (image.shape[1] - view.width) // 2
    return image[top : top + view.height, left : left + view.width]


def _in_viewer(name: str, models: tuple[Wrapped, Wrapped], view: Camera, truth: Tensor | None, made_for: bool) -> ViewerPictures:
    base, adapted = (model.render(view, viewer=name).image for model in models)
    return ViewerPictures(
        name,
        find_viewer(name).title,
        Picture(f"base in {name}", "base", base, quality(base, truth)),
        Picture(f"adapted in {name}", "adapted", adapted, quality(adapted, truth)),
        made_for,
    )


def quality(image: Tensor, truth: Tensor | None) -> Quality:
    """PSNR and SSIM of an image, {} without a truth."""
    return {} if truth is None else {"psnr_db": psnr(image, truth), "ssim": ssim(image, truth)}
