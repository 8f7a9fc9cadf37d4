"""The first backward pass is compiled in another process while this one compiles the forward pass, for a compiler uses one thread only.

The two share what they compile through numba's cache on disk.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import torch

from mipmap_plugin.backends.cpu_kernels import compositing_back, descending, drawing, layout, projection_back
from mipmap_plugin.backends.cpu_kernels.records import Frame, Limits, Lists
from mipmap_plugin.camera import ONE_PIXEL
from mipmap_plugin.effects import Effects
from mipmap_plugin.process import threads

COMMAND = "import pickle, sys; from mipmap_plugin.backends.cpu_kernels import ahead; ahead.compile_back(*pickle.load(sys.stdin.buffer))"


@cache
def start(has_covariances: bool, effects: Effects) -> subprocess.Popen[bytes] | None:
    """Start to compile the backward pass for splats and effects like these, once; None where that does not pay."""
    if _are_compiled() or min(threads.for_kernels(), os.cpu_count() or 1) < 2:
        return None
    process = subprocess.Popen([sys.executable, "-c", COMMAND], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert process.stdin is not None
    with suppress(BrokenPipeError), process.stdin as pipe:  # it has failed already
        pipe.write(pickle.dumps((has_covariances, effects)))
    return process


def wait(has_covariances: bool, effects: Effects) -> None:
    """Wait for what `start` started. If it failed, this process will compile."""
    process = start(has_covariances, effects)
    if process is not None:
        process.wait()


def _are_compiled() -> bool:
    """Whether the cache on disk has the two slowest kernels of the backward pass."""
    kernels = (compositing_back.composite_back, projection_back.project_back)
    return all(any(Path(kernel.stats.cache_path).glob(f"*.{kernel.py_func.__name__}-*.nbc")) for kernel in kernels)


def compile_back(has_covariances: bool, effects: Effects) -> None:
    """Compile the backward pass, of one splat that touches no tile."""
    covariances = torch.zeros(1, 3, 3) if has_covariances else None
    harmonics = torch.zeros(1, (effects.sh_degree + 1) ** 2, 3)
    splats = drawing.as_arrays(torch.zeros(1, 3), torch.zeros(1, 4), torch.zeros(1, 3), torch.zeros(1), harmonics, covariances)
    (view, flags), integers = drawing.view_of(ONE_PIXEL, effects, splats, gradients=True), np.zeros(0, np.int32)
    lists = Lists(np.zeros(1, np.int64), integers, *[np.zeros(0, np.int64)] * 2, np.zeros(2, np.int64), integers)
    pixel, picture = np.zeros((1, 1), np.float32), np.zeros((1, 1, 3), np.float32)
    table, frame = np.zeros((1, layout.SPLAT_FIELDS), np.float32), Frame(np.zeros(3, np.float32), pixel, pixel)
    drawn = drawing.Drawing(view, flags, Limits(0.0, 0.0, 0.0), table, lists, frame, picture, pixel)
    drawing.draw_back(splats, [drawn], [(picture, pixel)])
    descending.compile_step()
