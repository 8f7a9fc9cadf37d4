"""The Triton backend: a CUDA rasterizer without a build step, for Triton comes with torch's CUDA wheels. Same image as the reference.

The kernels are also compiled for compute capability 7.5, 8.0 and 9.0, and run on tiny images in Triton's interpreter on a CPU, in
`tests/backends/test_triton_backend.py` and `tests/backends/test_triton_interpreted*.py`. The first run on a machine compiles them, and so does the
first for a viewer, whose settings are not the usual ones; what an adaptation needs is compiled side by side, on all of torch's threads, in 10 s.

A view whose lists of splats take too much memory is drawn in strips (`triton_kernels/lists.py`).

The gradients of a splat are summed by atomic additions, in the order in which tiles finish. With
`torch.use_deterministic_algorithms(True)` before an image is drawn they are summed in a fixed order, for 44 bytes of memory per (splat,
tile) pair; so are blend weights, for 4.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, CachedCheck, Calls, Capabilities, Needs, Rendered, Stepper
from mipmap_plugin.backends.external import NO_CUDA
from mipmap_plugin.backends.linear_light import in_linear_light
from mipmap_plugin.camera import ONE_PIXEL, Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import brief
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process.torch_modes import opaque
from mipmap_plugin.splatting.buckets import ranks_of_views
from mipmap_plugin.splatting.packing import packed

if TYPE_CHECKING:
    from mipmap_plugin.backends.triton_kernels.views import Shot

OLDEST = (3, 3)  # versions before it compile no tuples
OLDEST_GPU = (7, 0)  # compute capability: relaxed atomics, by which gradients are summed, begin with it
NO_TRITON = "it needs triton, which comes with torch's CUDA wheels: pip install triton"


def interpreted() -> bool:
    """Whether Triton interprets kernels on the CPU: slow, for tests."""
    return os.environ.get("TRITON_INTERPRET") == "1"


class TritonBackend:
    """Renders and differentiates Gaussians on a GPU. Triton is imported, and the kernels compiled, at the first image."""

    name = "triton"
    api_version = API_VERSION

    def __init__(self) -> None:
        self._check = CachedCheck(self)
        self.speed = -1 if interpreted() else 50
        self.capabilities = Capabilities(
            devices=frozenset({"cpu" if interpreted() else "cuda"}),
            dtypes=frozenset({torch.float32}),
            screen_filters=frozenset({"classic", "antialiased", "mip"}),
            settings=frozenset(SETTINGS) - {"tile"},
        )

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        return missing() + self.capabilities.lacking(needs)

    @opaque
    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if this backend cannot serve the request.

        The host synchronizes with the GPU once, for the number of (splat, tile) pairs, and not in the backward pass.
        """
        if effects.settings.linear_light is not None:
            return in_linear_light(self.render, gaussians, camera, effects)
        return self.render_views(gaussians, [(camera, effects)])[0]

    @opaque
    def render_views(self, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[Rendered]:
        """Several views of the same splats, each with effects of its own, by one launch of each kernel; of packed splats, which depend on the
        camera, one by one, and in linear light too. Raises as `render`."""
        if any(effects.settings.linear_light is not None for _, effects in shots):
            return [self.render(gaussians, camera, effects) for camera, effects in shots]
        outputs: list[Tensor] = []
        for tensors, together in self._prepared(gaussians, shots):
            outputs += _Draw.apply(together, torch.is_grad_enabled(), *tensors)  # type: ignore[no-untyped-call]  # torch's
        return [Rendered(image, alpha) for image, alpha in zip(outputs[::2], outputs[1::2], strict=True)]

    @torch.no_grad()
    def blend_weights(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
        """The sum of each splat's blend weights over the image, [N]. Raises as `render`."""
        return self.weigh_views(gaussians, [(camera, effects)])[0]

    @torch.no_grad()
    def weigh_views(self, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> Tensor:
        """The same for several views, [V, N]."""
        prepared = self._prepared(gaussians, shots)
        from mipmap_plugin.backends.triton_kernels import drawing

        with torch.cuda.device_of(gaussians.means):
            return torch.cat([drawing.weigh(drawing.KernelSplats.of(*tensors), together) for tensors, together in prepared])

    def _prepared(self, gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[tuple[tuple[Tensor | None, ...], list[Shot]]]:
        """The tensors of the splats, packed as a viewer's file does, and the views that are drawn of them at once. Raises BackendUnavailable."""
        for _, effects in shots:
            self._check.require(gaussians, effects)
        from mipmap_plugin.backends.triton_kernels.views import Shot

        ranked = [Shot(*shot, ranks) for shot, ranks in zip(shots, ranks_of_views(gaussians, shots), strict=True)]
        if all(effects.settings.packing is None for _, effects in shots):
            return [(_tensors(gaussians), ranked)]
        return [(_tensors(packed(gaussians, shot.camera, shot.effects.settings.packing)), [shot]) for shot in ranked]

    def compile_ahead(self, gaussians: Gaussians, effects: Sequence[Effects], calls: Calls) -> None:
        """Compile on all threads what draws such splats with any of the effects."""
        if not interpreted():
            from mipmap_plugin.backends.triton_kernels.ahead import compile_ahead
            from mipmap_plugin.backends.triton_kernels.drawing import KernelSplats
            from mipmap_plugin.backends.triton_kernels.views import Shot

            compile_ahead(KernelSplats.of(*_tensors(gaussians)), [Shot(ONE_PIXEL, each) for each in effects], calls)

    def stepper(self, raw: Mapping[str, Tensor]) -> Stepper:
        """What draws and moves splats of 3DGS by their contiguous raw parameters, as `AdamStep.raw`."""
        from mipmap_plugin.backends.triton_kernels.stepping import TritonStepper

        return TritonStepper(raw)


def _tensors(g: Gaussians) -> tuple[Tensor | None, ...]:
    return g.means, g.quats, g.scales, g.opacities, g.sh, g.covariances


def missing() -> list[str]:
    """What this machine lacks to run the backend; empty if nothing."""
    if importlib.util.find_spec("triton") is None:
        return [NO_TRITON]
    with suppress(PackageNotFoundError):  # other builds of triton have names of their own
        installed = version("triton")
        if tuple(int(part) for part in installed.split(".")[:2]) < OLDEST:
            return [f"it needs triton {'.'.join(map(str, OLDEST))} or newer, which comes with torch 2.7; {installed} is installed"]
    if interpreted():
        return []
    if not torch.cuda.is_available():
        return [NO_CUDA]
    major, minor = torch.cuda.get_device_capability()
    if (major, minor) < OLDEST_GPU:
        return [f"it needs a GPU of compute capability {'.'.join(map(str, OLDEST_GPU))} or more; this one has {major}.{minor}"]
    return unbuilt()


@cache
def unbuilt() -> list[str]:
    """Why Triton cannot build what launches kernels, which takes a C compiler, Python's headers and the driver's library; empty if it can."""
    try:
        importlib.import_module("triton.runtime").driver.active.get_current_target()  # built when first asked for
    except Exception as error:  # compilers, linkers and drivers fail in any way
        advice = "it takes a C compiler and Python's headers: install gcc and python3-dev"
        return [f"triton cannot build what launches its kernels ({brief(error)}); {advice}"]
    return []


class _Draw(torch.autograd.Function):
    """The image and the alpha of each shot, one after the other."""

    @staticmethod
    def forward(ctx: Any, shots: Sequence[Shot], in_graph: bool, *tensors: Tensor) -> tuple[Tensor, ...]:
        from mipmap_plugin.backends.triton_kernels import drawing

        with torch.cuda.device_of(tensors[0]):  # kernels are launched on the current GPU, which may be another
            drawn = drawing.draw(drawing.KernelSplats.of(*tensors), shots, gradients=in_graph and any(ctx.needs_input_grad))
            rounded = drawing.rounded(drawn)
        ctx.projected = drawn.projected
        ctx.save_for_backward(*tensors, drawn.images, drawn.transmittances)
        images, alphas = drawn.views_of(rounded), drawn.views_of(1 - drawn.transmittances)
        return tuple(output for pair in zip(images, alphas, strict=True) for output in pair)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor | None, ...]:
        from mipmap_plugin.backends.triton_kernels import drawing

        *tensors, images, transmittances = ctx.saved_tensors
        splats, drawn = drawing.KernelSplats.of(*tensors), drawing.Drawing(ctx.projected, images, transmittances)
        grads = splats.new_gradients()
        with torch.cuda.device_of(images):
            d_records = drawing.draw_back(drawn, drawn.packed(d_outputs[::2]), drawn.packed(d_outputs[1::2]))
            drawing.project_back(splats, drawn.projected, d_records, grads)
        return None, None, *grads[:-1]
