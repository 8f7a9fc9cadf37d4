"""What renders the student while it is adapted: a backend with the effects of the viewers that the file is made for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend, Stepper
from mipmap_plugin.camera import ONE_PIXEL, Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.process import threads
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.splatting.packing import COLOR_LIMITS, in_two_steps, packed

# The numbers of views in a step and their images [h, w, 3] -> the gradient of each one's loss, [h, w, 3], and its mean square error, [].
Comparison = Callable[[Sequence[int], Sequence[Tensor]], list[tuple[Tensor, Tensor]]]

# Splats, cameras of the new scale and the number of the first of these draws -> [h, w, 3] each.
ViewsRenderer = Callable[[Gaussians, Sequence[Camera], int], list[Tensor]]


@dataclass(frozen=True)
class Renderer:
    """Renders the image of a camera. It holds no session, which would keep the state's file locked after the run."""

    backend: Backend
    effects: Effects

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        return self.backend.render(gaussians, camera, self.effects).image

    def of_model(self, model: SplatModel) -> Callable[[Camera], Tensor]:
        """What renders a model without gradients."""
        return torch.no_grad()(lambda camera: self(model.gaussians(camera), camera))

    def of(self, gaussians: Gaussians) -> Callable[[Camera], Tensor]:
        """What renders these splats alone, several times: a viewer's rounding of them takes longer than an image, and most is the same for all.

        Splats are sorted by what they are before they are rounded, so that they are not rounded once for all if their order depends on it.
        """
        settings = self.effects.settings
        even = settings.even_buckets
        if settings.packing is None or settings.bucketed or (even is not None and (even.largest_first or even.sphere_from is not None)):
            return partial(self, gaussians)
        once, rest = in_two_steps(settings.packing)
        rounded = packed(gaussians, ONE_PIXEL, once)
        return partial(Renderer(self.backend, replace(self.effects, settings=replace(settings, packing=rest))), rounded)


def views_renderer(backend: Backend, targets: Sequence[Effects]) -> ViewsRenderer | None:
    """A function that renders several images in one call, the targets taking turns; None if the backend has none."""
    render_views = getattr(backend, "render_views", None)
    if render_views is None:
        return None

    def images(gaussians: Gaussians, cameras: Sequence[Camera], draw: int) -> list[Tensor]:
        return [rendered.image for rendered in render_views(gaussians, _shots(cameras, targets, draw))]

    return images


@dataclass(frozen=True)
class SteppingRenderer:
    """Draws the images of a step, several at the same time, by what moves the splats afterwards; the targets take turns."""

    stepper: Callable[[Mapping[str, Tensor]], Stepper]  # `Backend.stepper`
    targets: Sequence[Effects]
    together: ClassVar[bool] = True  # whether the views of a step may be drawn in one call

    @classmethod
    def of(cls, backend: Backend, targets: Sequence[Effects]) -> SteppingRenderer | None:
        """None if the backend moves no splats, or the effects do not allow it."""
        stepper = getattr(backend, "stepper", None)
        return None if stepper is None or any(target.settings.by_view for target in targets) else cls(stepper, targets)

    def differentiate(self, stepper: Any, cameras: Sequence[Camera], draw: int, compare: Comparison) -> list[Tensor]:
        """Draw the views of a step, whose first is the `draw`-th since the beginning, and compare their images; return the mean square errors."""
        shots = _shots(cameras, self.targets, draw)
        if self.together and hasattr(stepper, "render_all"):
            compared = compare(range(len(shots)), [drawn.image for drawn in stepper.render_all(shots)])
            stepper.differentiate_all([gradient for gradient, _ in compared])
            return [square_error for _, square_error in compared]
        at_once = min(len(shots), threads.for_views())
        if at_once > 1 and hasattr(stepper, "prepare"):  # one thread would only lose from its cache what it needs next
            stepper.prepare(shots)
        return list(side_by_side(lambda number: self.differentiate_one(stepper, number, shots[number], compare), range(len(shots)), at_once))

    def differentiate_one(self, stepper: Stepper, number: int, shot: tuple[Camera, Effects], compare: Comparison) -> Tensor:
        """The same for the view of that number in the step."""
        [(gradient, square_error)] = compare([number], [stepper.render(number, *shot).image])
        stepper.differentiate(number, gradient)
        return square_error


def _shots(cameras: Sequence[Camera], targets: Sequence[Effects], draw: int) -> list[tuple[Camera, Effects]]:
    """The `draw`-th view since the beginning and those after it, each with the effects of the target whose turn it is."""
    return [(camera, targets[(draw + number) % len(targets)]) for number, camera in enumerate(cameras)]


def color_limits(targets: Iterable[Effects]) -> tuple[float, float] | None:
    """The least and the greatest coefficient of SH degree 0 that a file holds for each of these viewers; None if one of them limits none."""
    packings = [target.settings.packing for target in targets]
    return COLOR_LIMITS if all(packing is not None and packing.color is not None for packing in packings) else None


def unrounded(effects: Effects) -> Effects:
    """The effects without the rounding of a viewer's file and picture, which is noise to an optimizer step and a third of its time.

    The limits of a file's colors stay where these are all that is drawn: steps must not count on colors that the file cannot hold.
    """
    settings = effects.settings
    limited = settings.packing is not None and settings.packing.color is not None and effects.sh_degree == 0
    if limited and settings.max_color is None and settings.color_steps is None:
        settings = replace(settings, max_color=1.0)
    return replace(effects, settings=replace(settings, packing=None, picture_step=None))
