"""Jobs on dask.distributed, for more than one machine. Paths are sent, not files: all machines must see the same file system.

A task of dask is one job, which a worker process of ours does (`worker`): so it can be interrupted, and a job that takes all memory ends
without its dask worker. If a dask worker dies, the scheduler gives its job to another one, which continues from the state on disk.
"""

from __future__ import annotations

import logging
import re
import signal
import threading
import uuid
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager

from distributed import Client, Event, Future, LocalCluster, as_completed

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.jobs.engines import usable_threads, with_interrupted
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.worker import Worker, do

# Seconds between two looks at whether jobs are to stop; to reach a scheduler.
PERIOD_S, CONNECT_S = 1.0, 20.0

_mine = threading.local()


def on_dask(jobs: Sequence[Job], place: str, threads: int | None = None) -> Generator[Outcome, None, None]:
    """Do the jobs on the workers of the scheduler at `place` (tcp://host:8786), or on n new ones here (local:n); yield each outcome.

    `threads`: of each job; of all jobs together for local:n. If any worker declares GPUs (`--resources GPU=1`), each job takes one.
    Ctrl-C lets every running job save its state, and begins no other. Raises SettingsError for a place where there is no scheduler.
    """
    with _connected(place) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        needs = {"GPU": 1} if any("GPU" in worker.get("resources", {}) for worker in workers) else None
        share = max(1, (threads or usable_threads()) // len(workers)) if place.startswith("local:") else threads
        stop = Event(f"stop-{uuid.uuid4().hex}", client=client)
        futures = {client.submit(_task, job, share, stop.name, key=f"adapt-{uuid.uuid4().hex}", pure=False, resources=needs): job for job in jobs}
        try:
            for future in with_interrupted(list(futures), as_completed, stop.set):
                yield _outcome(future, futures[future])
        finally:
            stop.set()


def _task(job: Job, threads: int | None, stop_name: str) -> Outcome:
    """What a dask worker does: it lets a worker of ours do the job, and tells that when to stop."""
    stop = Event(stop_name)
    worker: Worker | None = getattr(_mine, "worker", None)
    if worker is None or worker.stopped or worker.threads != threads:
        worker = _mine.worker = Worker(threads)

    def watch() -> None:
        while not worker.has_ended(PERIOD_S):
            if stop.is_set():
                worker.stop()
                return

    return Outcome(job, "interrupted", reason="interrupted") if stop.is_set() else do(job, worker, watch)


def _outcome(future: Future[Outcome], job: Job) -> Outcome:
    """The outcome of a task, also where dask gave it up."""
    if future.status == "finished":
        outcome: Outcome = future.result()
        return outcome
    error = future.exception() if future.status == "error" else None
    reason = f"{type(error).__name__}: {error}" if error else "the connection to the scheduler was lost"
    return Outcome(job, "failed", reason=reason)


@contextmanager
def _connected(place: str) -> Iterator[Client]:
    """A client of the scheduler at `place`, or of a new one on this machine."""
    if match := re.fullmatch(r"local:([1-9]\d*)", place):
        with _without_interrupts():
            cluster = LocalCluster(
                n_workers=int(match[1]), threads_per_worker=1, memory_limit=0, dashboard_address=":0", silence_logs=logging.CRITICAL
            )
        with cluster, Client(cluster) as client:
            yield client
        return
    try:
        client = Client(place, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise SettingsError(f"--dask {place}: no scheduler answers there ({error}); give tcp://HOST:8786, or local:4 for four workers here") from None
    with client:
        yield client


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes that are started inside ignore Ctrl-C, which the terminal sends to all of them: this process alone decides what ends."""
    if threading.current_thread() is not threading.main_thread():  # which alone may change what signals do
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
