"""What ends a run early: Ctrl-C, an observer, the time budget or the knee."""

import re
import signal
import threading

import numpy as np
import pressing
import pytest
import torch
from brief_runs import BRIEF, shown, wrapped

from mipmap_plugin.adaptation.optimization import loop, resume
from mipmap_plugin.adaptation.optimization.budget import Pace
from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.process import signals
from mipmap_plugin.wrap import Interrupted


@pytest.fixture
def slowly(monkeypatch):
    """Ctrl-C is never pressed twice in a second."""
    monkeypatch.setattr(signals, "TWICE_S", 0.0)


def test_a_second_ctrl_c_ends_a_step_without_saving(tmp_path, monkeypatch, slowly):
    pressing.in_step(monkeypatch, lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)])(3)
    with pytest.raises(KeyboardInterrupt) as ended:
        wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)
    assert not isinstance(ended.value, Interrupted) and not (tmp_path / "run.resume").exists()


def test_ctrl_c_twice_in_a_second_is_once(tmp_path, monkeypatch):
    pressing.in_step(monkeypatch, lambda: [signal.raise_signal(signal.SIGINT) for _ in range(3)])(3)
    with pytest.raises(Interrupted, match="interrupted at step 3; run the same command again"):
        wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)


def test_a_second_ctrl_c_while_the_state_is_saved_does_not_lose_it(tmp_path, monkeypatch, ctrl_c, slowly):
    whole, save = wrapped().adapt(1 / 4, **BRIEF), resume.save_torch

    def pressed(*words, **options):
        signal.raise_signal(signal.SIGINT)
        save(*words, **options)

    ctrl_c(3)
    with monkeypatch.context() as saving, pytest.raises(Interrupted, match="interrupted at step 3; run the same command again"):
        saving.setattr(resume, "save_torch", pressed)
        wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)
    assert torch.equal(shown(wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)), shown(whole))


def test_ctrl_c_after_the_last_step_is_heard(tmp_path, monkeypatch):
    whole, undo = wrapped().adapt(1 / 4, **BRIEF), loop.undo_harmful_growth
    with monkeypatch.context() as pressed:
        pressed.setattr(loop, "undo_harmful_growth", lambda *run: (signal.raise_signal(signal.SIGINT), undo(*run)))
        with pytest.raises(Interrupted, match=f"interrupted at step {BRIEF['steps']}; run the same command again"):
            wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)
    assert torch.equal(shown(wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)), shown(whole))


def test_an_observer_may_interrupt_a_run(tmp_path):
    """As Ctrl-C does, which may reach it twice, or by another way than ours."""

    def observe(step, *_):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match=r"interrupted at step 3; run the same command again to continue from .*run.resume"):
        wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", observe=observe, **BRIEF)
    resumed = wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)
    assert torch.equal(shown(resumed), shown(wrapped().adapt(1 / 4, **BRIEF)))


def test_ctrl_c_without_a_file_to_resume_from_says_so(ctrl_c):
    ctrl_c(1)
    with pytest.raises(Interrupted, match="interrupted at step 1; nothing was written, because no file to resume from was named"):
        wrapped().adapt(1 / 4, **BRIEF)


@pytest.fixture
def handled_by():
    """Return a function that sets a program's own handler of Ctrl-C, which is undone after the test."""
    before = signal.getsignal(signal.SIGINT)
    yield lambda handler: signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_is_told_to_the_program_s_own_handler(handled_by, ctrl_c):
    """Which decides: a training that ends after its iteration, or a server."""
    heard = []
    handled_by(lambda number, frame: heard.append(number))
    ctrl_c(3)
    report = wrapped().adapt(1 / 4, **BRIEF).report
    assert (heard, report.ended_by) == ([signal.SIGINT], f"{BRIEF['steps']} steps")


def test_a_handler_that_interrupts_does_so_between_two_steps(handled_by, ctrl_c, tmp_path):
    def interrupt(number, frame):
        raise KeyboardInterrupt

    handled_by(interrupt)
    ctrl_c(3)
    with pytest.raises(Interrupted, match="interrupted at step 3; run the same command again to continue"):
        wrapped().adapt(1 / 4, resume=tmp_path / "run.resume", **BRIEF)
    assert signal.getsignal(signal.SIGINT) is interrupt


