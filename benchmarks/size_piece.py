"""One command of `size.py`, in a process of its own: seconds, CPU time and peak of memory of each phase, of whatever version PYTHONPATH names.

    python benchmarks/size_piece.py FACTS.json adapt output/bicycle --scale 1/4

Writes what it measured as JSON. The word `load` loads a checkpoint and nothing else; all others are commands of the package. Linux only: it
takes the peak of each phase from the kernel, which lets a process reset its own.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def memory(name: str) -> int:
    """Bytes of this process: VmRSS now, VmHWM at the peak since the last reset."""
    return 1024 * int(re.search(rf"{name}:\s+(\d+) kB", STATUS.read_text())[1])


class Meter:
    """What each phase takes; a phase that is entered several times is added up."""

    def __init__(self) -> None:
        self.phases: dict[str, dict[str, float]] = {}
        self.before = self.peak = 0  # bytes: what Python, torch and the package themselves hold; the peak of the process
        self.began = 0.0  # when all was imported and the command began, by the clock of `time.perf_counter`

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count what happens inside under `name`; of phases inside one another the outermost counts."""
        self._reset_peak()
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:  # a run that Ctrl-C ends, to go on later, tells what it took
            entry = self.phases.setdefault(name, {"seconds": 0.0, "cpu": 0.0, "peak": 0})
            entry["seconds"] += time.perf_counter() - wall
            entry["cpu"] += time.process_time() - cpu
            entry["peak"] = max(entry["peak"], memory("VmHWM") - self.before)
            self._reset_peak()

    def counted(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, whose calls are a phase."""

        def call(*arguments: Any, **options: Any) -> Any:
            with self.phase(name):
                return function(*arguments, **options)

        return call

    def _reset_peak(self) -> None:
        self.peak = max(self.peak, memory("VmHWM"))
        CLEAR.write_text("5")

    def facts(self) -> dict[str, Any]:
        self._reset_peak()
        return {"phases": self.phases, "peak": self.peak - self.before, "began": self.began}


def watch(meter: Meter) -> None:
    """Count the parts of the package as phases."""
    from mipmap_plugin import models, wrap
    from mipmap_plugin.adaptation import adapted, session

    models.load_model = wrap.load_model = meter.counted("load", wrap.load_model)
    adapted.Adapted.save = meter.counted("save", adapted.Adapted.save)
    session.adapt = meter.counted("optimization", session.adapt)
    original = session.Session.phase

    @contextmanager
    def phase(self: session.Session, name: str) -> Iterator[None]:
        with original(self, name), meter.phase(name):
            yield

    session.Session.phase = phase


def main() -> int:
    facts, (command, *words) = Path(sys.argv[1]), sys.argv[2:]
    from mipmap_plugin.cli import main as run

    meter = Meter()
    watch(meter)
    meter.before, meter.began = memory("VmRSS"), time.perf_counter()
    code = 0
    if command == "load":
        from mipmap_plugin import models

        models.load_model(Path(words[0]))
    else:
        code = run([command, *words])
    facts.write_text(json.dumps(meter.facts()))
    return code


if __name__ == "__main__":
    sys.exit(main())
