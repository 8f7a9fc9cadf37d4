"""The CPU backend: compiled float32 kernels with exact gradients; results are bit-identical for any number of threads."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, CachedCheck, Calls, Capabilities, Needs, Rendered, Stepper
from mipmap_plugin.backends.linear_light import in_linear_light
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable, brief, install
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process.torch_modes import opaque
from mipmap_plugin.screen_filters import INTEGRATED
from mipmap_plugin.splatting.buckets import ranks_of_views
from mipmap_plugin.splatting.packing import packed

NO_NUMBA = f"it needs numba, which some Pythons and processors have no wheels of; where there are, {install('cpu')}"
NO_FOLDER = "numba has no writable folder for compiled code; set the environment variable NUMBA_CACHE_DIR to one"
DISABLED = "the variable NUMBA_DISABLE_JIT keeps numba from compiling; unset it"
NO_THREADS = "the variable NUMBA_NUM_THREADS gives numba no threads; set it to 1 or more, or unset it"
REINSTALL = "install it anew, where there are wheels by pip install --force-reinstall numba, which brings all that it needs"

# Settings that kernels of screen filters that integrate do not read.
CUT_OFFS = {"min_alpha", "min_transmittance", "radius", "frame"}

# The position of the coefficients among the arguments of `_Draw.forward`.
SH = 5


class CpuBackend:
    """Renders and differentiates Gaussians on a CPU. numba is imported at the first request that it may serve, and compiles at the first image."""

    name = "cpu"
    api_version = API_VERSION
    speed = 10
    own_threads = True
    capabilities = Capabilities(
        devices=frozenset({"cpu"}),
        dtypes=frozenset({torch.float32}),
        screen_filters=frozenset({"classic", "antialiased", "mip", "analytic", "window"}),
        settings=frozenset(SETTINGS) - {"tile"},
    )

    def __init__(self) -> None:
        self._check = CachedCheck(self)

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        cut_off = needs.screen_filter in INTEGRATED and CUT_OFFS & set(needs.settings.changed())
        unsupported = [f"it draws the screen filter {needs.screen_filter} with the usual cut-offs only"] if cut_off else []
        return self.capabilities.lacking(needs) + unsupported or list(missing())

    @opaque
    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if numba is missing or the request is not supported."""
        if effects.settings.linear_light is not None:
            return in_linear_light(self.render, gaussians, camera, effects)
        return self._drawn(gaussians, [(camera, effects)])[0]

    @opaque
    def render_views(self, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[Rendered]:
        """Several views of the same splats, each with effects of its own, in one call. Raises as `render`."""
        if any(effects.settings.by_view for _, effects in shots):
            return [self.render(gaussians, camera, effects) for camera, effects in shots]
        return self._drawn(gaussians, shots)

    def stepper(self, raw: Mapping[str, Tensor]) -> Stepper:
        """What draws and moves splats of 3DGS by their contiguous raw parameters, as `AdamStep.raw`; without packing and linear light."""
        stepper: Stepper = _kernels("stepping").CpuStepper(raw, self._check.require, _ranks)
        return stepper

    def compile_ahead(self, gaussians: Gaussians, effects: Sequence[Effects], calls: Calls) -> None:
        """Start to compile the backward pass in another process, where that pays; the rest is compiled at its first call."""
        if calls.gradients and not missing():
            for each in effects:
                _kernels("ahead").start(gaussians.covariances is not None, each, merging=calls.merging)

    def _drawn(self, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[Rendered]:
        prepared = [self._prepared(gaussians, camera, effects) for camera, effects in shots]
        wanted = [(*shot, ranks) for shot, (_, ranks) in zip(shots, prepared, strict=True)]
        outputs = _Draw.apply(wanted, *prepared[0][0])  # type: ignore[no-untyped-call]  # torch's
        return [Rendered(image, alpha) for image, alpha in zip(outputs[::2], outputs[1::2], strict=True)]

    @torch.no_grad()
    def blend_weights(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor | None:
        """The sum of each splat's blend weights over the image, [N]; None for a screen filter over windows. Raises BackendUnavailable."""
        if effects.screen_filter == "window":
            return None
        tensors, ranks = self._prepared(gaussians, camera, effects)
        return torch.from_numpy(_kernels("weighing").weigh(_kernels("drawing").as_arrays(*tensors), camera, effects, ranks))

    def _prepared(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[tuple[Any, ...], Any]:
        """The tensors of the splats, packed as a viewer's file does, and their ranks, where they are sorted by buckets. Raises BackendUnavailable."""
        self._check.require(gaussians, effects)
        g = packed(gaussians, camera, effects.settings.packing)
        return (g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances), _ranks(gaussians, camera, effects)


def nearest_along(means: Tensor, *further: Tensor, reach: int, limits: tuple[float, float]) -> tuple[Tensor, Tensor] | None:
    """What `cpu_kernels.pairing.nearest_along` finds for float32 splats along a curve; None on another device, or without numba."""
    if not _has_kernels_for(means):
        return None
    nearest, least = _kernels("pairing").nearest_along(tuple(map(_array, (means, *further))), reach, *limits)
    return torch.from_numpy(nearest), torch.from_numpy(least)


def summed_areas(means: Tensor, shapes: Iterable[tuple[Tensor, float]], views: Sequence[Camera], near: float) -> Tensor | None:
    """The area (px² / π) of each float32 splat, for each of the `shapes`, summed over the views that it lies in front of: [shapes, N] float64.

    A shape is the `axes_of` all splats, and the variance (px²) that the image adds. None on another device, or without numba.
    """
    if not _has_kernels_for(means):
        return None
    areas = _kernels("looking").areas
    return torch.from_numpy(np.stack([areas(_array(means), _array(axes), views, near, variance) for axes, variance in shapes]))


def finest_pixels(means: Tensor, views: Sequence[Camera], near: float) -> tuple[Tensor, Tensor] | None:
    """What `cpu_kernels.looking.finest` finds for float32 means; None on another device, or without numba."""
    if not views or not _has_kernels_for(means):
        return None
    sizes, seeing = _kernels("looking").finest(_array(means), views, near)
    return torch.from_numpy(sizes), torch.from_numpy(seeing)


def _has_kernels_for(means: Tensor) -> bool:
    """Whether kernels can look at these splats. Where they do not load, torch does so: another backend may draw them."""
    return means.device.type == "cpu" and means.dtype == torch.float32 and not missing()


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _ranks(gaussians: Gaussians, camera: Camera, effects: Effects) -> Any:
    """`splatting.buckets.ranks_of_views`, of one; compiled for PlayCanvas's, in whose order many steps of a portable file are drawn."""
    if not effects.settings.bucketed:
        [found] = ranks_of_views(gaussians, [(camera, effects)])
        return None if found is None else found.numpy()
    return _kernels("bucketing").ranks(_array(gaussians.means), _array(gaussians.scales), camera)


@cache  # numba that failed to load is half loaded, and would fail in another way when tried again
def missing() -> list[str]:
    """What this machine lacks to run the backend, and what to do; empty if nothing. It imports numba."""
    if importlib.util.find_spec("numba") is None:
        return [NO_NUMBA]
    if os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        return [DISABLED]
    try:
        importlib.import_module("mipmap_plugin.backends.cpu_kernels.drawing")
    except Exception as error:  # numba built for another numpy, or without its compiler, may fail in any way
        failed = f"numba does not load: {type(error).__name__}: {brief(error).rstrip('.')}; {REINSTALL}"
        known = {"cannot cache": NO_FOLDER, "Number of threads": NO_THREADS}  # by what numba says
        return [next((remedy for words, remedy in known.items() if words in str(error)), failed)]
    return []


def _kernels(module: str) -> ModuleType:
    """A module of `cpu_kernels`, imported at use. Raises BackendUnavailable if the kernels do not load."""
    if reasons := missing():
        raise BackendUnavailable(f"backend 'cpu' cannot do this: {'; '.join(reasons)}")
    return importlib.import_module(f"mipmap_plugin.backends.cpu_kernels.{module}")


class _Draw(torch.autograd.Function):
    """The image and the alpha of each shot, one after the other."""

    @staticmethod
    def forward(ctx: Any, shots: Sequence[tuple[Camera, Effects, Any]], *tensors: Any) -> tuple[Tensor, ...]:
        drawing, gradients = _kernels("drawing"), any(ctx.needs_input_grad)
        ctx.kinds = {(tensors[-1] is not None, effects) for _, effects, _ in shots}
        if gradients:
            for kind in ctx.kinds:
                _kernels("ahead").start(*kind)
        ctx.splats = drawing.as_arrays(*tensors)
        ctx.drawings = drawing.draw(ctx.splats, [drawing.Shot(*shot) for shot in shots], gradients=gradients)
        ctx.save_for_backward(*tensors)
        return tuple(torch.from_numpy(output) for drawn in ctx.drawings for output in (drawn.image, drawn.alpha))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # read even where unused: torch raises an error here if one was modified in place
        arrays = [gradient.contiguous().numpy() for gradient in d_outputs]
        for kind in ctx.kinds:
            _kernels("ahead").wait(*kind)
        pairs = list(zip(arrays[::2], arrays[1::2], strict=True))
        grads = _kernels("drawing").draw_back(ctx.splats, ctx.drawings, pairs, harmonics=ctx.needs_input_grad[SH])
        # Gradients that are not wanted, and those of the shape that is not in use, are empty: None for torch.
        return None, *(torch.from_numpy(g) if t is not None and len(g) == len(t) else None for t, g in zip(tensors, grads, strict=True))
