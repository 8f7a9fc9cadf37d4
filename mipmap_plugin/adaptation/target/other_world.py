"""Photographs that a base does not show: they are of another scene, or their cameras in another world than its splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR, decibel, psnr_as_shown
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.models.exposure import NO_EXPOSURES, Exposures
from mipmap_plugin.progress import announced

# So many photographs are looked at, at so many px of the shorter side; they tell as much as all do at their own size.
MOST_VIEWS, LOOK = 8, 128

# Half turns of a world, by the signs of its axes. LichtFeld Studio turns that of a transforms file about y, of which its PLYs say nothing
# (src/loader/formats/transforms.cpp, 0ff1dc2). About x and z it is what mixes up axes of OpenGL and OpenCV, and what is up and down.
HALF_TURNS = {"y": (-1.0, 1.0, -1.0), "x": (1.0, -1.0, -1.0), "z": (-1.0, -1.0, 1.0)}

# A base this close to photographs, in dB, differs from them by less than their 8 bits can tell, however close others come, as to one color.
THE_SAME = decibel(INVISIBLE_ERROR)

# How far poses of one place are apart: files of one capture have float32.
SAME_POSE = 1e-5


@announced("comparing the base with photographs")
def doubt_about(
    cameras: Sequence[Camera],
    photograph: Callable[[Camera], Tensor],
    render: Callable[..., Rendered],
    background: tuple[float, float, float],
    option: str,
    exposures: Exposures = NO_EXPOSURES,
) -> str:
    """That the base shows photographs worse than the mean of the others does, in a sentence; "" if it shows them better.

    A model of the scene wins by far, and one of another scene loses, whatever both look like. It needs photographs from different places. Where the
    base is empty, it may also count as showing that mean, for it may be one object of a capture.

    `cameras`: in the base's frame and at the density of its pixels, each with a `photograph` [H, W, 3] of any size; `render`: that of
    the base (`FrozenBase.render`), on its `background` (RGB); `option`: that gave them; `exposures`: of the photographs, as far as they are known.
    """
    cameras = _from_different_places(evenly(cameras, MOST_VIEWS))
    if len(cameras) < 2:
        return ""
    first = photograph(cameras[0])
    factor = min(1.0, min(LOOK, *first.shape[:2]) / min(cameras[0].size))
    size = cameras[0].zoomed(factor).size
    each_alone = chain([first], map(photograph, cameras[1:]))  # for one may have 100 megapixels
    truths = [resize(image.cpu(), size, "area") for image in each_alone]  # some are a pixel wider, or taken upright
    total = torch.stack(truths).sum(0)
    others = [(total - truth) / (len(truths) - 1) for truth in truths]
    by_others = fmean(map(psnr_as_shown, others, truths))

    @torch.no_grad()
    def by_base(views: Sequence[Camera]) -> float:
        shown = [render(view.zoomed(factor), factor, "scaled") for view in views]
        images = [resize(exposures.applied(each.image.cpu(), view), size, "area") for each, view in zip(shown, views, strict=True)]
        empty = [resize(1 - each.alpha.cpu()[..., None].expand_as(each.image), size, "area") for each in shown]
        behind = [exposures.applied(torch.tensor(background), view) for view in views]
        filled = [image + hole * (other - color) for image, hole, other, color in zip(images, empty, others, behind, strict=True)]
        return max(fmean(map(psnr_as_shown, each, truths)) for each in (images, filled))

    if (found := by_base(cameras)) > min(by_others, THE_SAME):
        return ""
    told = f"the base has {found:.1f} dB against the photographs, and the mean of the other photographs {by_others:.1f}"
    told = f"{told}: they may be of another scene, or their cameras in another frame; "
    for axis, signs in HALF_TURNS.items():
        turn = torch.diag(torch.tensor([*signs, 1.0], dtype=torch.float64))
        if (found := by_base([camera.moved(turn) for camera in cameras])) > by_others:
            who = ", as LichtFeld Studio turns that of a transforms.json" if axis == "y" else ""
            turned = f"with its world turned by half a turn about {axis}{who}, it has {found:.1f}"
            angles = ",".join("180" if each == axis else "0" for each in "xyz")
            return f"{told}{turned}: turn the splats (splat-transform -r {angles})"
    return f"{told}check {option}"


def _from_different_places(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras without those whose pose another one had: a camera that stands still sees the mean of its photographs."""
    found: list[Camera] = []
    for camera in cameras:
        if not any(torch.allclose(camera.viewmat, other.viewmat, rtol=SAME_POSE, atol=SAME_POSE) for other in found):
            found.append(camera)
    return found
