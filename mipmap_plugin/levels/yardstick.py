"""What a level is measured by: views that no level was adapted to, and what the base shows of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import psnr_as_shown
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.adaptation.target.resize import filter_for, resize
from mipmap_plugin.adaptation.views.for_validation import WINDOW
from mipmap_plugin.adaptation.views.shown import showing
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import ONE_PIXEL, Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.limits import derived_seed
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.scenes.trajectories import jittered, with_company

# The number of random views, and how many times as many are drawn at random to find so many that show something. Of large images only the middle is
# used, as for validation.
VIEWS, TRIED = 4, 4

# Levels that are drawn in turn at many zooms: neighbors. What draws one holds its splats, rounded as the viewer does.
KEPT = 2

# Number of the random draw, apart from those of views that are adapted to and of validation.
DRAW = 104_729

TRUTH = (
    f"mean PSNR over at most {VIEWS} random views that no level was adapted to, against the base's own images at x1, shrunk by pil-bicubic"
    " (to 1 or 2 px by area)"
)


class Yardstick:
    """Compares levels with the base's own images, shrunk to any zoom."""

    def __init__(self, base: FrozenBase, seed: int) -> None:
        generator = torch.Generator().manual_seed(derived_seed(seed, DRAW))
        views = jittered(with_company(base.views(), base.viewpoints.orbit), TRIED * VIEWS, generator, spread=False)
        shown = showing(views, base.model.parameters()["means"], base.effects().near_plane)  # between objects far apart there is nothing
        self.views = [view.window(WINDOW, WINDOW) for view in (shown or views)[:VIEWS]]
        self._images = {view: base.render(view).image.clamp(0, 1) for view in self.views}
        self._of_level = lru_cache(KEPT)(lambda level: _drawing(level.model, level.backend, level.effects))
        self._of_base = lru_cache(1)(lambda viewer: _drawing(base.read_by(viewer), base.backend(viewer=viewer)[0], base.effects(viewer=viewer)))

    def example(self) -> tuple[Camera, Tensor]:
        """One of the views, and the base's own image of it [h, w, 3]."""
        view = self.views[0]
        return view, self._images[view]

    def psnr(self, level: Adapted, zoom: float) -> float:
        """Mean PSNR (dB) of a level at a zoom."""
        draw = self._of_level(level)
        return self._mean(lambda camera, truth: psnr_as_shown(draw(camera), truth), zoom)

    def psnr_of_base(self, viewer: str, zoom: float) -> float:
        """Mean PSNR (dB) of the base itself, as a viewer draws it at a zoom."""
        draw = self._of_base(viewer)
        return self._mean(lambda camera, truth: psnr_as_shown(draw(camera), truth), zoom)

    def likeness(self, one: Adapted, other: Adapted, zoom: float) -> float:
        """Mean PSNR (dB) between the images of two levels at a zoom."""
        draw, draw_other = self._of_level(one), self._of_level(other)
        return self._mean(lambda camera, _: psnr_as_shown(draw(camera), draw_other(camera)), zoom)

    def _mean(self, compare: Callable[[Camera, Tensor], float], zoom: float) -> float:
        cameras = {view: view.zoomed(zoom) for view in self.views}
        return fmean(compare(camera, shrunk(self._images[view], camera)) for view, camera in cameras.items())


@torch.no_grad()
def _drawing(model: SplatModel, backend: Backend, effects: Effects) -> Callable[[Camera], Tensor]:
    """What draws a model several times."""
    renderer = Renderer(backend, effects)
    return renderer.of(model.gaussians(ONE_PIXEL).detach()) if model.traits.same_for_all_views else renderer.of_model(model)


def shrunk(image: Tensor, camera: Camera) -> Tensor:
    """The base's own image of a view as `camera` sees that, [h, w, 3], with the filter that pseudo truths of this size have."""
    return resize(image, camera.size, filter_for(min(camera.size)))
