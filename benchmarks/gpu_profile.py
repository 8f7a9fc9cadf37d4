"""Which kernels take the time of one image and its gradients, how well they fill the device, and the bytes that they have to move."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from gpu_records import Kernel, Profile
from gpu_speed import Case, Scene, passes, scene_of, title
from gpu_work import Work
from torch.profiler import ProfilerActivity, profile
from workloads import activated, effects_of

from mipmap_plugin.backends import get_backend

KERNELS = 8  # how many are listed
RUNS = 3
EXPECTED_S = 8.0

# What a trace calls that which runs on a GPU, and what it says of a kernel's launches.
ON_GPU = ("kernel", "gpu_memcpy", "gpu_memset")
OCCUPANCY, REGISTERS = "est. achieved occupancy %", "registers per thread"


def profile_one(name: str, case: Case, device: str, cases: Sequence[Case]) -> Iterator[Profile]:
    """One backend on one case, with classic dilation."""
    scene = scene_of(case, device, cases)
    spent = kernels(passes(get_backend(name), scene, "classic").forward_backward, least_bytes(scene) if name == "triton" else {})
    yield Profile(name, *case, round(sum(kernel.us for kernel in spent), 1), spent[:KERNELS])


def works(backends: Sequence[str], cases: Sequence[Case], device: str) -> list[Work]:
    """Every backend on every case."""
    cases = tuple(cases)
    return [Work("profiles", name, title(case), EXPECTED_S, profile_one, (name, case, device, cases)) for name in backends for case in cases]


def kernels(call: Callable[[], None], least: dict[str, int] | None = None) -> list[Kernel]:
    """Each kernel of a call, the slowest first; on a processor, which has none, nothing. least: bytes that kernels have to move."""
    call()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        for _ in range(RUNS):
            call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(file))
        return of_trace(json.loads(file.read_text())["traceEvents"], RUNS, least or {})


def of_trace(events: Sequence[dict[str, Any]], runs: int, least: dict[str, int]) -> list[Kernel]:
    """The kernels in the events of a trace of so many runs."""
    launches: dict[str, list[dict[str, Any]]] = {}
    for event in events:
        if event.get("cat") in ON_GPU:
            launches.setdefault(event["name"], []).append(event)
    return sorted((_of_launches(name, each, runs, least) for name, each in launches.items()), key=lambda kernel: -kernel.us)


def _of_launches(name: str, launches: Sequence[dict[str, Any]], runs: int, least: dict[str, int]) -> Kernel:
    us, facts = sum(launch["dur"] for launch in launches), [launch.get("args", {}) for launch in launches]
    known = [fact[OCCUPANCY] for fact in facts if OCCUPANCY in fact]
    occupancy = round(sum(known) / len(known), 1) if known else None
    return Kernel(name[:80], round(us / runs, 1), round(len(launches) / runs, 1), occupancy, facts[0].get(REGISTERS), least.get(name))


def least_bytes(scene: Scene) -> dict[str, int]:
    """Bytes that each kernel of triton has to read and write at least, if every list is read to its end."""
    from mipmap_plugin.backends.triton_kernels import RECORD
    from mipmap_plugin.backends.triton_kernels.drawing import KernelSplats, project
    from mipmap_plugin.backends.triton_kernels.views import Shot

    with torch.no_grad():
        g = activated(scene.raw)
        projected = project(KernelSplats.of(g.means, g.quats, g.scales, g.opacities, g.sh, None), [Shot(scene.camera, effects_of(g))])
    pairs = sum(len(part.listed) for part in projected.lists.parts())
    splats, pixels = len(g.means), scene.camera.width * scene.camera.height
    shape, colors, record = 4 * (3 + 4 + 3 + 1), 4 * g.sh[0].numel(), 4 * RECORD
    image = 4 * (3 + 1) * pixels
    return {
        "project_kernel": splats * (shape + colors + record + 4 * (1 + 4)),
        "emit_kernel": pairs * (4 + 2),
        "composite_kernel": pairs * record + image,
        "composite_back_kernel": pairs * (record + 4) + 2 * image + splats * record,
        "color_back_kernel": splats * (2 * colors + 3 * 12),
        "project_back_kernel": splats * (2 * shape + record),
    }
