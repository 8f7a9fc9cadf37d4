"""What more cores would bring, on paper: one thread computes an adaptation, and each piece that threads share is put on the clock of one of them.

    python benchmarks/cores.py DATA
    python benchmarks/cores.py DATA --splats 1000000 --cores 8

DATA holds `checkpoints/bases/lego_200` and `checkpoints/flowers_r8`. Kernels' chunks go to threads as `cpu_kernels.threads` gives them out, views
side by side to the thread that is free first. Seconds are CPU time of a thread, so that other programs hardly matter; that cores share their memory
is not counted, nor the start of a process. Writes cores.json and cores.md.
"""

from __future__ import annotations

import heapq
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import tyro
from rows import write_table
from size import stand_in

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.optimization.quickest import QuickestThreads
from mipmap_plugin.backends.cpu_kernels.threads import LEAST_ROWS, Team
from mipmap_plugin.process import threads
from mipmap_plugin.wrap import Wrapped

HERE = Path(__file__).parents[1]

# Seconds: until a call of a kernel lets another thread begin one, and until a waiting thread begins (both measured on an AMD EPYC).
CALL, WAKE = 10e-6, 60e-6

INTRO = """# What more cores would bring

Made by `python benchmarks/cores.py DATA`: seconds of `adapt` (`default`), on paper: one thread computed everything, and each piece that threads
share was put on the clock of one of them. The first number lets all threads run torch and Python at the same time, the second one of them at a
time; the truth should lie between, as torch lets others run and Python does not. *Alone*: what is neither in kernels nor in views side by side.
Without the start of a process (about a second).
"""
HEAD = ("scene", "scale", "splats", "cores", "seconds", "times as fast", "alone")


@dataclass
class Counted:
    """An adaptation on so many cores."""

    scene: str
    scale: str
    splats: int
    cores: int
    least: float  # seconds, if all threads can run torch and Python at the same time
    most: float  # seconds, if one of them can
    one: float  # seconds on one core
    alone: float

    def cells(self) -> list[str]:
        scene = [self.scene, f"x{self.scale}", f"{self.splats:,}", str(self.cores)]
        if self.cores == 1:
            return [*scene, f"{self.one:.1f}", "1", ""]
        times = f"{self.one / self.least:.1f}, {self.one / self.most:.1f}"
        return [*scene, f"{self.least:.1f}, {self.most:.1f}", times, f"{self.alone:.1f}"]


