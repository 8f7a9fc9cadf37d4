"""A command that is told to end, by `timeout`, a cluster or a closed terminal, does what Ctrl-C does: nothing temporary stays."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import time
import weakref
from unittest.mock import Mock

import pressing
import pytest
import tiny
from zip_files import packed

from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.cli import main
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.jobs.worker import Worker, WorkerDied, do
from mipmap_plugin.process import signals
from mipmap_plugin.process.signals import ends_as_by_ctrl_c

# A command that is told to end, as `timeout` does it, when it has unpacked its checkpoint.
TOLD_TO_END = """
import os, signal, sys
from mipmap_plugin import cli, models

def told(path, **_):
    models.zipped_folder.unzipped(path)
    assert os.listdir("unpacked")
    signal.raise_signal(signal.SIGTERM)

models.load_model = told
code = cli.main(["inspect", "base.zip"])
signal.raise_signal(signal.SIGTERM)
sys.exit(code)
"""


@pytest.fixture(autouse=True)
def _usual_signals():
    before = {number: signal.getsignal(number) for number in (*signals.SIGNALS, signal.SIGINT)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in signals.SIGNALS:
        signal.signal(number, signal.SIG_DFL)  # also where these tests are run by nohup
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_what_was_unpacked_is_removed(tmp_path):
    packed(tmp_path / "base.zip", tiny.folder(tmp_path / "base"))
    (tmp_path / "unpacked").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "unpacked"), "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, "-c", TOLD_TO_END], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.strip()) == (128 + signal.SIGTERM, "mipmap-plugin: interrupted")
    assert not list((tmp_path / "unpacked").iterdir())


@pytest.mark.parametrize("number", signals.SIGNALS)
def test_a_run_keeps_its_state(tmp_path, monkeypatch, capsys, number):
    def told():
        signal.raise_signal(number)
        signal.raise_signal(number)

    pressing.in_step(monkeypatch, told)(1)
    words = ["--scale", "1/4", "--views", "given", "--steps", "3", "--output", str(tmp_path / "new.ply")]
    assert main(["adapt", str(tiny.folder(tmp_path / "base")), *words]) == 128 + number
    assert "interrupted at step 1; run the same command again to continue" in capsys.readouterr().err
    assert (tmp_path / "new.ply.resume").exists() and not (tmp_path / "new.ply").exists()


def test_a_second_signal_counts_when_the_first_is_long_ago(monkeypatch):
    now = iter([100.0, 100.0 + signals.SAME_S - 1, 100.0 + signals.SAME_S + 1])  # the one between does not begin the time anew
    monkeypatch.setattr(signals.time, "monotonic", lambda: next(now))
    heard = []
    signal.signal(signal.SIGINT, lambda *_: heard.append("Ctrl-C"))
    with ends_as_by_ctrl_c():
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
    assert len(heard) == 2


def test_ctrl_c_twice_in_a_second_does_not_break_off_what_the_first_one_removes(monkeypatch):
    now = iter([100.0, 100.0 + signals.TWICE_S / 2, 101.0 + signals.TWICE_S])
    monkeypatch.setattr(signals.time, "monotonic", lambda: next(now))
    removed = []
    with pytest.raises(KeyboardInterrupt), ends_as_by_ctrl_c():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGINT)
            removed.append(True)
            signal.raise_signal(signal.SIGINT)
    assert removed and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_twice_around_the_last_step_does_not_break_off_what_follows():
    """The first is heard by the run, the second by the command."""
    removed = []
    with pytest.raises(KeyboardInterrupt, match="at step 3"), ends_as_by_ctrl_c():
        try:
            with interruptible() as interrupted:
                signal.raise_signal(signal.SIGINT)
                assert interrupted()
                raise KeyboardInterrupt("at step 3")
        finally:
            signal.raise_signal(signal.SIGINT)
            removed.append(True)
    assert removed


class Deleted:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def finalized():
    """An object whose finalizer presses Ctrl-C."""
    made = Mock()
    weakref.finalize(made, signal.raise_signal, signal.SIGINT)
    return made


@pytest.mark.parametrize("make", [Deleted, finalized])
def test_ctrl_c_while_an_object_is_deleted_is_heard_after_that(make):
    """Where Python would drop it: the live view went on once."""
    with ends_as_by_ctrl_c(), pytest.raises(KeyboardInterrupt):
        made = make()
        del made
        gc.collect()
        time.sleep(20)


@pytest.fixture
def compiling(monkeypatch):
    """A function that compiles a kernel; LLVM tells Python of that, when a signal comes whose number it is given."""
    numba, llvm = pytest.importorskip("numba"), pytest.importorskip("llvmlite.binding.executionengine")

    def compile_kernel(number):
        sent, copied = [], llvm.string_at

        def told(*arguments):
            if not sent:
                sent.append(signal.raise_signal(number))
            return copied(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(llvm, "string_at", told)
            numba.njit(lambda number: number + 1)(1)
            assert sent
        time.sleep(20)

    return compile_kernel


def test_ctrl_c_while_a_kernel_is_compiled_is_heard_after_that(compiling, capfd):
    """LLVM's call of Python dropped it, and the command ended in a traceback, as the machine code was missing."""
    with ends_as_by_ctrl_c(), pytest.raises(KeyboardInterrupt):
        compiling(signal.SIGINT)
    assert capfd.readouterr().err == ""


