"""The base's own images, from which the pseudo truth is made: each is drawn once for all scales and viewers that a base is adapted to."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.image_store import ImageStore
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel

# Bytes of the images that are kept for the next scale: 280 of 800 x 800 px, about as many as `default` uses. They stay as long as the wrapped
# model, so this has to leave room for others on a laptop of 8 GiB.
LIMIT = 1 << 30


class BaseImages:
    """The images [H, W, 3] of a frozen model by a backend, clamped to 0..1, without gradients."""

    def __init__(self, model: SplatModel, backend: Backend, effects: Effects, limit: int = LIMIT) -> None:
        """`effects`: how the model is rendered at the scale of its training. `limit`: bytes of the images that are kept."""
        self.model, self.backend, self.effects = model, backend, effects
        self._store = ImageStore(limit, model.parameters()["means"])
        self._versions = _versions(model)
        self._activated: Gaussians | None = None

    def __call__(self, view: Camera, fraction: float = 1.0) -> Tensor:
        """The image of a view of the base scale, or at a fraction of its size; the dilation keeps its size in the world.

        It is clamped, as a display does, before anybody resizes it: unclamped highlights would bleed into their neighbors (-3 dB at x1/8).
        """
        return self._store((facts(view), fraction), lambda: self._drawn([view], fraction)[0])

    def of_one_size(self, views: Sequence[Camera], fraction: float = 1.0) -> Tensor:
        """The same of several views whose images are of one size, [V, H, W, 3]: those that are not known are drawn in one call."""
        keys = [(facts(view), fraction) for view in views]
        return self._store.of_one_size(keys, lambda numbers: self._drawn([views[number] for number in numbers], fraction))

    @property
    def draws_together(self) -> bool:
        """Whether several images can be drawn in one call."""
        return self.model.traits.same_for_all_views and hasattr(self.backend, "render_views")

    def are_of(self, model: SplatModel, backend: Backend, effects: Effects) -> bool:
        """Whether these are the images of this model, as it is now, by such a backend."""
        same = self.model is model and self._versions == _versions(model)  # its owner may change a model that is not of a file
        return same and (self.backend.name, self.effects) == (backend.name, effects)

    def keep_only(self, views: Iterable[Camera]) -> None:
        """Forget the images of all other views, so that those of `views` find room."""
        kept = {facts(view) for view in views}
        self._store.keep_only(lambda key: key[0] in kept)

    @torch.no_grad()
    def _drawn(self, views: Sequence[Camera], fraction: float) -> Tensor:
        """The images of views of one size, [V, H, W, 3], in one call if they are several."""
        shots = [self._shot(view, fraction) for view in views]
        splats, backend = self._splats(shots[0][0]), cast(Any, self.backend)
        drawn = backend.render_views(splats, shots) if len(shots) > 1 else [backend.render(splats, *shots[0])]
        return torch.stack([rendered.image for rendered in drawn]).clamp_(0, 1)

    def _shot(self, view: Camera, fraction: float) -> tuple[Camera, Effects]:
        """The camera of an image, and how it is rendered."""
        # Resized, not zoomed: the model sees the `zoom` of its training, so that it shows the same splats, only with fewer pixels.
        factor = fraction * view.base_zoom / view.zoom  # a view of a band (`over_band`) samples more or less finely than the base
        size = (max(1, round(pixels * factor)) for pixels in (view.width, view.height))
        camera = view if factor == 1 and view.zoom == view.base_zoom else replace(view.resized(*size), zoom=view.base_zoom)
        return camera, replace(self.effects, eps2d=self.effects.eps2d * fraction**2)

    def _splats(self, camera: Camera) -> Gaussians:
        """The splats, activated once if all cameras see the same ones: activation takes a fifth of a small image's time."""
        if not self.model.traits.same_for_all_views:
            return self.model.gaussians(camera)  # not kept: views may be rendered in parallel
        if self._activated is None:
            self._activated = self.model.gaussians(camera)
        return self._activated


def _versions(model: SplatModel) -> list[int]:
    """How often torch has changed each parameter in place."""
    return [tensor._version for tensor in model.parameters().values()]


def facts(view: Camera) -> Hashable:
    """Everything that an image depends on. Cameras are compared by identity, but each call generates its random views anew."""
    pose = view.viewmat.numpy().tobytes()
    return view.width, view.height, view.fx, view.fy, view.cx, view.cy, pose, view.time, view.zoom, view.base_zoom, view.index
