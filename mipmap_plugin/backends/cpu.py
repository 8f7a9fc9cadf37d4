"""The CPU backend: compiled kernels in float32, exact gradients, the same bytes at any number of threads."""

from __future__ import annotations

import importlib.util

import torch
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, Capabilities, Needs, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import INTEGRATED, Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting import buckets
from mipmap_plugin.splatting.packing import packed

NO_NUMBA = "it needs numba: pip install 'mipmap-plugin[cpu]'"


# Which of `_Draw.forward`'s arguments the coefficients are.
SH = 7


class CpuBackend:
    """Renders and differentiates Gaussians fast without a GPU. numba is imported, and the kernels compiled, at the first image."""

    name = "cpu"
    api_version = API_VERSION
    speed = 10
    capabilities = Capabilities(
        devices=frozenset({"cpu"}),
        dtypes=frozenset({torch.float32}),
        screen_filters=frozenset({"classic", "antialiased", "mip", "analytic", "window"}),
        settings=frozenset(SETTINGS) - {"tile"},
    )

    def lacking(self, needs: Needs) -> list[str]:
        missing = [] if importlib.util.find_spec("numba") else [NO_NUMBA]
        served = {"max_color", "color_steps", "radial", "bucketed", "frozen_beyond", "packing"}
        changed = needs.screen_filter in INTEGRATED and set(needs.settings.changed()) - served
        fixed = [f"it draws the screen filter {needs.screen_filter} with the usual cut-offs only"] if changed else []
        return missing + self.capabilities.lacking(needs) + fixed

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, when numba is missing or the request is not for this backend."""
        reasons = self.lacking(Needs.of(gaussians, effects, gradients=True))
        if reasons:
            raise BackendUnavailable(f"backend 'cpu' cannot do this: {'; '.join(reasons)}")
        packing = effects.settings.packing
        g = gaussians if packing is None else packed(gaussians, camera, packing)
        ranks = buckets.ranks(gaussians, camera).numpy() if effects.settings.bucketed else None
        image, alpha = _Draw.apply(camera, effects, ranks, g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances)
        return Rendered(image, alpha)


def _drawing():
    """The kernels. Imported at use: without numba this module still tells what is missing."""
    try:
        from mipmap_plugin.backends.cpu_kernels import drawing
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        raise BackendUnavailable("numba finds no folder to keep compiled code in: set NUMBA_CACHE_DIR to one that can be written") from error
    return drawing


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, effects, ranks, *tensors):
        drawing, differentiated = _drawing(), any(ctx.needs_input_grad)
        image, alpha, ctx.drawing = drawing.draw(drawing.splats_of(*tensors), camera, effects, ranks, gradients=differentiated)
        ctx.save_for_backward(*tensors)
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_image, d_alpha):
        tensors = ctx.saved_tensors  # asked for: that is where torch notices one that was changed since
        d_frame = d_image.contiguous().numpy(), d_alpha.contiguous().numpy()
        grads = _drawing().draw_back(ctx.drawing, *d_frame, harmonics=ctx.needs_input_grad[SH])
        # What nobody asks for, and of the two ways to give a shape the one that was not taken, has no gradient, and no rows.
        pairs = zip(tensors, grads, strict=True)
        return None, None, None, *(torch.from_numpy(g) if t is not None and len(g) == len(t) else None for t, g in pairs)
