"""One splat in the middle of an image, as viewers draw it."""

import math
from dataclasses import replace

import pytest
import torch

from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.viewers import find_viewer

C0 = 0.28209479177387814
SIZE, FOCAL, DEPTH = 21, 100.0, 10.0  # px, px, world units: 0.1 world units are a pixel
MIDDLE = SIZE // 2
BACKENDS = [ReferenceBackend(), CpuBackend()]
BOTH = pytest.mark.parametrize("backend", BACKENDS, ids=["reference", "cpu"])


def camera() -> Camera:
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, torch.eye(4))


def splat(across: float, down: float, opacity: float = 0.9, color: float = 0.5, turn: float = 0.0, means=(0.0, 0.0, DEPTH)) -> Gaussians:
    """One gray splat of variances `across` and `down` px² at the center of the middle pixel, flat along the axis of view, turned by `turn`."""
    scales = torch.tensor([[math.sqrt(across), math.sqrt(down), 1e-6]]) * DEPTH / FOCAL
    quats = torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]])
    return Gaussians(torch.tensor([means]), quats, scales, torch.tensor([opacity]), torch.full((1, 1, 3), (color - 0.5) / C0))


def aside(halves: float) -> tuple[float, float, float]:
    """A center as many halves of the picture to the right of its middle."""
    return halves * SIZE / 2 * DEPTH / FOCAL, 0.0, DEPTH


def alpha(backend, viewer: str, splats: Gaussians) -> torch.Tensor:
    """[SIZE, SIZE] alpha under a viewer whose packing, which has tests of its own, is left out."""
    effects = find_viewer(viewer).effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, color_steps=None, picture_step=None))
    return backend.render(splats, camera(), effects).alpha


def differentiable(splats: Gaussians) -> tuple[dict[str, torch.Tensor], Gaussians]:
    leaves = {name: getattr(splats, name).clone().requires_grad_() for name in ("means", "quats", "scales", "opacities", "sh")}
    return leaves, Gaussians(**leaves)
