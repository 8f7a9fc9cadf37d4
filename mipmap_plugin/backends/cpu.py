"""The CPU backend: compiled float32 kernels with exact gradients; results are bit-identical for any number of threads."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, Capabilities, Needs, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import INTEGRATED, Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting import buckets
from mipmap_plugin.splatting.packing import packed

NO_NUMBA = "it needs numba: pip install 'mipmap-plugin[cpu]'"

# The position of the coefficients among the arguments of `_Draw.forward`.
SH = 7


class CpuBackend:
    """Renders and differentiates Gaussians on a CPU. numba is imported, and the kernels are compiled, at the first image."""

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

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        missing = [] if importlib.util.find_spec("numba") else [NO_NUMBA]
        supported = {"max_color", "color_steps", "radial", "bucketed", "frozen_beyond", "packing"}
        changed = needs.screen_filter in INTEGRATED and set(needs.settings.changed()) - supported
        unsupported = [f"it draws the screen filter {needs.screen_filter} with the usual cut-offs only"] if changed else []
        return missing + self.capabilities.lacking(needs) + unsupported

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if numba is missing or the request is not supported."""
        tensors, ranks = self._prepared(gaussians, camera, effects)
        image, alpha = _Draw.apply(camera, effects, ranks, *tensors)  # type: ignore[no-untyped-call]  # torch's
        return Rendered(image, alpha)

    @torch.no_grad()
    def blend_weights(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor | None:
        """The sum of each splat's blend weights over the image, [N]; None for a screen filter over windows. Raises BackendUnavailable."""
        if effects.screen_filter == "window":
            return None
        tensors, ranks = self._prepared(gaussians, camera, effects)
        _drawing()  # reports what numba lacks
        from mipmap_plugin.backends.cpu_kernels import drawing, weighing

        return torch.from_numpy(weighing.weigh(drawing.as_arrays(*tensors), camera, effects, ranks))

    def _prepared(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[tuple[Any, ...], Any]:
        """The tensors of the splats, packed as a viewer's file does, and their ranks, where they are sorted by buckets. Raises BackendUnavailable."""
        if reasons := self.lacking(Needs.of(gaussians, effects, gradients=True)):
            raise BackendUnavailable(f"backend 'cpu' cannot do this: {'; '.join(reasons)}")
        packing = effects.settings.packing
        g = gaussians if packing is None else packed(gaussians, camera, packing)
        ranks = buckets.ranks(gaussians, camera).numpy() if effects.settings.bucketed else None
        return (g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances), ranks


def nearest_along(means: Tensor, *further: Tensor, reach: int, limits: tuple[float, float]) -> tuple[Tensor, Tensor] | None:
    """What `cpu_kernels.pairing.nearest_along` finds for float32 splats along a curve; None on another device, or without numba."""
    if means.device.type != "cpu" or means.dtype != torch.float32 or not importlib.util.find_spec("numba"):
        return None
    _drawing()  # reports what numba lacks
    from mipmap_plugin.backends.cpu_kernels import pairing

    arrays = tuple(tensor.contiguous().numpy() for tensor in (means, *further))
    nearest, least = pairing.nearest_along(arrays, reach, *limits)
    return torch.from_numpy(nearest), torch.from_numpy(least)


def _drawing() -> ModuleType:
    """The kernels. Imported at use, so that without numba this module can report what is missing."""
    try:
        from mipmap_plugin.backends.cpu_kernels import drawing
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        raise BackendUnavailable("numba has no writable folder for compiled code; set the environment variable NUMBA_CACHE_DIR to one") from error
    return drawing


def _ahead() -> ModuleType:
    from mipmap_plugin.backends.cpu_kernels import ahead

    return ahead


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Camera, effects: Effects, ranks: Any, *tensors: Any) -> tuple[Tensor, Tensor]:
        drawing, gradients = _drawing(), any(ctx.needs_input_grad)
        ctx.kind = tensors[-1] is not None, effects
        if gradients:
            _ahead().start(*ctx.kind)
        image, alpha, ctx.drawing = drawing.draw(drawing.as_arrays(*tensors), camera, effects, ranks, gradients=gradients)
        ctx.save_for_backward(*tensors)
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # read even where unused: torch raises an error here if one was modified in place
        d_outputs = d_image.contiguous().numpy(), d_alpha.contiguous().numpy()
        _ahead().wait(*ctx.kind)
        grads = _drawing().draw_back(ctx.drawing, *d_outputs, harmonics=ctx.needs_input_grad[SH])
        # Gradients that are not wanted, and those of the shape that is not in use, are empty: None for torch.
        pairs = zip(tensors, grads, strict=True)
        return None, None, None, *(torch.from_numpy(g) if t is not None and len(g) == len(t) else None for t, g in pairs)
