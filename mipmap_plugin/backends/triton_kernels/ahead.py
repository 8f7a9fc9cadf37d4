"""All kernels that a run will call, compiled side by side: each takes a second or more, and by itself is compiled when it is first called."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch

from mipmap_plugin.backends.base import Calls
from mipmap_plugin.backends.triton_kernels import BACK_BATCH, BATCH, NUMBERS_MOVED, PAIRS, WARPS, tile_for
from mipmap_plugin.backends.triton_kernels.adam import adam_kernel
from mipmap_plugin.backends.triton_kernels.binning import emit_kernel
from mipmap_plugin.backends.triton_kernels.colors_back import color_back_kernel
from mipmap_plugin.backends.triton_kernels.compositing import composite_kernel
from mipmap_plugin.backends.triton_kernels.compositing_back import composite_back_kernel
from mipmap_plugin.backends.triton_kernels.drawing import KernelSplats
from mipmap_plugin.backends.triton_kernels.projection import project_kernel
from mipmap_plugin.backends.triton_kernels.projection_back import project_back_kernel
from mipmap_plugin.backends.triton_kernels.rounding import round_kernel
from mipmap_plugin.backends.triton_kernels.views import Shot
from mipmap_plugin.backends.triton_kernels.weighing import weigh_kernel
from mipmap_plugin.process import threads

# What the arguments of kernels are, by name, where they are no arrays of float32. Integers are of 32 bits, whatever they are.
TYPES: dict[str, Any] = dict.fromkeys(("splat_ids", "owners", "boxes", "counts"), torch.int32)
TYPES |= dict.fromkeys(("tile_offsets", "places", "starts"), torch.int64) | {"tiles": torch.int16}
TYPES |= dict.fromkeys(("count", "pairs", "views", "further", "most_tiles", "most_pixels", "no_tile", "least_key"), 1)


class Launch(NamedTuple):
    """A kernel, and what it is compiled for."""

    kernel: Any
    constants: dict[str, Any]
    warps: int = 4

    def compile(self, device: torch.device) -> None:
        arguments = [TYPES.get(name, torch.float32) for name in self.kernel.arg_names if name not in self.constants]
        with torch.cuda.device(device):
            self.kernel.warmup(*arguments, grid=(1,), num_warps=self.warps, **self.constants)


def compile_ahead(splats: KernelSplats, shots: Sequence[Shot], calls: Calls) -> None:
    """Compile what draws such splats as each of the shots, on all threads.

    One kernel comes before the others: with the first Triton hashes itself and its compiler, which threads that begin together would each do.
    """
    different = {(launch.kernel.__name__, *launch.constants.items()): launch for launch in launches(splats, shots, calls)}
    *others, quick = different.values()
    quick.compile(splats.means.device)
    with ThreadPoolExecutor(threads.for_kernels()) as pool:
        list(pool.map(lambda launch: launch.compile(splats.means.device), others))


def launches(splats: KernelSplats, shots: Sequence[Shot], calls: Calls) -> Iterator[Launch]:
    """What the calls will launch, the slowest to compile first; some of it more than once."""
    tiles = sorted({tile_for(pixels) for pixels in calls.pixels})
    for shot in shots:
        shape = splats.constants([shot])
        viewer, moved = shape["VIEWER"], shape | {"RAW": calls.by_rows}
        if calls.gradients:
            yield from _differentiation(moved, tiles)
        for kind in (shape, moved) if calls.gradients else (shape,):
            yield from (Launch(project_kernel, {**kind, "TILE": tile}) for tile in tiles)
        for tile in tiles:
            of_tile = {"TILE": tile, "BATCH": BATCH}
            yield Launch(emit_kernel, {"TILE": tile, "BLOCK": PAIRS})
            yield Launch(composite_kernel, {**of_tile, "VIEWER": viewer}, WARPS)
            if calls.merging:
                yield Launch(weigh_kernel, {**of_tile, "DETERMINISTIC": False, "VIEWER": viewer}, WARPS)
            if shot.effects.settings.picture_step is not None:
                yield Launch(round_kernel, of_tile, WARPS)
    if calls.by_rows and calls.gradients:
        yield Launch(adam_kernel, {"BANDS": splats.sh.shape[1], "BLOCK": NUMBERS_MOVED})


def _differentiation(shape: dict[str, Any], tiles: Iterable[int]) -> Iterator[Launch]:
    def some(*names: str) -> dict[str, Any]:
        return {name: shape[name] for name in names}

    yield Launch(project_back_kernel, some("HAS_COVARIANCES", "RAW", "VIEWER", "BLOCK"))
    yield Launch(color_back_kernel, some("DEGREE", "BANDS", "VIEWER", "BLOCK"))
    for tile in tiles:
        yield Launch(composite_back_kernel, {"TILE": tile, "BATCH": BACK_BATCH[tile], "DETERMINISTIC": False, **some("VIEWER")}, WARPS)
