"""Speed, memory and conformance of every backend on a CUDA GPU, and the adaptation of real bases there.

    python benchmarks/gpu.py                                        # every backend, 0.1 to 4 million splats, 800 x 800 px to 4K
    python benchmarks/gpu.py --data DATA --splats 1000000 --size 1080p --backend triton --backend gsplat
    python benchmarks/gpu.py --part conformance --processes 12

Prints Markdown, and saves it with all figures as <output>/<device>.md and .json after each part; parts that are not measured again are kept.
Without a GPU it says so and ends with exit code 2.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from gpu_adaptation import BASES, Adaptation, Base, of_base
from gpu_conformance import check_all
from gpu_profile import profiles
from gpu_results import Results
from gpu_speed import MODES, Case, Mode, Scene, measure, measure_all
from gpu_tables import Failure, report
from gpu_timing import copied_per_second
from gpu_views import measure_views

from mipmap_plugin.adaptation.report import versions
from mipmap_plugin.backends import survey
from mipmap_plugin.backends.base import Needs

__all__ = ["Scene", "measure"]

SizeName = Literal["800", "1080p", "4K"]
Part = Literal["conformance", "speed", "views", "profiles", "adaptation"]
PARTS: tuple[Part, ...] = ("conformance", "speed", "views", "profiles", "adaptation")
SIZES: dict[SizeName, tuple[int, int]] = {"800": (800, 800), "1080p": (1920, 1080), "4K": (3840, 2160)}  # px
SPLATS = (100_000, 1_000_000, 4_000_000)

# One for each number of splats.
PROFILED: tuple[Case, ...] = ((100_000, 800, 800), (1_000_000, 1920, 1080), (4_000_000, 3840, 2160))

NO_GPU = "benchmarks/gpu.py: torch sees no CUDA GPU here; run it on a machine that has one, with torch's CUDA build"


@dataclass(frozen=True)
class Request:
    """What is measured."""

    backends: Sequence[str]
    cases: Sequence[Case]
    modes: Sequence[Mode]
    data: Path | None
    runs: int
    processes: int
    ends: float  # of `time.monotonic`, after which nothing is begun
    device: str = "cuda"


def main(
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    splats: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    size: tyro.conf.UseAppendAction[tuple[SizeName, ...]] = (),
    mode: tyro.conf.UseAppendAction[tuple[Mode, ...]] = (),
    part: tyro.conf.UseAppendAction[tuple[Part, ...]] = (),
    data: Path | None = None,
    output: Path = Path("benchmarks/results/gpu"),
    runs: int = 7,
    processes: int = 4,
    seconds: float = 600.0,
) -> None:
    """Measure, print and save.

    Args:
        backend: A backend's name. May be repeated; by default every one that serves CUDA.
        splats: How many. May be repeated; by default 100000, 1000000 and 4000000.
        size: 800, 1080p or 4K. May be repeated; by default all.
        mode: The viewer whose filter is drawn. May be repeated; by default all.
        part: What is measured. May be repeated; by default everything.
        data: A folder with checkpoints/bases/<scene>_<px> and images/<scene>, to draw and adapt real bases too.
        output: The folder of the results; the files are named after the device.
        runs: How many of each; the median counts.
        processes: That share the hard cases.
        seconds: After which nothing more is begun.
    """
    if not torch.cuda.is_available():
        print(NO_GPU, file=sys.stderr)
        raise SystemExit(2)
    ends = time.monotonic() + seconds
    able, reasons = served(backend, "cuda")
    results = Results.of(facts(), output)
    results.failures = [Failure(name, "", reason) for name, reason in reasons.items()]
    cases = [(count, *SIZES[name]) for count in splats or SPLATS for name in size or SIZES]
    request = Request(able, cases, mode or MODES, data, runs, processes, ends)
    for each in part or PARTS:
        setattr(results, each, [])
        for record in measured(each, request, results):
            results.add(record)
            results.save(output)
    results.save(output)
    print(report(results))


def measured(part: Part, request: Request, results: Results) -> Iterator[Any]:
    """The records of one part, as they come."""
    r = request
    if part == "conformance":
        yield from check_all(r.backends, r.device, r.processes)
    elif part == "speed":
        results.bandwidth = copied_per_second(r.device)
        yield from measure_all(r.backends, r.cases, r.device, r.runs, r.modes)
    elif part == "profiles":
        yield from profiles(r.backends, [case for case in PROFILED if case in r.cases], r.device)
    elif r.data is None:
        yield Failure("", part, "no --data was given")
    elif part == "views":
        yield from measure_views(r.data, r.backends, r.device, r.runs)
    else:
        yield from adaptations(r, r.data)


def adaptations(request: Request, data: Path, bases: Sequence[Base] = BASES, **settings: Any) -> Iterator[Adaptation | Failure]:
    """Every base of `data` that is there by the first backend, then by the next. `settings` override the recipe's."""
    there = [base for base in bases if (data / base.path).is_dir()]
    for backend, base in product(request.backends, there):
        if time.monotonic() > request.ends:
            yield Failure(backend, base.title, "no time was left")
            continue
        try:
            for row in of_base(base, data, backend, request.device, **settings):
                yield row
                if time.monotonic() > request.ends and row.scale != base.scales[-1]:
                    yield Failure(backend, f"{base.title} after x{row.scale:g}", "no time was left")
                    break
        except Exception as error:  # as in `gpu_speed.py`
            yield Failure.of(backend, base.title, error)


def served(wanted: Sequence[str], device: str) -> tuple[list[str], dict[str, str]]:
    """The backends that can be measured on `device`, and why the others cannot; the reference, which is slow, only where it is wanted."""
    found = survey(Needs(device, torch.float32, gradients=True, sh_degree=3, screen_filter="classic"))
    selected = {name: found.get(name, ["there is no such backend"]) for name in wanted or [name for name in found if name != "reference"]}
    return [name for name, lacks in selected.items() if not lacks], {name: "; ".join(lacks) for name, lacks in selected.items() if lacks}


def facts() -> dict[str, str | int | float]:
    """The device, and with what it was measured."""
    device = torch.cuda.get_device_properties(0)
    known = {"device": device.name, "memory_gib": round(device.total_memory / 2**30, 1), "compute_capability": f"{device.major}.{device.minor}"}
    return known | {"cuda": torch.version.cuda or "", "multiprocessors": device.multi_processor_count} | versions()


if __name__ == "__main__":
    tyro.cli(main)
