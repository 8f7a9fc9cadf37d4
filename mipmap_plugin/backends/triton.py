"""A rasterizer for CUDA that needs no build: Triton kernels, which come with torch's CUDA wheels. Same image as the reference.

Never run on a GPU by its author: the kernels were compiled for compute capability 8.0, 9.0 and 7.5, and run in Triton's interpreter on a
processor, where they draw tiny images only (`tests/test_triton_backend.py`).

Gradients of a splat are added up by atomic additions, in whichever order the tiles finish. With
`torch.use_deterministic_algorithms(True)` they are added in one fixed order instead, for 36 bytes of memory a (splat, tile) pair.
"""

from __future__ import annotations

import importlib.util
import os

import torch
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.guests import NO_CUDA, UNTRIED, Asked
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

NO_TRITON = "it needs triton, which comes with torch's CUDA wheels: pip install triton"


def interpreted() -> bool:
    """Whether Triton runs its kernels in Python, on a processor: slow, for tests."""
    return os.environ.get("TRITON_INTERPRET") == "1"


class TritonBackend:
    """Renders and differentiates Gaussians on a GPU. Triton is imported, and the kernels compiled, at the first image."""

    name = "triton"
    api_version = API_VERSION
    note = UNTRIED

    def __init__(self) -> None:
        self._asked = Asked(self)
        self.speed = -1 if interpreted() else 30
        self.capabilities = Capabilities(
            devices=frozenset({"cpu" if interpreted() else "cuda"}),
            dtypes=frozenset({torch.float32}),
            screen_filters=frozenset({"classic", "antialiased", "mip"}),
        )

    def lacking(self, needs: Needs) -> list[str]:
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, where the request is not for this backend.

        The host waits for the GPU once, for the number of (splat, tile) pairs; on the way back it does not wait.
        """
        self._asked.refuse(Needs.of(gaussians, effects, gradients=True))
        g = gaussians
        image, alpha = _Draw.apply(camera, effects, g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances)
        return Rendered(image, alpha)


def missing() -> list[str]:
    """What this machine lacks, in sentences."""
    if importlib.util.find_spec("triton") is None:
        return [NO_TRITON]
    return [] if interpreted() or torch.cuda.is_available() else [NO_CUDA]


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, effects, *tensors):
        from mipmap_plugin.backends.triton_kernels import drawing

        with torch.cuda.device_of(tensors[0]):  # kernels are launched on the current GPU, which may be another
            image, through, ctx.drawing = drawing.draw(drawing.Splats.of(*tensors), camera, effects)
        ctx.save_for_backward(*tensors, image, through)
        return image, 1 - through

    @staticmethod
    @once_differentiable
    def backward(ctx, d_image, d_alpha):
        from mipmap_plugin.backends.triton_kernels import drawing

        *tensors, image, through = ctx.saved_tensors
        in_order = torch.are_deterministic_algorithms_enabled()
        with torch.cuda.device_of(image):
            grads = drawing.draw_back(ctx.drawing, drawing.Splats.of(*tensors), image, through, d_image, d_alpha, deterministic=in_order)
        return None, None, *grads
