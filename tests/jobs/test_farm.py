"""Jobs on dask.distributed: a real scheduler and real worker processes, one of which is killed in the middle of a job."""

import json
import os
import signal
import subprocess
import sys
import weakref
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest
import tiny
from running import saving_often, wait_until

from mipmap_plugin.cli import main
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.run import run
from mipmap_plugin.progress import meanwhile

pytest.importorskip("distributed")

from mipmap_plugin.jobs import farm


@pytest.fixture
def start(tmp_path):
    """Start processes of dask's, a scheduler first; end all of them at the end."""
    environment = saving_often(tmp_path / "site")
    file, started = tmp_path / "scheduler.json", []

    def start(kind, *words, **variables):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(file), *words]
        started.append(subprocess.Popen(command, env=environment | variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return started[-1]

    start.file = file
    yield start
    for process in reversed(started):
        process.kill()
        process.wait()


@pytest.fixture
def client(monkeypatch):
    """One of dask's, of which a test says how it submits, and which workers there are."""
    client = SimpleNamespace(cluster=None, workers={"tcp://a:1": {}}, wait_for_workers=lambda count: None, run=lambda *_, **__: {})
    client.scheduler_info = lambda n_workers: {"workers": client.workers}
    monkeypatch.setattr(farm, "_connected", lambda place: nullcontext(client))
    monkeypatch.setattr(farm, "Event", lambda *_, **__: SimpleNamespace(name="stop", set=lambda: None))
    return client


@pytest.mark.slow
def test_a_killed_worker_loses_one_job_which_is_resumed(start, tmp_path):
    start("scheduler", "--port", "0", "--no-dashboard")
    address = json.loads(wait_until(lambda: start.file.exists() and start.file.read_text()))["address"]
    settings = {"steps": 600, "seed": 0, "views": "given", "check_every": 5}
    bases = [tiny.folder(tmp_path / f"base_{seed}", tiny.cameras(3), seed=seed) for seed in range(3)]
    jobs = [Job(Base(base, backend="reference"), tmp_path / f"{base.name}.ply", 0.5, recipe="paper", settings=settings) for base in bases]
    with ThreadPoolExecutor(1) as pool:
        outcomes = pool.submit(lambda: list(farm.on_dask(jobs, address, threads=1)))
        victim = start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        state = wait_until(lambda: next(iter(tmp_path.glob("*.resume")), None))
        start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")  # later than the other, which therefore has the first job
        wait_until(lambda: len(list(tmp_path.glob("*.resume"))) == 2)
        victim.kill()
        saved = load_torch(state)
        outcomes = outcomes.result(timeout=300)
    assert {outcome.status for outcome in outcomes} == {"done"} and len(outcomes) == 3
    assert not list(tmp_path.glob("*.resume")) and not list(tmp_path.glob(".*.lock"))
    [resumed] = [outcome for outcome in outcomes if f"{outcome.job.target}.resume" == str(state)]
    assert len(saved["curve"]) > 1
    assert resumed.report["curve"][: len(saved["curve"])] == saved["curve"]  # its seconds too: these steps were not done again
    again = run(replace(jobs[0], target=tmp_path / "again.ply"), 1)
    assert again.file.read_bytes() == jobs[0].target.read_bytes()


@pytest.mark.slow
def test_a_job_that_dask_gives_up_is_handed_out_again(start, tmp_path):
    start("scheduler", "--port", "0", "--no-dashboard", DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    address = json.loads(wait_until(lambda: start.file.exists() and start.file.read_text()))["address"]
    settings = {"steps": 300, "seed": 0, "views": "given", "check_every": 5}
    base = Base(tiny.folder(tmp_path / "base", tiny.cameras(3)), backend="reference")
    job = Job(base, tmp_path / "out.ply", 0.5, recipe="paper", settings=settings)
    with ThreadPoolExecutor(1) as pool:
        outcomes = pool.submit(lambda: list(farm.on_dask([job], address, threads=1)))
        victim = start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        wait_until(lambda: next(iter(tmp_path.glob("*.resume")), None))
        victim.kill()
        start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        [outcome] = outcomes.result(timeout=300)
    assert outcome.status == "done" and job.target.exists()


@pytest.mark.slow
def test_workers_of_this_machine(tmp_path, capsys):
    bases = [str(tiny.folder(tmp_path / name, tiny.cameras(3))) for name in ("a", "b")] + [str(tmp_path / "nowhere")]
    words = ["--scale", "1/2", "--backend", "reference", "--views", "given", "--steps", "2", "--dask", "local:2"]
    assert main(["adapt", *bases, *words]) == 2
    assert "3 jobs: " in (out := capsys.readouterr().out) and "2 done" in out and "nowhere does not exist" in out


@pytest.mark.slow
def test_a_worker_that_dies_while_it_starts_is_replaced(monkeypatch):
    from distributed import Nanny

    monkeypatch.setattr(farm, "LOOK_S", 0.2)
    monkeypatch.setitem(farm.LOCAL, "distributed.deploy.lost-worker-timeout", "1 s")
    instantiate = Nanny.instantiate
    with farm._connected("local:2") as client, meanwhile(partial(farm._keep_workers, client, "local:2", lambda: None)):

        async def dies(nanny):
            monkeypatch.setattr(Nanny, "instantiate", instantiate)  # the next one lives
            await nanny.close()
            raise RuntimeError

        first = next(iter(client.cluster.workers.values()))
        monkeypatch.setattr(Nanny, "instantiate", dies)
        os.kill(first.pid, signal.SIGKILL)
        wait_until(lambda: Nanny.instantiate is instantiate and first not in client.cluster.workers.values())
        wait_until(lambda: len(client.scheduler_info(n_workers=-1)["workers"]) == 2)


@pytest.mark.slow
def test_files_that_are_sent_come_back_adapted(tmp_path):
    base = tiny.folder(tmp_path / "base", tiny.cameras(3))
    settings = {"steps": 2, "seed": 0, "views": "given"}
    jobs = [Job(Base(base, backend="reference"), tmp_path / f"{name}.ply", 0.5, settings=settings) for name in ("a", "b", "c", "d", "e")]
    outcomes = list(farm.on_dask(jobs, "local:2", threads=1, send_files=True))
    assert [outcome.status for outcome in outcomes] == ["done"] * 5 and {outcome.file for outcome in outcomes} == {job.target for job in jobs}
    assert len({job.target.read_bytes() for job in jobs}) == 1
    assert jobs[0].target.read_bytes() == run(replace(jobs[0], target=tmp_path / "here.ply")).file.read_bytes()
    assert [outcome.status for outcome in farm.on_dask(jobs[:1], "local:1", threads=1, send_files=True)] == ["finished before"]


def test_a_task_is_stopped_where_many_files_are_open(tmp_path, monkeypatch):
    """More than `select` takes: 1024."""
    said = iter([False, False])
    monkeypatch.setattr(farm, "Event", lambda name: SimpleNamespace(is_set=lambda: next(said, True)))
    monkeypatch.setattr(farm, "PERIOD_S", 0.01)
    settings = {"steps": 100_000, "views": "given", "patience": None}
    job = Job(Base(tiny.folder(tmp_path / "base", tiny.cameras(3)), backend="reference"), tmp_path / "a.ply", 0.5, settings=settings)
    files = [open(os.devnull) for _ in range(1100)]  # noqa: SIM115
    try:
        assert farm._task(job, 1, "stop").status == "interrupted"
    finally:
        farm._mine.worker.close()
        for file in files:
            file.close()


def test_a_checkpoint_that_cannot_be_sent_fails_alone(tmp_path):
    good, existing = tiny.folder(tmp_path / "base", tiny.cameras(3)), tmp_path / "existing.ply"
    existing.write_text("here")
    bases = [tmp_path / "nowhere", good, good]
    jobs = [Job(Base(base, backend="reference"), target, 0.5) for base, target in zip(bases, [tmp_path / "a", tmp_path / "b", existing], strict=True)]
    outcomes, sent = farm._sent(jobs, SimpleNamespace(scatter=lambda parcel, hash: parcel))
    assert [job for job, _ in sent] == [jobs[1]]
    assert [outcome.status for outcome in outcomes] == ["failed"] * 2
    assert "nowhere does not exist" in outcomes[0].reason and "exists already" in outcomes[1].reason


def test_that_no_worker_is_there_is_said_once(monkeypatch, capsys):
    looks = []
    client = SimpleNamespace(cluster=None, scheduler_info=lambda n_workers: looks.append(n_workers) or {"workers": {}})
    monkeypatch.setattr(farm, "LOOK_S", 0.001)
    with meanwhile(partial(farm._keep_workers, client, "tcp://somewhere:8786", lambda: None)):
        wait_until(lambda: len(looks) > 4)
    assert capsys.readouterr().err.count("there are no workers") == 1


@pytest.mark.parametrize("leave", ["before", "after"])
def test_ctrl_c_does_not_wait_for_workers_that_are_gone(tmp_path, client, monkeypatch, leave):
    """Neither where they left before, nor where they leave without having done what was asked of them."""
    jobs, futures = [Job(Base(tmp_path / "base"), tmp_path / "out.ply", 0.5)], []

    class Waiting(Future):  # of the standard library, with what dask's has
        status = "cancelled"

    def cancel(given):
        for future in given:
            if not future.cancelled() and future.cancel():
                future.set_running_or_notify_cancel()

    def pressed(pending):
        if not asked:
            asked.append(client.workers.clear() if leave == "before" else None)
            raise KeyboardInterrupt
        client.workers.clear()
        return as_completed(pending, timeout=5)

    asked: list[object] = []
    client.submit, client.cancel = lambda *_, **__: futures.append(Waiting()) or futures[-1], cancel
    monkeypatch.setattr(farm, "as_completed", pressed)
    monkeypatch.setattr(farm, "LOOK_S", 0.01)
    outcomes = []
    with pytest.raises(KeyboardInterrupt):
        outcomes.extend(farm.on_dask(jobs, "tcp://somewhere:8786"))
    assert futures[0].cancelled() and [outcome.status for outcome in outcomes] == ["interrupted"] * (leave == "after")


def test_outcomes_that_came_are_not_kept_by_workers(tmp_path, client, monkeypatch):
    """Of jobs that are sent they hold the files that were made, which a worker keeps as long as there is a future."""
    jobs, made, living = [Job(Base(tmp_path / "base"), tmp_path / f"{number}.ply", 0.5) for number in range(6)], [], []

    class Done(Future):  # of the standard library, with what dask's has
        status = "finished"

    def submit(*_, **__):
        made.append(weakref.ref(future := Done()))
        future.set_result(None)
        living.append(sum(ref() is not None for ref in made))
        return future

    client.submit = submit
    monkeypatch.setattr(farm, "as_completed", as_completed)
    monkeypatch.setattr(farm, "_sent", lambda jobs, client: ([], [(job, job) for job in jobs]))
    monkeypatch.setattr(farm, "_outcome", lambda future, job: Outcome(job, "done"))
    outcomes = list(farm.on_dask(jobs, "tcp://somewhere:8786", send_files=True))
    assert len(outcomes) == len(living) == 6 and max(living) <= farm.SENT_PER_WORKER


@pytest.mark.parametrize("theirs, told", [("0.0.1", "has mipmap-plugin 0.0.1"), (PackageNotFoundError("mipmap-plugin"), "lacks mipmap-plugin")])
def test_workers_of_another_version_are_refused(monkeypatch, theirs, told):
    monkeypatch.setattr(farm, "version", lambda name: "0.1.0")
    client = SimpleNamespace(run=lambda *_, **__: {"tcp://a:1": "0.1.0", "tcp://b:2": theirs, "tcp://c:3": OSError("it has left")})
    with pytest.raises(SettingsError, match=f"--dask farm: the worker tcp://b:2 {told}, and this is 0.1.0; install that version there too"):
        farm._refuse_other_versions(client, "farm")


@pytest.mark.parametrize("place", ["local:0", "local:x", "local:", "local:-1", "local:1.5"])
def test_a_wrong_number_of_workers_is_told_at_once(tmp_path, capsys, monkeypatch, place):
    monkeypatch.setattr("mipmap_plugin.jobs.farm.Client", None)
    assert main(["adapt", str(tmp_path / "a.ply"), "--scale", "4", "--dask", place]) == 2
    assert f"--dask {place}: after local: goes the number of workers, at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["tcp://127.0.0.1:1", "nonsense"])
def test_a_place_without_a_scheduler_is_said_in_a_sentence(tmp_path, capsys, monkeypatch, place):
    monkeypatch.setattr("mipmap_plugin.jobs.farm.CONNECT_S", 0.5)
    assert main(["adapt", str(tmp_path / "a.ply"), "--scale", "4", "--dask", place]) == 2
    assert f"--dask {place}: no scheduler answers there" in capsys.readouterr().err
