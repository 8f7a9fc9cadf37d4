"""The main function of a worker process: it reads jobs from its standard input and answers with their outcomes on its standard output.

It ends when its input ends, in the middle of a job too: a worker whose owner was killed must not go on beside the one that takes its place.
"""

from __future__ import annotations

import io
import os
import pickle
import queue
import signal
import sys
import threading
import time
import traceback
from contextlib import redirect_stderr
from typing import IO

from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.process.freed_memory import keep_freed_memory
from mipmap_plugin.process.signals import INTERRUPTED, Ending, ctrl_c_does, ends_as_by_ctrl_c

Request = tuple[Job, "int | None"]


def main() -> None:
    """Do the jobs that come on standard input, and write their outcomes to standard output, until the owner closes it."""
    signal.signal(signal.SIGINT, _leave)
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # which its owner has blocked until now
    with ends_as_by_ctrl_c() as ending:
        _serve(ending)


def _serve(ending: Ending) -> None:
    keep_freed_memory()  # also in workers of dask, whose environment asks for the opposite
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not mix with the answers
    requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin.buffer, requests), daemon=True).start()
    while True:
        outcome = _run_quietly(*requests.get())
        if ending.code != INTERRUPTED:  # not by its owner, who begins the job again elsewhere, from the state that was saved
            os._exit(ending.code)
        pickle.dump(outcome, answers)
        answers.flush()


def _read(stream: IO[bytes], requests: queue.SimpleQueue[Request]) -> None:
    try:
        while True:
            requests.put(pickle.load(stream))
    except (EOFError, pickle.UnpicklingError):  # the owner is gone, perhaps in the middle of a job
        os._exit(0)
    except Exception:  # this package was replaced by another version since the owner began; who waits for an outcome has to learn it
        traceback.print_exc()
        os._exit(1)


def _leave(number: int, frame: object) -> None:
    """What Ctrl-C does where no job can be lost."""
    os._exit(INTERRUPTED)


def _run_quietly(job: Job, threads: int | None) -> Outcome:
    """Do a job without its progress bars, which would mix with those of other workers."""
    began = time.perf_counter()
    with redirect_stderr(io.StringIO()):
        try:
            from mipmap_plugin.jobs.run import run  # not interruptible: what it loads, torch among it, may swallow a KeyboardInterrupt

            with ctrl_c_does(signal.default_int_handler):
                return run(job, threads)
        except KeyboardInterrupt as interrupt:
            return Outcome(job, "interrupted", reason=str(interrupt) or "interrupted", seconds=time.perf_counter() - began)


if __name__ == "__main__":
    main()
