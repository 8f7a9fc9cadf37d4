"""A process that opens many damaged files, and runs many commands, under a limit of memory and time, and tells how each ended in JSON.

Run as `python worker.py FOLDER FIRST LAST NAME...`: damages FIRST to LAST of each sample, in FOLDER; of COMMANDS it runs as many.
"""

import contextlib
import faulthandler
import hashlib
import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
import mutations
import words
from corpus import SAMPLES, Sample

from mipmap_plugin.cli import main as command_line
from mipmap_plugin.errors import MipmapPluginError

COMMANDS = "command line"  # beside the names of the samples
SPARE = 1 << 30  # bytes of address space beyond what the imports took
SECONDS = 20  # of work, for one file of a few kB, or one command on such files
PATIENCE = 10  # times as long may it take on a machine that is busy with other things, or wait for what never comes


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


def outcome(job: Callable[[], str]) -> str:
    """How it ended: what `job` returns, "refused: ...", or "fault: ..."."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE * SECONDS)
    faulthandler.dump_traceback_later(2 * PATIENCE * SECONDS, exit=True)  # compiled code does not hear the alarms
    try:
        return job()
    except MipmapPluginError as error:
        return f"refused: {error}"
    except (Exception, TooSlow) as error:
        where = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)[-6:]]
        return f"fault: {type(error).__name__}: {str(error)[:200]} at {' < '.join(reversed(where))}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()


def opened(sample: Sample, path: Path) -> str:
    sample.opened(path)
    return "loaded"


def commanded(chosen: list[str]) -> str:
    """Run a command here, which has to end with 0, or with 2 and one sentence."""
    said, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(errors):
        try:
            code: object = command_line(chosen)
            sentences = errors.getvalue().splitlines()
            one = code == 0 or (len(sentences) >= 1 and sentences[-1].startswith("mipmap-plugin: "))
        except SystemExit as leaving:  # how the argument parser ends, whose help takes more lines
            code, one = leaving.code, True
    if code not in (0, 2) or not one or "Traceback" in errors.getvalue():
        return f"fault: {chosen} ended with {code}: {errors.getvalue()[-300:]}"
    return "loaded" if code == 0 else "refused: " + " ".join(errors.getvalue().split())[:500]


def precious(folder: Path) -> dict[str, str]:
    """What no command may change: everything that is there before it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def compile_kernels(folder: Path) -> None:
    """Run a sound command, which compiles what a machine keeps from then on: that takes longer than any file or command may."""
    here, work = Path.cwd(), folder / "compiled"
    work.mkdir()
    words.prepare(work)
    os.chdir(work)
    commanded(words.SOUND[0].split())
    os.chdir(here)
    shutil.rmtree(work)


def run_commands(folder: Path, first: int, last: int) -> None:
    compile_kernels(folder)
    here = Path.cwd()
    for seed in range(first - 1, last):
        chosen = words.words(random.Random(f"{COMMANDS} {seed}")) if seed >= first else words.SOUND[0].split()
        work = folder / "commands"
        work.mkdir()
        words.prepare(work)
        before = precious(work)
        os.chdir(work)
        print(json.dumps({"name": COMMANDS, "seed": seed, "outcome": None, "words": chosen}), flush=True)
        began = time.perf_counter()
        told = outcome(lambda chosen=chosen: commanded(chosen))  # type: ignore[misc]
        os.chdir(here)
        after = precious(work)
        if changed := [name for name, digest in before.items() if name != "text" and after.get(name) != digest]:
            told = f"fault: {chosen} changed {changed}"
        if left := [path.name for path in work.rglob(".*.tmp")]:
            told = f"fault: {chosen} left {left}"
        print(json.dumps({"name": COMMANDS, "seed": seed, "outcome": told, "seconds": time.perf_counter() - began}), flush=True)
        shutil.rmtree(work)


def address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main(folder: Path, first: int, last: int, names: list[str]) -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGPROF, ring)
    signal.signal(signal.SIGALRM, ring)
    canary = folder / "executed"
    sound = {name: SAMPLES[name].make(folder / "sound" / name) for name in names if name != COMMANDS}
    if Path("/proc/self/statm").exists():
        limit = address_space() + SPARE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for name, path in sound.items():
        print(json.dumps({"name": name, "seed": -1, "outcome": outcome(partial(opened, SAMPLES[name], path))}), flush=True)
        for seed in range(first, last):
            work = folder / "work"
            shutil.copytree(folder / "sound" / name, work)
            damage(SAMPLES[name], work / SAMPLES[name].damaged, random.Random(f"{name} {seed}"), canary)
            print(json.dumps({"name": name, "seed": seed, "outcome": None}), flush=True)  # should the process die, this is the file
            began = time.perf_counter()
            told = outcome(partial(opened, SAMPLES[name], work / path.relative_to(folder / "sound" / name)))
            if canary.exists():
                told = "fault: the file was executed"
                canary.unlink()
            print(json.dumps({"name": name, "seed": seed, "outcome": told, "seconds": time.perf_counter() - began}), flush=True)
            shutil.rmtree(work)
    if COMMANDS in names:
        run_commands(folder, first, last)


if __name__ == "__main__":
    (Path(sys.argv[1]) / "sound").mkdir()
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:] or list(SAMPLES))