class Paper:
    """The time that passes while one thread computes what several would share."""

    def __init__(self) -> None:
        self._saved = 0.0  # seconds that others compute meanwhile
        self._in_kernels = 0.0  # seconds of the time so far
        self._together = 0.0  # seconds in kernels and in views side by side
        self._waited = 0.0  # seconds more, if one thread at a time can run torch and Python
        self._depth = 0  # of views side by side

    def now(self) -> float:
        return time.thread_time() - self._saved

    def _pass(self, computed: float, passes: float) -> None:
        """So many seconds of one thread take so long."""
        self._saved += computed - passes

    def share_all(self, team: Team, kernel: Callable[..., None], jobs: Sequence[tuple[int, tuple[Any, ...]]], *, of_rows: bool = False) -> None:
        """`Team.share_all`, one chunk after the other."""
        began = self.now()
        if team.threads == 1:
            for count, arguments in jobs:
                kernel(0, count, *arguments)
        elif jobs:
            self._schedule(team, kernel, jobs, LEAST_ROWS if of_rows else 1)
        self._in_kernels += self.now() - began
        if not self._depth:
            self._together += self.now() - began

    def _schedule(self, team: Team, kernel: Callable[..., None], jobs: Sequence[tuple[int, tuple[Any, ...]]], least: int) -> None:
        queues = [deque(team._ranges(thread, [count for count, _ in jobs], least)) for thread in range(team.threads)]
        free = [(WAKE if thread else 0.0, thread) for thread in range(team.threads)]
        computed = ends = next_call = 0.0
        while free:
            at, thread = heapq.heappop(free)
            own = queues[thread]
            queue = own or next((other for other in queues[thread:] + queues[:thread] if other), None)
            if queue is None:
                ends = max(ends, at)
                continue
            job, start, stop = own.popleft() if own else queue.pop()
            begun, at = time.thread_time(), max(at, next_call)
            kernel(start, stop, *jobs[job][1])
            takes, next_call = time.thread_time() - begun, at + CALL
            computed += takes
            heapq.heappush(free, (at + max(takes, CALL), thread))
        self._pass(computed, ends)

    def side_by_side(self, function: Callable[[Any], Any], items: Sequence[Any], count: int) -> Iterator[Any]:
        """`threads.side_by_side`, one item after the other."""
        count = min(count, len(items))
        if count <= 1:
            yield from map(function, items)
            return
        began, results, clocks, python = self.now(), [], [0.0] * count, 0.0
        each = threads._shared.set(max(1, threads.for_kernels() // count))
        self._depth += 1
        for item in items:
            before, kernels = self.now(), self._in_kernels
            results.append(function(item))
            takes = self.now() - before
            python += takes - (self._in_kernels - kernels)
            heapq.heapreplace(clocks, clocks[0] + takes)
        self._depth -= 1
        threads._shared.reset(each)
        self._pass(self.now() - began, max(clocks))
        if not self._depth:
            self._together += max(clocks)
            self._waited += max(0.0, python - max(clocks))
        yield from results

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Inside, threads are on paper only."""
        original = threads.side_by_side
        users = [module for module in list(sys.modules.values()) if getattr(module, "side_by_side", None) is original]
        for module in users:
            module.side_by_side = self.side_by_side  # type: ignore[attr-defined]
        share = lambda team, kernel, jobs, *, of_rows=False: self.share_all(team, kernel, jobs, of_rows=of_rows)  # noqa: E731
        patches = patch.object(Team, "share_all", share), patch.object(threads, "_torch_threads", lambda count: nullcontext())
        try:
            with patches[0], patches[1], patch.object(QuickestThreads, "step", lambda self, views, costs: nullcontext()):
                yield
        finally:
            for module in users:
                module.side_by_side = original  # type: ignore[attr-defined]

    def count(self, base: Wrapped, scale: float) -> tuple[float, float, float]:
        """The least and the most seconds of an adaptation, and those in which other cores have nothing to do."""
        with threads.limited(1, shared=False), self.counting():
            began = self.now()
            base.adapt(scale)
            seconds = self.now() - began
        return seconds, seconds + self._waited, seconds - self._together


def counted(scene: str, path: Path, scale: str, cores: Sequence[int]) -> Iterator[Counted]:
    """A row for one core, and for each of these numbers of cores."""
    over, under = map(int, scale.split("/"))
    one = 0.0
    for count in (1, *cores):
        base = wrap_model(path, threads=count)
        least, most, alone = Paper().count(base, over / under)
        one = one or least
        row = Counted(scene, scale, len(base.model.gaussians(base.any_camera())), count, least, most, one, alone)
        print(*row.cells(), flush=True)
        yield row


def main(
    data: tyro.conf.Positional[Path],
    cores: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    splats: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    output: Path = HERE / "benchmarks" / "results",
) -> None:
    """Count, and write the table.

    Args:
        data: The folder with checkpoints/.
        cores: 2, 4, 6, 8 and 16 by default.
        splats: Only flowers, its splats split into so many.
        output: Where the results go.
    """
    rows: list[Counted] = []
    with tempfile.TemporaryDirectory() as folder:
        scenes = [("flowers, split", stand_in(data, count, Path(folder) / str(count)), ("1/4",)) for count in splats] or [
            ("lego_200", data / "checkpoints" / "bases" / "lego_200", ("1/2", "1/4", "1/8")),
            ("flowers", data / "checkpoints" / "flowers_r8", ("1/4",)),
        ]
        for scene, path, scales in scenes:
            wrap_model(path).adapt(1 / 4, steps=8)  # so that all kernels are compiled
            rows += [row for scale in scales for row in counted(scene, path, scale, cores or (2, 4, 6, 8, 16))]
    write_table(output, "cores", INTRO, HEAD, rows, lambda row: (row.scene, row.splats, row.scale, row.cores))


if __name__ == "__main__":
    tyro.cli(main)
