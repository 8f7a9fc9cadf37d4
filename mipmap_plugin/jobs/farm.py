"""Jobs on dask.distributed, for more than one machine. Paths are sent where all machines see the same file system, and else the files themselves.

A task of dask is one job, which a worker process of ours does (`worker`): so it can be interrupted, and a job that takes all memory ends
without its dask worker. If a dask worker dies, the scheduler gives its job to another one, which continues from the state on disk.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import threading
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any
from weakref import WeakSet

import dask
from distributed import Client, Event, Future, KilledWorker, LocalCluster, as_completed

from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.jobs.elsewhere import refuse_elsewhere
from mipmap_plugin.jobs.engines import longest_first, usable_threads, with_interrupted
from mipmap_plugin.jobs.finished import finished
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.parcel import Delivery, Parcel, do_parcel, pack, unpack
from mipmap_plugin.jobs.worker import Worker, do
from mipmap_plugin.process.signals import ctrl_c_does
from mipmap_plugin.progress import meanwhile, note

PACKAGE = "mipmap-plugin"

# Seconds between two looks at whether jobs are to stop; to reach a scheduler; between two looks at whether there are workers.
PERIOD_S, CONNECT_S, LOOK_S = 1.0, 20.0, 10.0

# Settings of dask for workers on this machine, whose cores are needed for the work: no samples for its profiler, a tick of its clock twice and not
# fifty times a second, and no second job for a worker before its first has ended.
LOCAL: dict[str, Any] = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500 ms",
    "distributed.scheduler.worker-saturation": 1.0,
}

# Jobs whose files are sent at a time.
SENT_PER_WORKER = 2

# How often a job is handed out at most. dask gives a job up after four of its workers died while they did it. A job that takes too much memory ends
# our worker and not dask's, so dask's were ended from outside, by a cloud or a batch system; the next one continues the job from its state.
HANDED_OUT = 5

# Why a task has no outcome and nobody does it any more.
LOST = "the connection to the scheduler was lost"

_mine = threading.local()


def on_dask(jobs: Sequence[Job], place: str, threads: int | None = None, *, send_files: bool = False) -> Generator[Outcome, None, None]:
    """Do the jobs on the workers of the scheduler at `place` (tcp://host:8786), or on n new ones here (local:n); yield each outcome.

    `threads`: of each job; of all jobs together for local:n. `send_files`: send checkpoints and get back what was made of them, also where workers
    see them; otherwise that is done if some worker does not see the first checkpoint. If any worker declares GPUs (`--resources GPU=1`), each job
    takes one.
    Ctrl-C lets every running job save its state, and begins no other. Raises SettingsError for a place where there is no scheduler, workers that
    lack this package or have another version of it, and a plug-in that only this process knows.
    """
    refuse_elsewhere(jobs)
    jobs, stopping = longest_first(jobs), threading.Event()
    given: WeakSet[Future[Outcome | Delivery]] = WeakSet()  # workers keep the outcome, with its files, of each task whose future is kept
    with _connected(place) as client, meanwhile(partial(_keep_workers, client, place, lambda: stopping.is_set() and client.cancel(list(given)))):
        client.wait_for_workers(1)  # which says whether files have to be sent, and whether there are GPUs
        _refuse_other_versions(client, place)
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        needs = {"GPU": 1} if any("GPU" in worker.get("resources", {}) for worker in workers) else None
        share = max(1, (threads or usable_threads()) // len(workers)) if place.startswith("local:") else threads
        send_files = send_files or (bool(jobs) and not all(client.run(os.path.exists, str(jobs[0].base.checkpoint)).values()))
        stop = Event(f"stop-{uuid.uuid4().hex}", client=client)

        def submit(sent: Any) -> Future[Outcome | Delivery]:
            given.add(future := client.submit(_task, sent, share, stop.name, key=f"adapt-{uuid.uuid4().hex}", pure=False, resources=needs))
            return future

        def end() -> None:
            stopping.set()
            stop.set()
            if not client.scheduler_info(n_workers=1)["workers"]:  # who would end them
                client.cancel(list(given))

        together = SENT_PER_WORKER * max(1, len(workers)) if send_files else max(1, len(jobs))
        try:
            for first in range(0, len(jobs), together):  # files that are sent wait in the workers' memory, so that not all are sent at once
                done, todo = _sent(jobs[first : first + together], client) if send_files else ([], [(job, job) for job in jobs])
                yield from done
                for outcome in _outcomes(todo, submit, end):
                    lost = stopping.is_set() and outcome.reason == LOST
                    yield replace(outcome, status="interrupted", reason="interrupted") if lost else outcome
        finally:
            stop.set()


def _refuse_other_versions(client: Client, place: str) -> None:
    """Raise SettingsError for workers that lack this package, which a job would crash, or that have another version, whose results differ."""
    try:
        ours = version(PACKAGE)
    except PackageNotFoundError:  # of a source tree, of which no version is known
        return
    for address, theirs in client.run(version, PACKAGE, on_error="return").items():
        if isinstance(theirs, PackageNotFoundError) or (isinstance(theirs, str) and theirs != ours):
            told = f"has {PACKAGE} {theirs}" if isinstance(theirs, str) else f"lacks {PACKAGE}"
            raise SettingsError(f"--dask {place}: the worker {address} {told}, and this is {ours}; install that version there too")


def _outcomes(todo: Sequence[tuple[Job, Any]], submit: Callable[[Any], Future[Any]], stop: Callable[[], None]) -> Generator[Outcome, None, None]:
    """The outcomes of jobs, each with what is sent of it. Those that dask gives up are handed out again, once the others are done."""
    for left in reversed(range(HANDED_OUT)):
        futures, lost = {submit(sent): (job, sent) for job, sent in todo}, []
        for future in with_interrupted(list(futures), as_completed, stop):
            if left and future.status == "error" and isinstance(future.exception(), KilledWorker):
                lost.append(futures[future])
            else:
                yield _outcome(future, futures[future][0])
        todo = lost


def _sent(jobs: Sequence[Job], client: Client) -> tuple[list[Outcome], list[tuple[Job, Any]]]:
    """Decide here what workers that do not see this disk cannot know: the outcomes of jobs that need not or cannot be done, and all others, sent."""
    outcomes, sent = [], []
    for job in jobs:
        try:
            if made := finished(job) if job.skip_finished else None:
                outcomes.append(Outcome(job, "finished before", *made))
            else:
                sent.append((job, client.scatter(pack(job), hash=False)))
        except (MipmapPluginError, OSError) as error:
            outcomes.append(Outcome(job, "failed", reason=str(error)))
    return outcomes, sent


def _task(sent: Job | Parcel, threads: int | None, stop_name: str) -> Outcome | Delivery:
    """What a dask worker does: it lets a worker process of ours do the job, and stops that once the event is set."""
    stop = Event(stop_name)
    worker: Worker | None = getattr(_mine, "worker", None)
    if worker is None or worker.stopped or worker.threads != threads:
        worker = _mine.worker = Worker(threads)
    if stop.is_set():
        return Outcome(sent.job if isinstance(sent, Parcel) else sent, "interrupted", reason="interrupted")
    with meanwhile(partial(_stop_with, stop, worker)):
        return do_parcel(sent, lambda job: do(job, worker)) if isinstance(sent, Parcel) else do(sent, worker)


def _stop_with(stop: Event, worker: Worker, ended: threading.Event) -> None:
    """Stop the worker once `stop` is set, unless its job has `ended` before."""
    while not ended.wait(PERIOD_S):
        with suppress(OSError, asyncio.TimeoutError):  # a scheduler that cannot be reached now
            if stop.is_set():
                return worker.stop()


def _outcome(future: Future[Outcome | Delivery], job: Job) -> Outcome:
    """The outcome of a task, also where dask gave it up; what came back is written."""
    if future.status == "finished":
        result: Outcome | Delivery = future.result()
        try:
            return unpack(result, job) if isinstance(result, Delivery) else replace(result, job=job)
        except (MipmapPluginError, OSError) as refusal:
            return Outcome(job, "failed", reason=str(refusal))
    error = future.exception() if future.status == "error" else None
    reason = f"{type(error).__name__}: {error}" if error else LOST
    return Outcome(job, "failed", reason=reason)


@contextmanager
def _connected(place: str) -> Iterator[Client]:
    """A client of the scheduler at `place`, or of a new one on this machine."""
    if place.startswith("local:"):
        if not re.fullmatch(r"local:0*[1-9]\d*", place):
            raise SettingsError(f"--dask {place}: after local: goes the number of workers, at least 1; give local:4 for four workers here")
        # Its processes ignore Ctrl-C, which the terminal sends to all of them: this process alone decides what ends.
        with ctrl_c_does(signal.SIG_IGN), dask.config.set(LOCAL):
            cluster = LocalCluster(
                n_workers=int(place[6:]), threads_per_worker=1, memory_limit=0, dashboard_address=":0", silence_logs=logging.CRITICAL
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


def _keep_workers(client: Client, place: str, forsaken: Callable[[], object], ended: threading.Event) -> None:
    """Look regularly whether there are workers: at each look that finds none call `forsaken`, and at the second in a row write a line.

    Also replace workers of this machine that died, as dask does itself except for one that dies while it starts.
    """
    looks = 0
    while not ended.wait(LOOK_S):
        if client.cluster is not None:
            client.cluster.scale(len(client.cluster.worker_spec))
        with suppress(OSError, asyncio.TimeoutError):  # a scheduler that cannot be reached now is found again, or ends the jobs
            looks = 0 if client.scheduler_info(n_workers=1)["workers"] else looks + 1
            if looks:
                forsaken()
            if looks == 2:
                note(f"--dask {place}: there are no workers, so nothing is done until one comes; Ctrl-C ends this, and the same command goes on")
