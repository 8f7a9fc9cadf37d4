"""A process that opens many damaged files under a limit of memory and time, and tells how each ended, one line of JSON each.

Run as `python worker.py FOLDER FIRST LAST NAME...`: damages FIRST to LAST of each sample, in FOLDER.
"""

from __future__ import annotations

import faulthandler
import json
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
import mutations
from corpus import SAMPLES, Sample, open_checkpoint, open_scene

from mipmap_plugin.errors import MipmapPluginError

SPARE = 1 << 30  # bytes of address space beyond what the imports took
SECONDS = 5  # for one file of a few kB


class TooSlow(BaseException):
    """Not an Exception, so that nothing mistakes it for a damaged file."""


def ring(number: int, frame: object) -> None:
    raise TooSlow


def damage(sample: Sample, file: Path, rng: random.Random, canary: Path) -> None:
    kind = rng.choice(sample.kinds)
    if kind == "of_torch":
        mutations.of_torch(file, rng, canary)
        return
    for _ in range(rng.choice([1, 1, 2])):
        change = getattr(mutations, kind if kind != "of_json" or _ == 0 else "of_bytes")
        file.write_bytes(change(file.read_bytes(), rng))


def outcome(sample: Sample, path: Path) -> str:
    """How opening ended: "loaded", "refused: ...", or "fault: ..."."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    faulthandler.dump_traceback_later(10 * SECONDS, exit=True)  # compiled code does not hear the alarm
    try:
        (open_scene if sample.is_scene else open_checkpoint)(path)
        return "loaded"
    except MipmapPluginError as error:
        return f"refused: {error}"
    except (Exception, TooSlow) as error:
        where = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)[-6:]]
        return f"fault: {type(error).__name__}: {str(error)[:200]} at {' < '.join(reversed(where))}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()


def address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main(folder: Path, first: int, last: int, names: list[str]) -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGALRM, ring)
    canary = folder / "executed"
    sound = {name: SAMPLES[name].make(folder / "sound" / name) for name in names}
    if Path("/proc/self/statm").exists():
        limit = address_space() + SPARE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for name, path in sound.items():
        print(json.dumps({"name": name, "seed": -1, "outcome": outcome(SAMPLES[name], path)}), flush=True)
        for seed in range(first, last):
            work = folder / "work"
            shutil.copytree(folder / "sound" / name, work)
            damage(SAMPLES[name], work / SAMPLES[name].damaged, random.Random(f"{name} {seed}"), canary)
            print(json.dumps({"name": name, "seed": seed, "outcome": None}), flush=True)  # should the process die, this is the file
            began = time.perf_counter()
            told = outcome(SAMPLES[name], work / path.relative_to(folder / "sound" / name))
            if canary.exists():
                told = "fault: the file was executed"
                canary.unlink()
            print(json.dumps({"name": name, "seed": seed, "outcome": told, "seconds": time.perf_counter() - began}), flush=True)
            shutil.rmtree(work)


if __name__ == "__main__":
    (Path(sys.argv[1]) / "sound").mkdir()
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:] or list(SAMPLES))