def test_a_signal_while_a_kernel_is_compiled_is_heard_after_that_also_where_ctrl_c_is_ignored(compiling):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with pytest.raises(KeyboardInterrupt), ends_as_by_ctrl_c() as told:
        compiling(signal.SIGTERM)
    assert told.code == 128 + signal.SIGTERM


def test_a_second_ctrl_c_while_a_kernel_is_compiled_ends_the_step_after_that(compiling, monkeypatch, capfd):
    monkeypatch.setattr(signals, "TWICE_S", 0.0)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGINT)
        compiling(signal.SIGINT)
    assert capfd.readouterr().err == ""


def test_ctrl_c_is_heard_where_the_first_was_lost():
    with pytest.raises(KeyboardInterrupt), ends_as_by_ctrl_c():
        with contextlib.suppress(KeyboardInterrupt):  # as Python does where it imports or finalizes
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it went on")


@pytest.mark.parametrize(
    ("when", "code", "err"),
    [("import tyro", 130, "mipmap-plugin: interrupted\n"), ("atexit", 0, ""), ("both", 130, "mipmap-plugin: interrupted\n")],
)
def test_ctrl_c_before_and_after_a_command_is_no_traceback(when, code, err):
    press = "lambda *_: signal.raise_signal(signal.SIGINT)"
    lines = {"import tyro": f"sys.meta_path.insert(0, types.SimpleNamespace(find_spec={press}))", "atexit": f"atexit.register({press})"}
    lines["both"] = "\n".join(lines.values())
    script = f"import atexit, signal, sys, types; sys.argv[1:] = ['--version']; import mipmap_plugin.__main__ as ours\n{lines[when]}\n"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, "-c", script + "sys.exit(ours.run())"], env=environment, capture_output=True, text=True)
    assert (abs(ended.returncode), ended.stderr) == (code, err)


def test_it_ends_also_where_ctrl_c_is_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with pytest.raises(KeyboardInterrupt), ends_as_by_ctrl_c() as told:
        signal.raise_signal(signal.SIGTERM)
    assert told.code == 128 + signal.SIGTERM


def test_what_nohup_ignores_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with ends_as_by_ctrl_c():
        signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_nothing_is_changed_afterwards():
    with ends_as_by_ctrl_c() as told:
        pass
    assert [signal.getsignal(number) for number in signals.SIGNALS] == [signal.SIG_DFL] * len(signals.SIGNALS)
    assert told.code == signals.INTERRUPTED


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.2, 0.3])
def test_a_worker_that_is_stopped_while_it_starts_says_nothing(tmp_path, capfd, seconds):
    worker = Worker(1)
    try:
        worker.begin(Job(Base(tmp_path / "base"), tmp_path / "out.ply", 0.5))
        time.sleep(seconds)
        worker.stop()
        with pytest.raises(WorkerDied):
            worker.outcome()
    finally:
        worker.close()
    assert capfd.readouterr().err == ""


def test_a_job_whose_worker_is_told_to_end_is_done_again(tmp_path, monkeypatch):
    worker, told, begin = Worker(1), [], Worker.begin

    def begin_and_tell_once(self, job):
        begin(self, job)
        if not told:
            told.append(os.kill(self._process.pid, signal.SIGTERM))

    monkeypatch.setattr(Worker, "begin", begin_and_tell_once)
    job = Job(Base(tiny.folder(tmp_path / "base")), tmp_path / "out.ply", 0.5, settings={"steps": 0, "views": "given"})
    try:
        assert do(job, worker).status == "done" and told
    finally:
        worker.close()
