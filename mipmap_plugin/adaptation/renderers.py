"""What renders the student while it is adapted: a backend with the effects of the viewers that the file is made for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.optimization.run import SteppingRenderer, ViewsRenderer
from mipmap_plugin.backends.base import Backend, Later
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians


def renderer(backend: Backend, effects: Effects) -> Callable[[Gaussians, Camera], Tensor]:
    """A function that renders the image of a camera. It holds no session, which would keep the state's file locked after the run."""
    return lambda gaussians, camera: backend.render(gaussians, camera, effects).image


def views_renderer(backend: Backend, targets: Sequence[Effects]) -> ViewsRenderer | None:
    """A function that renders several images in one call, the targets taking turns; None if the backend has none."""
    render_views = getattr(backend, "render_views", None)
    if render_views is None:
        return None

    def images(gaussians: Gaussians, cameras: Sequence[Camera], draw: int) -> list[Tensor]:
        return [rendered.image for rendered in render_views(gaussians, _shots(cameras, targets, draw))]

    return images


def stepping_renderer(backend: Backend, targets: Sequence[Effects]) -> SteppingRenderer | None:
    """The same for images whose gradients the backend hands to Adam itself; None if it does not, or the effects do not allow it."""
    render_to_step = getattr(backend, "render_to_step", None)
    if render_to_step is None or any(target.settings.packing is not None for target in targets):
        return None

    def images(gaussians: Gaussians, cameras: Sequence[Camera], draw: int) -> tuple[list[Tensor], Later]:
        drawn, later = render_to_step(gaussians, _shots(cameras, targets, draw))
        return [rendered.image for rendered in drawn], later

    return images


def _shots(cameras: Sequence[Camera], targets: Sequence[Effects], draw: int) -> list[tuple[Camera, Effects]]:
    """The `draw`-th view since the beginning and those after it, each with the effects of the target whose turn it is."""
    return [(camera, targets[(draw + number) % len(targets)]) for number, camera in enumerate(cameras)]


def unrounded(effects: Effects) -> Effects:
    """The effects without the rounding of a viewer's file and picture, which is noise to an optimizer step and a third of its time."""
    return replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))
