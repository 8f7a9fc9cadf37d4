"""The choice between rendering views in parallel and one after the other."""

from __future__ import annotations

from torch import Tensor

from mipmap_plugin import threads
from mipmap_plugin.camera import Camera

# Splats plus pixels of a view. Larger views are rendered one after the other: the kernels' own threads are as fast there, and only one view
# needs memory at a time.
SMALL = 1 << 19


def max_threads(means: Tensor, camera: Camera) -> int:
    """The number of views to render in parallel, for splats with `means` [N, 3] and images of the size of `camera`'s."""
    small = means.device.type == "cpu" and len(means) + camera.width * camera.height <= SMALL
    return threads.for_views() if small else 1
