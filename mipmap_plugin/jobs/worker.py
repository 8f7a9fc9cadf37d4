"""A worker: another process of this Python, which does one job after another. Torch and OpenMP do not survive a fork, so it is started anew."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import IO, cast

from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.models.zipped_folder import with_archives_named

# Where libraries look for the number of threads that they may start.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

# A job whose worker dies is begun again this many times in all, and continues where its state was last saved.
ATTEMPTS = 2

# The exit code of a process that the system killed: minus the number of SIGKILL, a name that Windows lacks.
KILLED = -9


class WorkerDied(RuntimeError):
    """A worker ended in the middle of a job."""


class Worker:
    """A process that does jobs, with `threads` threads each (None: as many as torch finds). It ends when this process ends, in whatever way."""

    def __init__(self, threads: int | None) -> None:
        self.threads, self.stopped = threads, False
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self, job: Job) -> None:
        """Start a job; no other may be running. Raises WorkerDied."""
        if self.stopped:
            raise WorkerDied("the worker was stopped")
        self._process = self._process or _start(self.threads)
        if self.stopped:  # from another thread, before there was a process to tell
            raise WorkerDied("the worker was stopped")
        stream = cast(IO[bytes], self._process.stdin)
        try:
            pickle.dump((job, self.threads), stream)
            stream.flush()
        except OSError:  # BrokenPipeError, or another one on Windows
            raise self._death() from None

    def outcome(self) -> Outcome:
        """Wait for the outcome of the job. Raises WorkerDied."""
        try:
            if self._process is None:
                raise self._death()
            outcome: Outcome = pickle.load(cast(IO[bytes], self._process.stdout))
            return outcome
        except (EOFError, ValueError, pickle.UnpicklingError):  # ValueError: closed from outside
            raise self._death() from None

    def stop(self) -> None:
        """Begin no other job, and let the running one save its state and end."""
        self.stopped = True
        if self._process is not None and self._process.poll() is None and os.name != "nt":  # on Windows, all of a console hear Ctrl-C
            self._process.send_signal(signal.SIGINT)

    def close(self) -> None:
        """End the process at once, and the job that it may have."""
        self.stopped = True
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            _close(process)

    def _death(self) -> WorkerDied:
        process, self._process = self._process, None
        if process is None:
            return WorkerDied("the worker was stopped")
        code = process.wait()
        _close(process)
        if code == KILLED:
            return WorkerDied("the process that did it was killed, perhaps for want of memory; run fewer jobs at a time")
        return WorkerDied(f"the process that did it ended with {f'signal {-code}' if code < 0 else f'exit code {code}'}")


def do(job: Job, worker: Worker) -> Outcome:
    """Do a job in a worker; if that dies, in a new one."""
    sent, deaths = replace(job, base=job.base.unpacked()), 0
    while True:
        try:
            worker.begin(sent)
            outcome = worker.outcome()
            return replace(outcome, job=job, reason=with_archives_named(outcome.reason), warnings=tuple(map(with_archives_named, outcome.warnings)))
        except WorkerDied as death:
            deaths += 1
            if worker.stopped:
                return Outcome(job, "interrupted", reason="interrupted")
            if deaths == ATTEMPTS:
                return Outcome(job, "failed", reason=f"{death} ({ATTEMPTS} attempts)")


def _start(threads: int | None) -> subprocess.Popen[bytes]:
    """Start a worker, in a session of its own: its owner alone tells it of Ctrl-C."""
    limits = {} if threads is None else dict.fromkeys(THREAD_VARIABLES, str(threads))
    command = [sys.executable, "-m", "mipmap_plugin.jobs.serve"]
    with _ctrl_c_waits():
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, **limits}, start_new_session=True)


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    """A process started inside gets Ctrl-C only once it asks for it (`serve`): while it imports, Python would print a traceback."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _close(process: subprocess.Popen[bytes]) -> None:
    for pipe in filter(None, (process.stdin, process.stdout)):
        with suppress(OSError):  # with a job that was half written
            pipe.close()
