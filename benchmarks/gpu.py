"""Speed, memory and conformance of every backend on a CUDA GPU, and the adaptation of real bases there.

    python benchmarks/gpu.py                                        # every backend, 0.1 to 4 million splats, 800 x 800 px to 4K
    python benchmarks/gpu.py --data DATA --splats 1000000 --size 1080p --backend triton --backend gsplat

Prints Markdown, and saves it with all figures as <output>/<device>.md and .json. Without a GPU it says so and ends with exit code 2.
"""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from gpu_adaptation import Adaptation, adaptations
from gpu_tables import Failure, Speed, conformance_table, report
from gpu_timing import Clock, copied_per_second
from scenes import Spec, make_to
from torch import Tensor
from workloads import activated, effects_of

from mipmap_plugin.adaptation.report import versions
from mipmap_plugin.backends import get_backend, survey
from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.backends.conformance import Outcome, check_backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.formats.atomic import write_json

SizeName = Literal["800", "1080p", "4K"]
SIZES: dict[SizeName, tuple[int, int]] = {"800": (800, 800), "1080p": (1920, 1080), "4K": (3840, 2160)}  # px
SPLATS = (100_000, 1_000_000, 4_000_000)
SPREAD = 0.47  # as in scenes A and C: about 44 splats reach a pixel, more where they are smaller than one

NO_GPU = "benchmarks/gpu.py: torch sees no CUDA GPU here; run it on a machine that has one, with torch's CUDA build"


@dataclass(frozen=True)
class Scene:
    """Raw parameters on a device, a view, and the gradient of a loss over its image."""

    raw: dict[str, Tensor]
    camera: Camera
    weights: Tensor  # [H, W, 3]

    @classmethod
    def of(cls, splats: int, width: int, height: int, device: str) -> Scene:
        generated = make_to(Spec(splats, width, height, SPREAD))
        raw = {name: torch.from_numpy(array).to(device).requires_grad_() for name, array in generated.raw.items()}
        return cls(raw, generated.camera, torch.from_numpy(generated.weights).to(device))

    @property
    def parameter_bytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self.raw.values())


def main(
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    splats: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    size: tyro.conf.UseAppendAction[tuple[SizeName, ...]] = (),
    data: Path | None = None,
    output: Path = Path("benchmarks/results/gpu"),
    runs: int = 20,
    conformance: bool = True,
) -> None:
    """Measure, print and save.

    Args:
        backend: A backend's name. May be repeated; by default every one that serves CUDA.
        splats: How many. May be repeated; by default 100000, 1000000 and 4000000.
        size: 800, 1080p or 4K. May be repeated; by default all.
        data: A folder with checkpoints/bases/<scene>_<px> and images/<scene>, to adapt real bases too.
        output: The folder of the results; the files are named after the device.
        runs: How many of each; the median counts.
        conformance: Run the conformance suite on each backend first.
    """
    if not torch.cuda.is_available():
        print(NO_GPU, file=sys.stderr)
        raise SystemExit(2)
    able, reasons = served(backend, "cuda")
    checked = {name: check_backend(get_backend(name), device="cuda") for name in able} if conformance else {}
    cases = [(count, *SIZES[name]) for count in splats or SPLATS for name in size or SIZES]
    bandwidth = copied_per_second("cuda")
    rows, failures = measure_all(able, cases, "cuda", runs)
    adapted = adaptations(data, able) if data else []
    save(output, facts(), bandwidth, rows, failures + [Failure(name, "", reason) for name, reason in reasons.items()], checked, adapted)


def served(wanted: Sequence[str], device: str) -> tuple[list[str], dict[str, str]]:
    """The backends that can be measured on `device`, and why the others cannot."""
    found = survey(Needs(device, torch.float32, gradients=True, sh_degree=3, screen_filter="classic"))
    selected = {name: found.get(name, ["there is no such backend"]) for name in wanted or found}
    return [name for name, lacks in selected.items() if not lacks], {name: "; ".join(lacks) for name, lacks in selected.items() if lacks}


def measure_all(backends: Sequence[str], cases: Sequence[tuple[int, int, int]], device: str, runs: int) -> tuple[list[Speed], list[Failure]]:
    """Every backend on every (splats, width, height). A failure of one, such as too little memory, does not end the others."""
    rows, failures = [], []
    for count, width, height in cases:
        scene = Scene.of(count, width, height, device)
        for name in backends:
            try:
                rows.append(measure(get_backend(name), scene, device, runs))
            except Exception as error:  # a kernel that does not compile, or memory that does not suffice, is a finding
                failures.append(Failure(name, f"{count:,} splats at {width} x {height} px", f"{type(error).__name__}: {error}".splitlines()[0]))
            gc.collect()
        del scene
    return rows, failures


def measure(backend: Backend, scene: Scene, device: str, runs: int) -> Speed:
    """Raw parameters -> image, without a graph; and -> image -> gradients of all of them."""
    clock, (height, width) = Clock(device), scene.camera.size

    def image() -> Tensor:
        gaussians = activated(scene.raw)
        return backend.render(gaussians, scene.camera, effects_of(gaussians)).image

    def forward() -> None:
        with torch.no_grad():
            image()

    def both() -> None:
        for leaf in scene.raw.values():
            leaf.grad = None
        (image() * scene.weights).sum().backward()

    both()  # compiles what is to be compiled
    peak = clock.peak_mib(both)
    forward_ms, both_ms = clock.milliseconds(forward, runs), clock.milliseconds(both, runs)
    parameters, pixels = scene.parameter_bytes, 4 * width * height
    # The least that has to move: parameters are read, image and alpha written; on the way back both are read again, gradients written.
    least = (parameters + 4 * pixels, 3 * parameters + 2 * 4 * pixels)
    count = len(scene.raw["means"])
    return Speed(backend.name, count, width, height, forward_ms, both_ms, peak, *least)


def facts() -> dict[str, str | int | float]:
    """The device, and with what it was measured."""
    device = torch.cuda.get_device_properties(0)
    known = {"device": device.name, "memory_gib": round(device.total_memory / 2**30, 1), "compute_capability": f"{device.major}.{device.minor}"}
    return known | {"cuda": torch.version.cuda or "", "multiprocessors": device.multi_processor_count} | versions()


def save(
    folder: Path,
    known: dict,
    bandwidth: float,
    rows: Sequence[Speed],
    failures: Sequence[Failure],
    checked: dict[str, list[Outcome]],
    adapted: Sequence[Adaptation],
) -> None:
    """Print the tables, and write them and the figures, named after the device."""
    text = report(known, bandwidth, rows, failures, adapted, conformance_table(checked))
    print(text)
    name = re.sub(r"\W+", "_", str(known["device"])).strip("_").lower()
    failed = {name: [outcome.case for outcome in outcomes if not outcome.passed] for name, outcomes in checked.items()}
    records = {"machine": known, "copied_bytes_per_second": bandwidth, "failed_cases": failed}
    lists = {"speed": rows, "not_measured": failures, "adaptation": adapted}
    write_json(folder / f"{name}.json", records | {key: [asdict(row) for row in entries] for key, entries in lists.items()}, overwrite=True)
    (folder / f"{name}.md").write_text(text + "\n")


if __name__ == "__main__":
    tyro.cli(main)
