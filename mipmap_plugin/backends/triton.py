"""The Triton backend: a CUDA rasterizer without a build step, for Triton comes with torch's CUDA wheels. Same image as the reference.

Not tested on a GPU by its author: the kernels were compiled for compute capability 8.0, 9.0 and 7.5, and run on tiny images in
Triton's interpreter on a CPU (`tests/test_triton_backend.py`, `tests/test_triton_interpreted.py`).

The gradients of a splat are summed by atomic additions, in the order in which tiles finish. With
`torch.use_deterministic_algorithms(True)` they are summed in a fixed order, for 36 bytes of memory per (splat, tile) pair.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.external import NO_CUDA, UNTESTED, CachedCheck
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

NO_TRITON = "it needs triton, which comes with torch's CUDA wheels: pip install triton"


def interpreted() -> bool:
    """Whether Triton interprets kernels on the CPU: slow, for tests."""
    return os.environ.get("TRITON_INTERPRET") == "1"


class TritonBackend:
    """Renders and differentiates Gaussians on a GPU. Triton is imported, and the kernels compiled, at the first image."""

    name = "triton"
    api_version = API_VERSION
    note = UNTESTED

    def __init__(self) -> None:
        self._check = CachedCheck(self)
        self.speed = -1 if interpreted() else 30
        self.capabilities = Capabilities(
            devices=frozenset({"cpu" if interpreted() else "cuda"}),
            dtypes=frozenset({torch.float32}),
            screen_filters=frozenset({"classic", "antialiased", "mip"}),
        )

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if this backend cannot serve the request.

        The host synchronizes with the GPU once, for the number of (splat, tile) pairs, and not in the backward pass.
        """
        self._check.require(Needs.of(gaussians, effects, gradients=True))
        g = gaussians
        image, alpha = _Draw.apply(camera, effects, g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances)  # type: ignore[no-untyped-call]  # torch's
        return Rendered(image, alpha)


def missing() -> list[str]:
    """What this machine lacks to run the backend; empty if nothing."""
    if importlib.util.find_spec("triton") is None:
        return [NO_TRITON]
    return [] if interpreted() or torch.cuda.is_available() else [NO_CUDA]


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Camera, effects: Effects, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        from mipmap_plugin.backends.triton_kernels import drawing

        with torch.cuda.device_of(tensors[0]):  # kernels are launched on the current GPU, which may be another
            image, transmittance, ctx.drawing = drawing.draw(drawing.KernelSplats.of(*tensors), camera, effects)
        ctx.save_for_backward(*tensors, image, transmittance)
        return image, 1 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Tensor | None, ...]:
        from mipmap_plugin.backends.triton_kernels import drawing

        *tensors, image, transmittance = ctx.saved_tensors
        in_order = torch.are_deterministic_algorithms_enabled()
        with torch.cuda.device_of(image):
            splats = drawing.KernelSplats.of(*tensors)
            grads = drawing.draw_back(ctx.drawing, splats, image, transmittance, d_image, d_alpha, deterministic=in_order)
        return None, None, *grads
