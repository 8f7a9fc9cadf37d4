"""The first backward pass is compiled in another process while this one compiles the forward pass, for a compiler uses one thread only.

The two share what they compile through numba's cache on disk. What merging calls is compiled by whichever comes to it first: the other
process compiles it in the reverse of the order in which an adaptation calls it, and so they meet.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Hashable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from mipmap_plugin.backends.cpu_kernels import compositing_back, descending, drawing, layout, looking, pairing, projection_back, weighing
from mipmap_plugin.backends.cpu_kernels.records import Frame, Limits, Lists, SplatArrays
from mipmap_plugin.camera import ONE_PIXEL
from mipmap_plugin.effects import Effects
from mipmap_plugin.process import threads

COMMAND = "import pickle, sys; from mipmap_plugin.backends.cpu_kernels import ahead; ahead.compile_back(*pickle.load(sys.stdin.buffer))"

# The processes, by what decides which machine code is needed.
_started: dict[Hashable, subprocess.Popen[bytes] | None] = {}


def start(has_covariances: bool, effects: Effects, *, merging: bool = False) -> subprocess.Popen[bytes] | None:
    """Start to compile the backward pass for splats and effects like these, once, and then what merging calls; None where that does not pay."""
    view, flags = drawing.view_of(ONE_PIXEL, effects, _splat(has_covariances, effects), gradients=True)
    kind = (flags, view.sampling)
    if kind not in _started:
        _started[kind] = _start(has_covariances, effects, merging)
    return _started[kind]


def _start(has_covariances: bool, effects: Effects, merging: bool) -> subprocess.Popen[bytes] | None:
    if _are_compiled() or min(threads.for_kernels(), os.cpu_count() or 1) < 2:
        return None
    process = subprocess.Popen([sys.executable, "-c", COMMAND], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert process.stdin is not None
    with suppress(OSError), process.stdin as pipe:  # it has failed already
        pipe.write(pickle.dumps((has_covariances, effects, merging)))
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


def compile_back(has_covariances: bool, effects: Effects, merging: bool) -> None:
    """Compile the backward pass, and what merging calls if it will be."""
    splats = _splat(has_covariances, effects)
    (view, flags), integers = drawing.view_of(ONE_PIXEL, effects, splats, gradients=True), np.zeros(0, np.int32)
    lists = Lists(np.zeros(1, np.int64), integers, *[np.zeros(0, np.int64)] * 2, np.zeros(2, np.int64), integers)
    pixel, picture = np.zeros((1, 1), np.float32), np.zeros((1, 1, 3), np.float32)
    table, frame = np.zeros((1, layout.SPLAT_FIELDS), np.float32), Frame(np.zeros(3, np.float32), pixel, pixel)
    drawn = drawing.Drawing(view, flags, Limits(0.0, 0.0, 0.0), table, lists, frame, picture, pixel)
    drawing.draw_back(splats, [drawn], [(picture, pixel)])
    descending.compile_step()
    if merging:
        compile_merging(has_covariances, replace(effects, sh_degree=0))


@cache
def _splat(has_covariances: bool, effects: Effects) -> SplatArrays:
    """A splat that touches no tile."""
    covariances = torch.zeros(1, 3, 3) if has_covariances else None
    harmonics = torch.zeros(1, (effects.sh_degree + 1) ** 2, 3)
    return drawing.as_arrays(torch.zeros(1, 3), torch.zeros(1, 4), torch.zeros(1, 3), torch.zeros(1), harmonics, covariances)


def compile_merging(has_covariances: bool, effects: Effects) -> None:
    """Compile what merging calls, the last first. effects: of degree 0, for blend weights need no colors."""
    splats = _splat(has_covariances, effects)
    means, ones, shapes = splats.means, splats.opacities, np.zeros((len(splats.means), 3, 3), np.float32)
    looking.areas(means, shapes, [ONE_PIXEL], near=0, variance=0)
    looking.finest(means, [ONE_PIXEL], near=0)
    pairing.nearest_along((means, shapes.astype(np.float64), means, ones, ones), reach=1, max_square=0, max_cost=0)
    weighing.weigh(splats, ONE_PIXEL, effects)
