"""The choice between rendering views in parallel, in one call, and one after the other, and of threads for torch and for rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.process import threads
from mipmap_plugin.splatting.camera_tensors import CameraTensors

Result = TypeVar("Result")

# Rows of a chunk for one thread of a processor: so few that even the rows of a small scene occupy all threads.
CHUNK = 1 << 12

# Rows times views that one operation computes on a processor: more do not fit into its caches, and fewer need more operations, which take longer.
ROWS_IN_CACHE = 1 << 14

# The same on a GPU, and pixels of the views that are drawn in one call: each takes up to half a kilobyte.
ROWS_OF_VIEWS = 1 << 21

# Splats plus pixels of a view. Larger views are rendered one after the other: the kernels' own threads are as fast there, and only one view
# needs memory at a time.
SMALL = 1 << 19

# Views that a step draws in one call, and their pixels: all of them are in memory until the step's gradients are known. A view's lists take a
# third of what a gradient of its splats takes, of which only one is needed then; more views at once gain nothing.
VIEWS_AT_ONCE, PIXELS_AT_ONCE = 4, 1 << 20

# Splats from which on torch's own threads pay off in what is done once a step: their parameters no longer fit into a cache.
LARGE_FOR_TORCH = 1 << 17


def max_threads(means: Tensor, camera: Camera) -> int:
    """The number of views to render in parallel, for splats with `means` [N, 3] and images of the size of `camera`'s."""
    small = means.device.type == "cpu" and len(means) + camera.width * camera.height <= SMALL
    return threads.for_views() if small else 1


def views_at_once(cameras: Iterable[Camera]) -> int:
    """The number of views that a step draws in one call, if none is larger than the largest of `cameras`."""
    return max(1, min(VIEWS_AT_ONCE, PIXELS_AT_ONCE // max(camera.width * camera.height for camera in cameras)))


def together(means: Tensor, cameras: Iterable[Camera]) -> int:
    """The number of views to draw in one call where nothing else is done meanwhile, if none is larger than the largest of `cameras`.

    On a processor one: there it takes no less time, and threads draw others at the same time (`max_threads`).
    """
    if means.device.type == "cpu":
        return 1
    return max(1, ROWS_OF_VIEWS // max(len(means), *(camera.width * camera.height for camera in cameras)))


def large_for_torch(means: Tensor) -> AbstractContextManager[None]:
    """Inside, torch has all threads if the splats with these `means` [N, 3] are many."""
    return threads.lent_to_torch() if means.device.type == "cpu" and len(means) >= LARGE_FOR_TORCH else nullcontext()


def in_chunks(function: Callable[[slice], Result], rows: Tensor) -> list[Result]:
    """`function(chunk)` for all chunks of the `rows`, in their order: computed in parallel on a processor, all rows at once elsewhere."""
    on_cpu, count = rows.device.type == "cpu", max(1, len(rows))
    size = CHUNK if on_cpu else count
    chunks = [slice(start, start + size) for start in range(0, count, size)]
    return list(threads.side_by_side(function, chunks, threads.for_views() if on_cpu else 1))


def in_batches(views: Sequence[Camera], rows: Tensor) -> Iterator[CameraTensors]:
    """All views, several at a time that look at the `rows` in one operation: few on a processor, whose caches are small, and many on a GPU."""
    most = ROWS_IN_CACHE if rows.device.type == "cpu" else ROWS_OF_VIEWS
    count = max(1, most // max(1, len(rows)))
    for start in range(0, len(views), count):
        yield CameraTensors.of(views[start : start + count], rows)
