"""What runs jobs on one machine: this process, or several workers at a time. (`farm`: more than one machine.)"""

from __future__ import annotations

import os
import queue
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.jobs.elsewhere import refuse_elsewhere
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.worker import Worker, do
from mipmap_plugin.models import detect

Futures = Iterable[Any]  # of the standard library or of dask


def in_this_process(jobs: Sequence[Job], threads: int | None = None) -> Generator[Outcome, None, None]:
    """Do the jobs one after the other, and yield the outcome of each. Ctrl-C saves the state of the one that runs."""
    from mipmap_plugin.jobs.run import run

    for job in jobs:
        yield (outcome := run(job, threads))
        if outcome.status == "interrupted":
            raise KeyboardInterrupt


def in_workers(jobs: Sequence[Job], count: int, threads: int | None) -> Generator[Outcome, None, None]:
    """Do the jobs in at most `count` processes that share `threads` threads (None: all); yield each outcome when it is there.

    Ctrl-C lets every running job save its state, and begins no other; a second one ends them at once. Raises SettingsError for a plug-in
    that only this process knows.
    """
    refuse_elsewhere(jobs)
    jobs = longest_first(jobs)
    count = min(count, len(jobs))
    workers = [Worker(max(1, (threads or usable_threads()) // count)) for _ in range(count)]
    free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    for worker in workers:
        free.put(worker)

    def do_in_free_worker(job: Job) -> Outcome:
        worker = free.get()
        try:
            return do(job, worker)
        finally:
            free.put(worker)

    pool = ThreadPoolExecutor(max(1, len(workers)), "mipmap_plugin-jobs")
    futures = [pool.submit(do_in_free_worker, job) for job in jobs]

    def stop() -> None:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.stop()

    try:
        for future in with_interrupted(futures, as_completed, stop):
            yield future.result()
    finally:
        stop()
        for worker in workers:
            worker.close()


def with_interrupted(futures: Futures, as_completed: Callable[[Futures], Futures], stop: Callable[[], None]) -> Generator[Any, None, None]:
    """Yield the futures as they complete. On Ctrl-C, call `stop`, yield those that it ends too, and raise KeyboardInterrupt then."""
    pending = list(futures)
    try:
        for future in as_completed(list(pending)):
            pending.remove(future)
            yield future
    except KeyboardInterrupt:
        stop()
        yield from as_completed([future for future in pending if not future.cancelled()])
        raise


def longest_first(jobs: Sequence[Job]) -> list[Job]:
    """The jobs for several workers, the longest first: if one of them came last, all other workers would wait for it.

    How long a job takes is estimated from the bytes of its checkpoint and from its scale.
    """
    return sorted(jobs, key=lambda job: -size_of(job.base.checkpoint) * job.scale)


def size_of(checkpoint: Path) -> int:
    """The bytes of the file with a checkpoint's splats; 0 if there is none, which its job will report."""
    try:
        return detect(checkpoint).path.stat().st_size
    except (MipmapPluginError, OSError):
        return 0


def usable_threads() -> int:
    """The threads that this process may use: as OMP_NUM_THREADS says, or those of its processors."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return int(wanted) if wanted.isdigit() and int(wanted) else available or 1
