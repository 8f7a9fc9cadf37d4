"""Jobs side by side, and what a killed or interrupted run leaves."""

import io
import os
import pickle
import queue
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from running import saving_often, wait_until
from small_jobs import QUICK, job_of

from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.jobs import serve, summary
from mipmap_plugin.jobs import worker as jobs_worker
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.elsewhere import refuse_elsewhere
from mipmap_plugin.jobs.engines import in_workers, longest_first
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.worker import Worker, WorkerDied, do
from mipmap_plugin.models import Match
from mipmap_plugin.models.families import FAMILIES, find_family
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.splatting.viewers import VIEWERS


def test_workers_share_all_threads_where_jobs_are_few(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("mipmap_plugin.jobs.engines.Worker", lambda threads: made.append(threads) or SimpleNamespace(stop=list, close=list))
    monkeypatch.setattr("mipmap_plugin.jobs.engines.do", lambda job, worker: Outcome(job, "done"))
    assert len(list(in_workers([job_of(tmp_path)] * 2, count=8, threads=16))) == 2 and made == [8, 8]


def test_workers_begin_with_what_takes_longest(tmp_path):
    job = job_of(tmp_path)
    large = replace(job, base=replace(job.base, checkpoint=tmp_path / "large.ply"))
    (tmp_path / "large.ply").write_bytes(8 * (tmp_path / "base.ply").read_bytes())
    missing = replace(job, base=replace(job.base, checkpoint=tmp_path / "missing.ply"))
    half, double = job, replace(job, scale=2.0)
    assert longest_first([missing, half, large, double]) == [large, double, half, missing]
    assert longest_first([half, replace(half, viewer="gsplat"), large])[1:] == [half, replace(half, viewer="gsplat")]


@pytest.mark.parametrize(
    ("registry", "name", "changes"),
    [
        (BACKENDS, "mine", lambda job: dict(base=replace(job.base, backend="mine"))),
        (VIEWERS, "mine", lambda job: dict(viewer="mine")),
        (RECIPES, "mine", lambda job: dict(recipe="mine")),
        (UPSAMPLERS, "mine", lambda job: dict(settings={"upsampler": "mine"})),
        (FAMILIES, "mine", lambda job: {}),
        (FAMILIES, "3dgs", lambda job: {}),
    ],
)  # fmt: skip
def test_what_only_this_process_knows_is_told_before_others_are_asked(tmp_path, registry, name, changes):
    job = job_of(tmp_path)
    record = replace(find_family("3dgs"), name=name, recognize=lambda files: Match(1.0, "all"))  # of what is no family only the name counts
    told = f"'{name}' is registered in this process alone, and other processes, .*; register it by an entry"
    registry.add(name, record, replace=True)
    with pytest.raises(SettingsError, match=told):
        next(in_workers([replace(job, **changes(job))], 2, None))


def test_networks_that_each_process_reads_for_itself_are_no_concern(tmp_path):
    job = job_of(tmp_path, settings={"upsampler": "net"}, network=tmp_path / "net.pt")
    UPSAMPLERS.add("net", len)
    refuse_elsewhere([job])


@pytest.fixture
def worker():
    worker = Worker(1)
    yield worker
    worker.close()


def test_a_job_whose_worker_is_killed_is_done_again(worker, tmp_path, monkeypatch):
    begin, killed = worker.begin, []

    def kill(most):
        def begin_and_kill(job):
            begin(job)
            if len(killed) < most:
                killed.append(os.kill(worker._process.pid, signal.SIGKILL))

        monkeypatch.setattr(worker, "begin", begin_and_kill)

    kill(1)
    outcome = do(job_of(tmp_path), worker)
    assert killed and outcome.status == "done" and (tmp_path / "out.ply").exists()
    kill(9)
    failed = do(job_of(tmp_path, target=tmp_path / "other.ply"), worker)
    assert failed.status == "failed" and "was killed, perhaps for want of memory" in failed.reason
    worker.stop()
    assert do(job_of(tmp_path), worker).status == "interrupted"


def half_of_a_job():
    request = pickle.dumps((["of this version"], 1))
    return request[: len(request) // 2]


SENT = {"nothing": (b"", 0), "half a job": (half_of_a_job(), 0), "a job of another version": (b"cmipmap_plugin.jobs\nRemoved\n.", 1)}


@pytest.mark.parametrize(("sent", "code"), SENT.values(), ids=SENT)
@pytest.mark.usefixtures("capfd")  # for the traceback of the last one
def test_a_worker_whose_input_ends_in_whatever_way_ends(sent, code, monkeypatch):
    monkeypatch.setattr("os._exit", sys.exit)
    with pytest.raises(SystemExit) as ended:
        serve._read(io.BytesIO(sent), queue.SimpleQueue())
    assert ended.value.code == code


@pytest.mark.slow
def test_nothing_is_lost_whenever_a_worker_is_killed(tmp_path):
    """At 20 moments, from the worker's start to its answer."""
    job, moments = job_of(tmp_path, settings={"steps": 40, "seed": 0, "views": "given"}), random.Random(0)
    began = time.monotonic()
    assert do(replace(job, target=tmp_path / "whole.ply"), Worker(1)).status == "done"
    seconds, killed = time.monotonic() - began, 0
    for number in range(20):
        again, worker = replace(job, target=tmp_path / f"{number}.ply"), Worker(1)

        def kill_once(worker=worker):
            nonlocal killed
            if worker._process is not None:
                killed += 1
                os.kill(worker._process.pid, signal.SIGKILL)

        timer = threading.Timer(moments.uniform(0, seconds), kill_once)
        timer.start()
        assert do(again, worker).status in ("done", "finished before")  # before, if it was killed on its way to say so
        timer.cancel()
        worker.close()
        assert again.target.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert killed >= 10 and not list(tmp_path.glob("*.resume*")) and not list(tmp_path.glob(".*"))


def test_side_by_side_makes_the_same_bytes_as_one_after_the_other(run, scenes, tmp_path):
    command = ["adapt", scenes / "chair", scenes / "lego", "--scale", "1/2", *QUICK]
    for name, words in {"one": [], "two": ["--jobs", "2"]}.items():
        code, out, err = run(*command, "--output", tmp_path / name, *words)
        assert code == 0 and "2 jobs: 2 done" in out, err
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.ply"))
    assert len(files) == 2
    assert [(tmp_path / "one" / file).read_bytes() for file in files] == [(tmp_path / "two" / file).read_bytes() for file in files]


@pytest.mark.parametrize("engine", [["--jobs", "2"], pytest.param(["--dask", "local:2"], marks=pytest.mark.slow)], ids=["jobs", "dask"])
def test_ctrl_c_saves_the_state_of_every_running_job(run, scenes, tmp_path, engine):
    if "--dask" in engine:
        pytest.importorskip("distributed")
    words = ["adapt", scenes / "chair", scenes / "lego", "--scale", "1/2", "--scale", "1/4", "--views", "given"]
    command = [sys.executable, "-m", "mipmap_plugin", *map(str, words), "--steps", "100000", "--recipe", "paper", *engine]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=saving_often(tmp_path / "site")
    )
    try:
        wait_until(lambda: len(list(scenes.glob("*.resume"))) == 2 or process.poll() is not None)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        out, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "mipmap-plugin: interrupted; run the same command again to go on where it stopped" in err and "Traceback" not in err
    assert out.strip().endswith("4 jobs: 4 interrupted" if "--dask" in engine else "4 jobs: 2 interrupted, 2 not begun")
    assert "--dask" in engine or "  0.0  " not in out  # the seconds of a job that was broken off
    assert len(list(scenes.glob("*.resume"))) == 2 and not list(scenes.glob(".*.lock"))


def test_the_db_before_are_the_bases_and_of_no_other_state():
    told = {"the base as it is": 38.7, "the start": 21.9, "the last state": 25.0}
    assert summary._psnr({"validation": told, "returned": "the last state"}) == "38.70 -> 25.00"
    assert summary._psnr({"validation": {"the start": 21.9}, "returned": "the start"}) == ""
    assert summary._psnr({"validation": told, "returned": "the last state", "written": 24.5}) == "38.70 -> 24.50"  # as its format rounds it


def test_an_interruption_is_told_once(tmp_path):
    outcome = Outcome(job_of(tmp_path), "interrupted", reason="interrupted at step 132")
    assert str(outcome).count("interrupted") == 1 and str(replace(outcome, reason="")).endswith(": interrupted")


def test_a_worker_does_all_its_jobs_in_one_process(worker, tmp_path, monkeypatch):
    started, start = [], jobs_worker._start
    monkeypatch.setattr(jobs_worker, "_start", lambda threads: started.append(threads) or start(threads))
    assert {do(job_of(tmp_path, target=tmp_path / f"{number}.ply"), worker).status for number in range(2)} == {"done"}
    assert started == [1]


def test_a_worker_that_is_stopped_while_it_starts_begins_nothing(monkeypatch, tmp_path):
    worker, start = Worker(1), jobs_worker._start
    monkeypatch.setattr(jobs_worker, "_start", lambda threads: worker.stop() or start(threads))
    try:
        with pytest.raises(WorkerDied, match="was stopped"):
            worker.begin(Job(Base(tmp_path), tmp_path / "out.ply", 0.5))
    finally:
        worker.close()
