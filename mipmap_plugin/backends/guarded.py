"""Third-party backends behind a look at whether they keep their contract: what fails names its backend, and no wrong image passes for a right one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import AdamStep, Needs, Rendered, Stepper
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import PluginError, type_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.plugin_errors import naming, unchanged

# What a backend may have beside `lacking` and `render`.
OPTIONAL = ("render_views", "blend_weights", "weigh_views", "stepper", "compile_ahead")

# What a stepper has to have.
STEPS = ("render", "differentiate", "step")

# Beyond so much, and beyond so many times the brightest splat, an image has colors of another range.
BRIGHT = 4.0


class Guarded:
    """A backend whose images, gradients and weights are looked at. Raises PluginError for what is not as `backends.base` says."""

    def __init__(self, name: str, theirs: Any) -> None:
        self.theirs, self._title = theirs, f"backend {name!r}"

    def __getattr__(self, name: str) -> Any:
        """An attribute of the backend itself; what it may have beside `render` is looked at, too."""
        if name == "theirs" or name.startswith("__"):  # which copying asks an empty object for
            raise AttributeError(name)
        part = getattr(self.theirs, name)
        return partial(getattr(self, f"_{name}"), part) if name in OPTIONAL else part

    def unasked(self) -> None:
        """From now on messages say that nobody named this backend, and how to take another."""
        self._title += " (taken as the fastest; another is taken by --backend NAME, or backend=)"

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """See `base.Backend`."""
        return self._checked(self._call(self.theirs.render, _watched(self._title, gaussians), camera, effects), gaussians, camera, effects)

    def _call(self, theirs: Callable[..., Any], gaussians: Gaussians, *arguments: Any) -> Any:
        """What a method of the backend returns. Raises PluginError if it fails, or changes the splats."""
        with naming(self._title), unchanged(self._title, gaussians.tensors()):
            return theirs(gaussians, *arguments)

    def _checked(self, rendered: Any, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        image, wanted = getattr(rendered, "image", None), (*camera.size, 3)
        if not isinstance(rendered, Rendered) or not isinstance(image, Tensor) or tuple(image.shape) != wanted:
            thing = image if isinstance(rendered, Rendered) else rendered
            got = f"an image {list(image.shape)}" if isinstance(image, Tensor) else type_of(thing)
            raise PluginError(f"{self._title} has to return a Rendered with an image {list(wanted)}; it returned {got}")
        if image.dtype != gaussians.means.dtype:
            raise PluginError(f"{self._title} has to return images of the splats' type {gaussians.means.dtype}; it returned {image.dtype}")
        if image.device != gaussians.means.device:
            raise PluginError(f"{self._title} has to return images on the splats' device {gaussians.means.device}; it returned one on {image.device}")
        least, largest = torch.stack(image.detach().aminmax()).tolist()  # NaN if there is one; a GPU is waited for once
        if not (math.isfinite(least) and math.isfinite(largest)):
            view = f"{camera.name or 'a view'}, {camera.width} x {camera.height} px"
            raise PluginError(f"{self._title} returned an image with NaN or infinity, of {view}")
        self._check_colors(largest, gaussians, effects)
        return rendered.replaced(image=self._joined(image, gaussians, effects), alpha=partial(self._alpha, rendered, image))

    def _check_colors(self, largest: float, gaussians: Gaussians, effects: Effects) -> None:
        """Raise PluginError for colors far beyond those of the splats and the background, between which blending stays: of 0..255, for example."""
        if largest <= BRIGHT:  # as most images; to look at all splats takes a moment
            return
        most = max(*effects.background, 0.5 + float(gaussians.sh.detach().abs().sum(1).amax()) if len(gaussians) else 0.0)
        if largest > BRIGHT * most:
            own = f"those of the splats and the background are {most:.3g} at most"
            raise PluginError(f"{self._title} returned colors up to {largest:.3g}, where {own}; return 0..1, not 0..255")

    def _joined(self, image: Tensor, gaussians: Gaussians, effects: Effects) -> Tensor:
        """The image as a part of the gradient graph: one of nothing may come without gradients, which are 0. Raises PluginError for any other."""
        differentiable = [tensor for tensor in gaussians.tensors().values() if tensor.requires_grad] if torch.is_grad_enabled() else []
        if image.requires_grad or not differentiable or self.theirs.lacking(Needs.of(gaussians, effects, gradients=True)):
            return image
        if (image != image[:1, :1]).any():
            raise PluginError(f"{self._title} returned an image without gradients, and does not say in `lacking` that it has none")
        return image + differentiable[0][:0].sum()

    def _alpha(self, rendered: Rendered, image: Tensor) -> Tensor:
        with naming(self._title):
            alpha = rendered.alpha
        wanted = image.shape[:2]
        if not isinstance(alpha, Tensor) or alpha.shape != wanted:
            got = list(alpha.shape) if isinstance(alpha, Tensor) else type_of(alpha)
            raise PluginError(f"{self._title} has to return an alpha {list(wanted)}; it returned {got}")
        if (alpha.dtype, alpha.device) != (image.dtype, image.device):
            likewise = f"in {image.dtype} on {image.device}, as the image"
            raise PluginError(f"{self._title} has to return an alpha {likewise}; it returned one in {alpha.dtype} on {alpha.device}")
        return alpha

    def _render_views(self, theirs: Any, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[Rendered]:
        views = self._call(theirs, _watched(self._title, gaussians), shots)
        if not isinstance(views, (list, tuple)) or len(views) != len(shots):
            got = f"{len(views)}" if isinstance(views, (list, tuple)) else type_of(views)
            raise PluginError(f"{self._title}: render_views has to return a list of {len(shots)} Rendered, one for each view; it returned {got}")
        return [self._checked(view, gaussians, *shot) for view, shot in zip(views, shots, strict=True)]

    def _blend_weights(self, theirs: Any, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor | None:
        weights: Tensor | None = self._call(theirs, gaussians, camera, effects)
        if weights is not None and not _are_numbers(weights, len(gaussians)):
            raise PluginError(f"{self._title}: blend_weights has to return {len(gaussians)} finite numbers, one for each splat, or None")
        return weights

    def _weigh_views(self, theirs: Any, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> Tensor:
        weights: Tensor = self._call(theirs, gaussians, shots)
        wanted = len(shots), len(gaussians)
        if not _are_numbers(weights, *wanted):
            raise PluginError(f"{self._title}: weigh_views has to return finite numbers {list(wanted)}, one for each view and splat")
        return weights

    def _stepper(self, theirs: Any, raw: Mapping[str, Tensor]) -> _GuardedStepper:
        with naming(self._title):
            stepper = theirs(raw)
        if missing := [part for part in STEPS if not callable(getattr(stepper, part, None))]:
            raise PluginError(f"{self._title}: stepper has to return a Stepper; {type_of(stepper)}, which it returned, lacks {', '.join(missing)}")
        return _GuardedStepper(self._title, stepper)

    _compile_ahead = _call


class _GuardedStepper:
    """A stepper whose failures name its backend."""

    def __init__(self, title: str, theirs: Stepper) -> None:
        self._title, self._theirs = title, theirs

    def __getattr__(self, name: str) -> Any:
        """A method of the stepper itself, some of which it may lack."""
        if name.startswith("_"):  # which copying asks an empty object for
            raise AttributeError(name)
        return partial(self._named, getattr(self._theirs, name))

    def _named(self, theirs: Callable[..., Any], *arguments: Any) -> Any:
        with naming(self._title):
            return theirs(*arguments)

    def step(self, step: AdamStep) -> None:
        written = dict(step.raw)
        if step.means_gradient is not None:
            written["the gradient of the means"] = step.means_gradient.fill_(math.nan)  # for one that does not write it
        self._named(self._theirs.step, step)
        finite = torch.stack([tensor.isfinite().all() for tensor in written.values()]).tolist()  # a GPU is waited for once
        if wrong := [name for name, whole in zip(written, finite, strict=True) if not whole]:
            raise PluginError(f"{self._title}: a step left NaN or infinity in {', '.join(wrong)}")


def _are_numbers(thing: Any, *shape: int) -> bool:
    """Whether a thing is a tensor of this shape, of finite numbers."""
    return isinstance(thing, Tensor) and thing.shape == shape and bool(thing.isfinite().all())


def _watched(title: str, gaussians: Gaussians) -> Gaussians:
    """The same splats; a gradient that is not finite raises PluginError in the backward pass."""

    def watched(name: str, tensor: Tensor) -> Tensor:
        tensor = tensor.view_as(tensor)  # no leaf, which would keep the hook
        tensor.register_hook(partial(_refuse_gradient, title, name))
        return tensor

    if not torch.is_grad_enabled():
        return gaussians
    return replace(gaussians, **{name: watched(name, tensor) for name, tensor in gaussians.tensors().items() if tensor.requires_grad})


def _refuse_gradient(title: str, name: str, gradient: Tensor) -> None:
    if not gradient.isfinite().all():
        raise PluginError(f"{title} returned gradients with NaN or infinity for {name}")
