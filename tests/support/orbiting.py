"""Views of an orbit, as a base without cameras has them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.scenes.orbits import Orbit, sharp_size


def orbit(
    scene: Tensor | Gaussians, size: tuple[int, int], count: int, generator: torch.Generator, up: Sequence[float] | None = None
) -> list[Camera]:
    """`count` views of `size` (height, width) px around splats, or around their means alone; `up`: the vertical, as if it were guessed."""
    around = Orbit.around(scene.means, partial(sharp_size, scene)) if isinstance(scene, Gaussians) else Orbit.around(scene)
    return replace(around, up=around.up if up is None else tuple(up)).views(size, count, generator)
