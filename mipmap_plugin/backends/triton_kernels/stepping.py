"""Steps over the raw parameters of 3DGS (`backends.base.Stepper`): seven launches for all views of a step, without autograd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
import triton
from torch import Tensor

from mipmap_plugin.backends.base import AdamStep, Rendered
from mipmap_plugin.backends.triton_kernels import NUMBERS_MOVED
from mipmap_plugin.backends.triton_kernels.adam import adam_kernel
from mipmap_plugin.backends.triton_kernels.drawing import Drawing, KernelSplats, draw, draw_back, project_back, rounded
from mipmap_plugin.backends.triton_kernels.hashing import hash_in_order
from mipmap_plugin.backends.triton_kernels.views import Shot
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.buckets import ranks_of_views

hash_in_order(adam_kernel)

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")
RATES = ("means", "quats", "scales", "opacities", "sh0", "shN")  # as `adam.py` reads them


class TritonStepper:
    """Draws splats from their raw parameters, and moves these."""

    def __init__(self, raw: Mapping[str, Tensor]) -> None:
        self._splats = KernelSplats(*(raw[name] for name in PARAMETERS), covariances=None, raw=True)
        self._grads = self._splats.new_gradients()
        self._drawn: dict[int, Drawing] = {}  # by the number of its first view
        self._gradients: dict[int, Tensor] = {}  # of the records

    def render(self, number: int, camera: Camera, effects: Effects) -> Rendered:
        return self.render_all([(camera, effects)], number)[0]

    def render_all(self, shots: Sequence[tuple[Camera, Effects]], number: int = 0) -> list[Rendered]:
        with torch.cuda.device_of(self._splats.means):
            drawn = self._drawn[number] = draw(self._splats, self._ranked(shots))
            images = rounded(drawn)
        return [Rendered(image, partial(drawn.alpha_of, view)) for view, image in enumerate(drawn.views_of(images))]

    def _ranked(self, shots: Sequence[tuple[Camera, Effects]]) -> list[Shot]:
        """The shots, with the order of the splats where it is that of buckets."""
        if not any(effects.settings.bucketed or effects.settings.even_buckets for _, effects in shots):
            return [Shot(*shot) for shot in shots]
        splats = self._splats
        activated = Gaussians(splats.means, splats.quats, splats.scales.exp(), splats.opacities.sigmoid(), splats.sh)
        return [Shot(*shot, ranks) for shot, ranks in zip(shots, ranks_of_views(activated, shots), strict=True)]

    def differentiate(self, number: int, d_image: Tensor, d_alpha: Tensor | None = None) -> None:
        self.differentiate_all([d_image], None if d_alpha is None else [d_alpha], number)

    def differentiate_all(self, d_images: Sequence[Tensor], d_alphas: Sequence[Tensor] | None = None, number: int = 0) -> None:
        drawn = self._drawn[number]
        d_alpha = torch.zeros_like(drawn.transmittances) if d_alphas is None else drawn.packed(d_alphas)
        with torch.cuda.device_of(d_alpha):
            self._gradients[number] = draw_back(drawn, drawn.packed(d_images), d_alpha)

    def step(self, step: AdamStep) -> None:
        if not self._gradients:
            raise RuntimeError("a step needs the gradient of an image; call differentiate() first")
        with torch.cuda.device_of(self._splats.means):
            for nth, number in enumerate(sorted(self._gradients)):
                project_back(self._splats, self._drawn[number].projected, self._gradients[number], self._grads, further=nth > 0)
            self._move(step)
            if step.means_gradient is not None:
                step.means_gradient.copy_(self._grads.means)
        self._drawn.clear()
        self._gradients.clear()

    def _move(self, step: AdamStep) -> None:
        (beta1, beta2), means = step.betas, self._splats.means
        shared = 1 - beta1, 1 - beta2, (1 - beta1) * step.nesterov, step.correction, step.eps
        numbers = torch.tensor([*(step.rates[name] for name in RATES), *shared], dtype=means.dtype).to(means.device, non_blocking=True)
        arrays = [array for name in PARAMETERS for array in (step.raw[name], step.first[name], step.second[name], getattr(self._grads, name))]
        most = max(self._splats.sh.numel(), self._splats.quats.numel())  # colors of one band have fewer numbers than quaternions
        grid = triton.cdiv(most, NUMBERS_MOVED), len(PARAMETERS)
        adam_kernel[grid](*arrays, numbers, len(means), BANDS=self._splats.sh.shape[1], BLOCK=NUMBERS_MOVED)
