"""Which views are small enough to be drawn side by side."""

from __future__ import annotations

from torch import Tensor

from mipmap_plugin import threads
from mipmap_plugin.camera import Camera

# Splats and pixels of a view. Larger ones are drawn one after the other: the kernels' own threads serve each as well, and need the memory
# of one.
SMALL = 1 << 19


def most_threads(means: Tensor, camera: Camera) -> int:
    """How many views of splats with `means` [N, 3], each the size of `camera`'s, are drawn at once."""
    small = means.device.type == "cpu" and len(means) + camera.width * camera.height <= SMALL
    return threads.count() if small else 1
