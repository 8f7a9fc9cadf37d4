"""A simulation of many jobs on many workers: how long all take, with jobs as long as measured, workers that die, and slow ones.

    python benchmarks/scheduler.py

Discrete events: a free worker takes the next job from the scheduler, which answers one request at a time. A worker that dies is replaced; its
job is begun again by the next free worker, from its last saved state where all see one disk, and anew where files are sent. Prints Markdown;
writes results/scheduler.md. The figures for 1000 workers in docs/scale.md are from here; no such number of workers has run.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parent / "results" / "scheduler.md"

# CPU seconds of a job at x1/4 for each million splats, and of whatever their number: `size.py`, whole runs of 300,000, by docs/scale.md.
PER_MILLION, FIXED = 440.0, 10.0

REPEATS = 20


@dataclass(frozen=True)
class Farm:
    """Workers, and what befalls them."""

    workers: int
    cores: int = 2  # of a worker; a job uses them as well as two were measured to be used
    efficiency: float = 0.85  # of the cores of a worker
    dispatch_s: float = 0.001  # of the scheduler, for each job
    hours_to_death: float = 24.0  # mean time, exponentially distributed
    replacement_s: float = 60.0  # until another worker takes the place of a dead one
    saved_every_s: float = 60.0  # what a death costs a job at most; infinite: all that was done
    slow_share: float = 0.02  # of the workers
    slowness: float = 3.0  # how many times longer a job takes there


@dataclass(frozen=True)
class Result:
    hours: float  # until the last job is done
    used: float  # share of all workers' time that went into work that counted, on a worker of the usual speed
    deaths: int


def durations(splats: float, tiles: int, farm: Farm, random: np.random.Generator) -> np.ndarray:
    """Seconds of each tile's job on a worker of the usual speed: tiles differ in what their views see, as scenes of one size do, by a quarter."""
    work = FIXED + PER_MILLION * splats / 1e6 / tiles
    spread = 0.25
    return work / (farm.cores * farm.efficiency) * random.lognormal(-(spread**2) / 2, spread, tiles)


def simulate(jobs: np.ndarray, farm: Farm, random: np.random.Generator) -> Result:
    """Do the jobs, the longest first, and return what came of it."""
    todo = [(-seconds, seconds) for seconds in jobs]  # by rank: what is left of a job that was interrupted keeps its rank
    heapq.heapify(todo)
    speeds = np.where(random.random(farm.workers) < farm.slow_share, 1 / farm.slowness, 1.0)
    number = itertools.count()
    events = [(0.0, next(number), worker, None) for worker in range(farm.workers)]  # (when a worker is free, order, worker, job that comes back)
    heapq.heapify(events)
    scheduler, last, deaths, waiting = 0.0, 0.0, 0, []
    while events:
        now, _, worker, returned = heapq.heappop(events)
        if returned is not None:
            heapq.heappush(todo, returned)
            while waiting:
                heapq.heappush(events, (now, next(number), waiting.pop(), None))
        if not todo:
            waiting.append(worker)
            continue
        rank, left = heapq.heappop(todo)
        scheduler = max(scheduler, now) + farm.dispatch_s
        needed, alive = left / speeds[worker], random.exponential(3600 * farm.hours_to_death)
        if alive < needed:
            deaths += 1
            saved = 0.0 if np.isinf(farm.saved_every_s) else alive // farm.saved_every_s * farm.saved_every_s * speeds[worker]
            speeds[worker] = 1.0 if random.random() >= farm.slow_share else 1 / farm.slowness
            heapq.heappush(events, (scheduler + alive + farm.replacement_s, next(number), worker, (rank, left - saved)))
        else:
            last = max(last, scheduler + needed)
            heapq.heappush(events, (scheduler + needed, next(number), worker, None))
    return Result(last / 3600, float(jobs.sum()) / (last * farm.workers), deaths)


def mean(splats: float, tiles: int, farm: Farm) -> Result:
    """The mean over several seeds."""
    found = []
    for seed in range(REPEATS):
        random = np.random.default_rng(seed)
        found.append(simulate(durations(splats, tiles, farm, random), farm, random))
    hours, used, deaths = zip(*((each.hours, each.used, each.deaths) for each in found), strict=True)
    return Result(float(np.mean(hours)), float(np.mean(used)), round(float(np.mean(deaths))))


def main() -> None:
    rows = []
    for name, splats in (("6 M", 6e6), ("50 M", 50e6), ("500 M", 500e6)):
        for workers, per_tile in itertools.product((1, 8, 500), (3e6, 1e6, 0.3e6)):
            tiles = max(1, round(splats / per_tile))
            usual = Farm(workers)
            farms = {
                "nothing goes wrong": replace(usual, hours_to_death=np.inf, slow_share=0.0),
                "as usual": usual,
                "spot": replace(usual, hours_to_death=2.0),
                "spot, files are sent": replace(usual, hours_to_death=2.0, saved_every_s=np.inf),
            }
            for what, farm in farms.items():
                result = mean(splats, tiles, farm)
                rows.append(f"| {name} | {2 * workers:,} | {tiles:,} | {what} | {result.hours:.2f} | {result.used:.0%} | {result.deaths} |")
    usual = Farm(500)
    job = f"{FIXED:g} s and {PER_MILLION:g} s of CPU time for each million splats (x1/4; docs/scale.md says where that is from)"
    life = f"lives for {usual.hours_to_death:g} h on average and is replaced after {usual.replacement_s:g} s"
    slow = f"{usual.slow_share:.0%} of them take {usual.slowness:g} times as long, the scheduler needs {1000 * usual.dispatch_s:g} ms a job"
    head = f"""# The scheduler, simulated

Made by `python benchmarks/scheduler.py`: discrete events, the mean of {REPEATS} seeds. A job takes {job},
{usual.cores} cores a worker at {usual.efficiency:.0%}, and tiles differ by a quarter. *As usual*: a worker {life}, {slow}.
*Spot*: a worker lives for 2 h. *Files are sent*: there is no common disk, so a job whose worker dies begins anew. *Used*: the share of the
cores' time that the work itself needed. No farm of this size has run.

| splats | cores | jobs | workers | hours | used | deaths |
|---|---|---|---|---|---|---|"""
    text = "\n".join([head, *rows, ""])
    RESULTS.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
