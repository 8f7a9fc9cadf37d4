"""Conformance, speed and memory of every backend on a CUDA GPU, and the adaptation of real bases there, in the order of what is worth most.

    python benchmarks/gpu.py --data DATA                            # everything, in a quarter of an hour
    python benchmarks/gpu.py --data DATA --further                  # what an earlier run had no time for
    python benchmarks/gpu.py --part speed --splats 1000000 --size 1080p --backend triton --backend gsplat

Prints each figure, and saves all as <output>/<device>.md and .json as soon as it is there. Each piece is done in another process: what breaks
it, or takes too long, is a line of the results, and the next piece begins. Without a GPU it says so and ends with exit code 2.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gpu_adaptation
import gpu_conformance
import gpu_first_use
import gpu_profile
import gpu_speed
import gpu_views
import torch
import tyro
from gpu_records import Bandwidth, Failure
from gpu_results import Results, report
from gpu_speed import MODES, Case, Mode
from gpu_timing import copied_per_second
from gpu_work import DONE, Work, carry_out

from mipmap_plugin.backends import get_backend, survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.process.versions import versions

SizeName = Literal["800", "1080p", "4K"]
Part = Literal["conformance", "speed", "views", "profiles", "adaptation", "viewers"]

# The parts in their order, and the fraction of the time after which nothing of them is begun, as long as other parts wait.
UNTIL: dict[Part, float] = {"conformance": 0.2, "speed": 0.5, "views": 0.57, "profiles": 0.63, "adaptation": 0.88, "viewers": 1.0}
NEED_DATA = ("views", "adaptation", "viewers")

SIZES: dict[SizeName, tuple[int, int]] = {"800": (800, 800), "1080p": (1920, 1080), "4K": (3840, 2160)}  # px

# One for each number of splats: these come first, and are profiled.
FIRST: tuple[Case, ...] = ((1_000_000, 1920, 1080), (4_000_000, 3840, 2160), (100_000, 800, 800))
SPLATS = (100_000, 1_000_000, 4_000_000)

HARD_CASES_S = 60.0

NO_GPU = "benchmarks/gpu.py: torch sees no CUDA GPU here; run it on a machine that has one, with torch's CUDA build"


@dataclass(frozen=True)
class Request:
    """What is measured."""

    backends: Sequence[str]  # the most important first
    cases: Sequence[Case]
    modes: Sequence[Mode]
    data: Path | None
    runs: int
    processes: int
    ends: float  # of `time.monotonic`
    device: str
    parts: Sequence[Part]
    began: float


def main(
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    splats: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    size: tyro.conf.UseAppendAction[tuple[SizeName, ...]] = (),
    mode: tyro.conf.UseAppendAction[tuple[Mode, ...]] = (),
    part: tyro.conf.UseAppendAction[tuple[Part, ...]] = (),
    data: Path | None = None,
    output: Path = Path("benchmarks/results/gpu"),
    runs: int = 7,
    processes: int = 15,
    seconds: float = 840.0,
    further: bool = False,
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
        seconds: After which all has ended.
        further: Keep what is in the files, and measure only what is not.
    """
    began = time.monotonic()
    if not torch.cuda.is_available():
        print(NO_GPU, file=sys.stderr)
        raise SystemExit(2)
    able, reasons = served(backend, "cuda")
    cases = [(count, *SIZES[name]) for count in splats or SPLATS for name in size or SIZES]
    parts = part or tuple(UNTIL)
    request = Request(able, sorted(cases, key=_rank), mode or MODES, data, runs, processes, began + seconds, "cuda", parts, began)
    results = Results.of(facts(), output)
    results.begin(parts, further)
    for name, reason in reasons.items():
        results.add(Failure(name, "", reason))
    carry_on(request, results, output)
    print(report(results))


def carry_on(request: Request, results: Results, output: Path) -> None:
    """Do what is not done yet, and save each record as it comes."""
    if request.data is None:
        for name in (name for name in request.parts if name in NEED_DATA):
            results.add(Failure("", name, "no --data was given"))
    works = [work for work in plan(request) if work.part in request.parts and work.title not in results.done]
    for work, record in carry_out(works, request.began, request.ends, UNTIL):
        if record == DONE:
            results.done.append(work.title)
        else:
            results.add(record)
        results.save(output)
    results.save(output)


def plan(request: Request) -> list[Work]:
    """All pieces of work: what compares backends for all of them, the rest for the most important one and then for the others."""
    r, (first, *others) = request, request.backends
    profiled = [case for case in FIRST if case in r.cases]
    works = [_hard_cases(first, r), Work("speed", "", "copy", 5.0, bandwidth, (r.device,))]
    works += gpu_speed.works(r.backends, r.cases, r.device, r.runs, r.modes)
    works += gpu_views.works(r.data, r.backends, r.device, r.runs) if r.data else []
    works += gpu_profile.works(r.backends, profiled, r.device)
    for name in (first, *others):
        works += _adaptations(name, r, r.data) if r.data else []
    return [*works, *(_hard_cases(name, r) for name in others)]


def _hard_cases(name: str, r: Request) -> Work:
    return Work("conformance", name, "hard cases", HARD_CASES_S, gpu_conformance.check, (name, r.device, r.processes))


def _adaptations(name: str, r: Request, data: Path) -> list[Work]:
    place = gpu_adaptation.Place(data, name, r.device, r.ends)
    rows, for_viewers = gpu_adaptation.works(place, gpu_adaptation.ROWS), gpu_adaptation.works_for_viewers(place, gpu_adaptation.FOR_VIEWERS)
    return [*rows, *for_viewers, *gpu_first_use.works(name, data)]


def bandwidth(device: str) -> Iterator[Bandwidth]:
    """What a copy moves."""
    yield Bandwidth(copied_per_second(device))


def _rank(case: Case) -> int:
    """Those of `FIRST` come first; others in their order."""
    return FIRST.index(case) if case in FIRST else len(FIRST)


def served(wanted: Sequence[str], device: str) -> tuple[list[str], dict[str, str]]:
    """The backends that can be measured on `device`, the fastest first, and why the others cannot; the slow reference only where it is wanted."""
    found = survey(Needs(device, torch.float32, gradients=True, sh_degree=3, screen_filter="classic"))
    selected = {name: found.get(name, ["there is no such backend"]) for name in wanted or [name for name in found if name != "reference"]}
    able = [name for name, lacks in selected.items() if not lacks]
    ranked = able if wanted else sorted(able, key=lambda name: -get_backend(name).speed)
    return ranked, {name: "; ".join(lacks) for name, lacks in selected.items() if lacks}


def facts() -> dict[str, str | int | float]:
    """The device, and with what it was measured."""
    device = torch.cuda.get_device_properties(0)
    known = {"device": device.name, "memory_gib": round(device.total_memory / 2**30, 1), "compute_capability": f"{device.major}.{device.minor}"}
    return known | {"cuda": torch.version.cuda or "", "multiprocessors": device.multi_processor_count} | versions()


if __name__ == "__main__":
    tyro.cli(main)
