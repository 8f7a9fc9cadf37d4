"""A camera that walks backwards, away from what it looks at, and what the supersampled base shows there.

In the view where a walk begins, the base's picture is right. The screen filter that it was trained with is part of that picture: e px² around each
splat, as large in the world as the splat's distance makes them. On the way back everything keeps that size in the world, and only becomes smaller on
the screen: at the scale s, the depth at the beginning over the depth now, a splat is dilated by e·s² px². A classic renderer dilates it by e again,
which thickens what was near and leaves what is far as it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.image_store import ImageStore
from mipmap_plugin.adaptation.target.pseudo_truth import LIMIT
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views.pixel_size import pixel_size
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.screen_filters import COMPENSATED
from mipmap_plugin.splatting.filters import SQUARE_VARIANCE
from mipmap_plugin.splatting.projection import covariances_of, project

# World units times the near plane: a splat this near is not in the picture.
TINY = 1e-6


class WalkTruth:
    """The supersampled base in the views of walks: [H, W, 3], kept by camera."""

    def __init__(self, base: tuple[Gaussians, Backend, Effects], views: Sequence[Camera], begins: Mapping[Camera, Camera], samples: int) -> None:
        """`base`: its splats, drawn by a backend with the effects of its training. `views`: of the training. `begins`: where the walk of each
        view began. `samples`: a pixel's along each side."""
        self._splats, self._backend, self._effects = base
        self._pixels, self._begins, self._samples = pixel_size(self._splats.means, views), begins, samples
        self._store = ImageStore(LIMIT, self._splats.means)

    def __call__(self, view: Camera) -> Tensor:
        return self._store(view, lambda: self.make(view, self._begins[view]))

    @torch.no_grad()
    def make(self, view: Camera, begin: Camera) -> Tensor:
        """The picture of a view whose walk began at `begin`; the view itself for its first."""
        fine = view.resized(self._samples * view.width, self._samples * view.height)
        plain = replace(self._effects, screen_filter="classic", eps2d=0.0)
        image = self._backend.render(self._thick(fine, view, begin), fine, plain).image.clamp(0, 1)
        return resize(image, view.size, "box").clamp(0, 1)

    def _thick(self, fine: Camera, view: Camera, begin: Camera) -> Gaussians:
        """The splats with the dilation in the world that they had in the first picture. Averaging a pixel's samples is a part of it already:
        (1 - 1 / n²) / 12 px², so that the truth of the first picture is the base's own up to the shape of the filter."""
        splats, effects, square = self._splats, self._effects, self._samples**2
        scales = self._scales(view, begin)
        whole = effects.eps2d * square * scales.square()
        spread = whole - (square - 1) * SQUARE_VARIANCE * scales.square()
        depth = fine.to_camera(splats.means)[:, 2].clamp_min(effects.near_plane)
        across = fine.viewmat[:2, :3].to(splats.means)  # the camera's right and down, along which the screen's x and y run
        focals = splats.means.new_tensor([fine.fx, fine.fy])
        variances = spread.clamp_min(0)[:, None] * (depth[:, None] / focals).square()  # [N, 2] world units²
        covariances = covariances_of(splats) + torch.einsum("nk,ki,kj->nij", variances, across, across)
        opacities = splats.opacities
        if effects.screen_filter in COMPENSATED:
            projected = project(splats, fine, effects.near_plane, effects.settings)
            det = projected.det + whole * (projected.xx + projected.yy) + whole**2
            opacities = opacities * (projected.det / det).sqrt()
        return replace(splats, covariances=covariances, opacities=opacities)

    def _scales(self, view: Camera, begin: Camera) -> Tensor:
        """[N], at most 1: how large each splat is, beside how large it was where the walk began, or in the closest training view."""
        now, then = (camera.to_camera(self._splats.means)[:, 2] for camera in (view, begin))
        size = torch.maximum(then / mean_focal(begin), self._pixels)
        return (size * mean_focal(view) / now.clamp_min(TINY)).clamp_max(1)


def mean_focal(camera: Camera) -> float:
    """The focal length in px, the mean of both."""
    return float((camera.fx * camera.fy) ** 0.5)