def test_ctrl_c_that_a_program_ignores_stays_ignored(handled_by, ctrl_c):
    """Workers of a pool, and what a script starts in the background."""
    handled_by(signal.SIG_IGN)
    ctrl_c(3)
    assert wrapped().adapt(1 / 4, **BRIEF).report.ended_by == f"{BRIEF['steps']} steps"


def test_a_command_that_ignores_ctrl_c_can_be_told_to_end(handled_by):
    handled_by(signal.SIG_IGN)
    with signals.ends_as_by_ctrl_c(), interruptible() as interrupted:
        signal.raise_signal(signal.SIGTERM)
        assert interrupted()


@pytest.mark.parametrize("handler", [signal.SIG_DFL, None])
def test_a_handler_that_python_could_not_call_is_left_alone(handler, monkeypatch):
    """None is what Python says of one that another language has set."""
    monkeypatch.setattr(signal, "getsignal", lambda number: handler)
    monkeypatch.setattr(signal, "signal", lambda *_: pytest.fail("the handler was replaced"))
    with interruptible() as interrupted:
        assert not interrupted()


def test_adapting_in_a_thread():
    done = []
    thread = threading.Thread(target=lambda: done.append(wrapped().adapt(1 / 4, steps=1, extra_views=0)))
    thread.start()
    thread.join()
    assert done[0].report.ended_by == "1 step"


def test_the_time_budget_ends_the_run():
    with pytest.warns(UserWarning, match="time budget of 1e-06 s left no time"):
        report = wrapped().adapt(1 / 4, time_budget_s=1e-6, **BRIEF).report
    assert report.ended_by == "time budget of 1e-06 s, all of which the start took"
    [note] = [note for note in report.notes if "left no time for steps" in note]
    assert re.fullmatch(r"the time budget of 1e-06 s left no time for steps after the start; give \d+ s or more to have some", note)


def test_the_choice_that_is_reserved_for_is_not_told_as_the_start(monkeypatch):
    monkeypatch.setattr(Pace, "of", classmethod(lambda *_: Pace(1.0, 1.0, 1.0, 1e6)))
    report = wrapped().adapt(1 / 4, time_budget_s=1e4, **BRIEF).report
    assert report.ended_by == "time budget of 10000 s, not enough for a step beside the start and the choice of a state"


def test_steps_that_were_planned_for_a_time_budget_are_told(monkeypatch):
    monkeypatch.setattr(Pace, "of", classmethod(lambda *_: Pace(6e3, 0.0, 0.0)))
    report = wrapped().adapt(1 / 4, time_budget_s=1e4, **BRIEF).report
    assert report.ended_by == "1 step (planned for the time budget in place of 7)" and report.settings.steps == 7


@pytest.mark.parametrize(("patience", "told"), [(1, "1 check"), (2, "2 checks")])
def test_the_knee_ends_the_run(patience, told):
    report = wrapped().adapt(1 / 4, **{**BRIEF, "steps": 50, "check_every": 1, "patience": patience, "min_gain_db": 1000}).report
    assert report.ended_by == f"knee: {told} in a row gained less than 1000 dB"
    assert report.curve[-1].step == patience + 1


@pytest.mark.parametrize("answer", [True, np.float64(1) < 2, torch.ones(()) < 2])
def test_an_observer_ends_a_run_by_true_of_any_library(answer):
    assert wrapped().adapt(1 / 4, **BRIEF, observe=lambda step, *_: step == 2 and answer).report.ended_by == "its observer"


@pytest.mark.parametrize("answer", [None, 1, "yes", torch.ones(2, 2), [True]])
def test_no_other_answer_of_an_observer_ends_a_run(answer):
    assert wrapped().adapt(1 / 4, **BRIEF, observe=lambda *_: answer).report.ended_by == "7 steps"
