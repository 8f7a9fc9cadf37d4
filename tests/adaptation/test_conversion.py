"""A zoom-in for a renderer that draws otherwise than the training did: the conversion before it."""

import gc
import signal
import weakref
from dataclasses import replace

import pytest
import tiny

from mipmap_plugin.adaptation.conversion import conversion, learned
from mipmap_plugin.adaptation.optimization.budget import Pace
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.adaptation.session import Session
from mipmap_plugin.adaptation.start import base_weights
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.torch_file import load_torch, save_torch
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.outputs import is_adapted
from mipmap_plugin.models.places import conversion_state, state_path
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import Interrupted, wrap_model

BASE, OTHER = Effects(1), Effects(1, "antialiased")
BRIEF = dict(steps=3, extra_views=4, validation_views=4)


def wrapped(screen_filter="classic"):
    return wrap_model(tiny.model(60, TrainedScale(screen_filter)), cameras=tiny.cameras(8), backend="cpu", threads=1)


def pressing_at(steps, nth):
    """An observer that notes the steps, and presses Ctrl-C in the nth."""

    def press(step, seconds, render):
        steps.append(step)
        if len(steps) == nth:
            signal.raise_signal(signal.SIGINT)

    return press


def settings_of(scale=2.0, targets=(OTHER,), **settings):
    return conversion(recipe("default", scale, **settings), BASE, targets, scale)


@pytest.mark.parametrize(
    ("scale", "targets", "settings"),
    [
        (2.0, (BASE,), {}),
        (2.0, (OTHER, Effects(1, "mip")), {}),
        (0.5, (OTHER,), {}),
        (1.0, (OTHER,), {}),
        (2.0, (OTHER,), dict(steps=0)),
        (2.0, (OTHER,), dict(conversion_steps=0)),
    ],
    ids=["nothing to learn", "several viewers", "a zoom-out", "a conversion itself", "no steps", "none wanted"],
)
def test_where_there_is_none(scale, targets, settings):
    assert settings_of(scale, targets, **settings) is None


def test_its_settings_are_those_of_the_recipe_at_the_bases_scale():
    first = settings_of(seed=7, views="train", most_splats=99, time_budget_s=8.0)
    at_base = recipe("default", 1.0)
    assert (first.rates, first.views_per_step, first.compare_at) == (at_base.rates, at_base.views_per_step, at_base.compare_at)
    assert (first.seed, first.views, first.most_splats, first.time_budget_s) == (7, "train", 99, 4.0)


def test_it_takes_no_more_steps_than_the_zoom_in_may():
    assert settings_of(steps=20, time_budget_s=600.0).most_steps is None  # whatever time is left
    assert settings_of(steps=20).steps == 20 and settings_of(steps=10_000).steps == recipe("default", 2.0).conversion_steps


def test_a_zoom_in_starts_from_it_and_tells_so():
    report = wrapped().adapt(2, viewer="antialiased", **BRIEF).report
    assert report.notes[-1].startswith("converted at x1 before, ") and report.notes[-1].endswith(", in 3 steps")
    assert 0 < report.seconds["conversion"] < report.seconds["total"]
    assert report.curve[0].seconds > report.seconds["conversion"]


@pytest.mark.parametrize("budget", [None, 600.0], ids=["all steps", "in a time budget"])
def test_a_zoom_in_starts_without_it_where_that_is_better(budget):
    """At x1 the classic filter is wider than that of this base, which is wider than the classic one of x2."""
    base = wrap_model(tiny.model(60, TrainedScale("mip", 0.1)), cameras=tiny.cameras(8), backend="cpu", threads=1)
    validation = base.adapt(2, viewer="classic", time_budget_s=budget, **BRIEF).report.validation
    direct = base.adapt(2, viewer="classic", time_budget_s=budget, **BRIEF, conversion_steps=0).report.validation
    assert validation["the start, the closed form without the conversion"] == direct["the start, the closed form"]


def test_views_that_lose_are_told_of_the_file_alone():
    """Of the conversion, which nobody sees, it was said too that it is the file, with other dB."""
    views = [replace(view, fx=times * view.fx, fy=times * view.fy) for view, times in zip(tiny.cameras(8), (1, 3) * 4, strict=True)]
    with pytest.warns(UserWarning, match="the file for x2 looks worse than the base"):
        report = wrap_model(tiny.model(20), cameras=views).adapt(2, viewer="antialiased", steps=30, seed=4).report
    assert sum(" looks worse than the base" in note for note in report.notes) == 1


def test_the_first_stage_is_forgotten_before_the_second(monkeypatch):
    """The truths of its views take megabytes, and nothing reads them any more."""
    stages, left = [], []
    run = Session.run

    def watched(session, *arguments):
        gc.collect()
        left.append([stage() for stage in stages])
        done = run(session, *arguments)
        stages.extend((weakref.ref(session), weakref.ref(done.judge)))
        return done

    monkeypatch.setattr(Session, "run", watched)
    wrapped().adapt(2, viewer="antialiased", **BRIEF)
    assert left == [[], [None, None]]


def test_what_no_view_shows_is_told_once_and_of_the_base(monkeypatch):
    monkeypatch.setattr(base_weights, "HIDDEN", -1.0)  # each start would tell of it
    with pytest.warns(UserWarning, match="no view shows") as said:
        report = wrapped().adapt(2, viewer="antialiased", **BRIEF).report
    assert ["no view shows" in str(warning.message) for warning in said].count(True) == 1
    assert ["no view shows" in note for note in report.notes].count(True) == 1


def test_it_brings_a_zoom_in_closer_to_the_base():
    base = wrapped()

    def quality(**settings):
        adapted = base.adapt(2, viewer="antialiased", **(BRIEF | settings))
        halves = [adapted.render(view.zoomed(2)).image.view(24, 2, 32, 2, 3).mean((1, 3)) for view in tiny.cameras(3, seed=5)]
        truths = [base.render(view).image for view in tiny.cameras(3, seed=5)]
        return sum(map(psnr, halves, truths)) / 3

    assert quality(steps=40) > quality(steps=40, conversion_steps=0) + 0.5


@pytest.mark.parametrize("nth", [2, 6], ids=["in the conversion", "in the zoom-in"])
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path, nth):
    whole = wrapped().adapt(2, viewer="antialiased", **BRIEF)
    state, steps = tmp_path / "run.resume", []
    press = pressing_at(steps, nth)
    with pytest.raises(Interrupted, match=f"continue from .*run.resume{'.x1' if nth == 2 else ''}$"):
        wrapped().adapt(2, viewer="antialiased", resume=state, observe=press, **BRIEF)
    assert steps == [0, 1, 2, 3, 4, 5][:nth]
    resumed = wrapped().adapt(2, viewer="antialiased", resume=state, observe=press, **BRIEF)
    assert steps[nth:] == ([1, 2, 3, 4, 5, 6] if nth == 2 else [5, 6])  # what the conversion did is not done again
    assert list(tmp_path.glob("*.resume.x1"))  # should the disk be full, nothing is lost
    files = [adapted.save(tmp_path / f"{i}.ply").read_bytes() for i, adapted in enumerate((whole, resumed))]
    assert files[0] == files[1] and not list(tmp_path.glob("*resume*"))


def test_what_the_conversion_kept_stays_where_the_zoom_in_is_refused(tmp_path):
    """As by a state of another version."""
    state = tmp_path / "run.resume"
    with pytest.raises(Interrupted):
        wrapped().adapt(2, viewer="antialiased", resume=state, observe=pressing_at([], 6), **BRIEF)
    content = load_torch(state)
    save_torch(state, content | {"fingerprint": "", "versions": {"mipmap_plugin": "0.0.1"}}, overwrite=True)
    with pytest.raises(SettingsError, match=r"run.resume: this state was left by mipmap_plugin 0\.0\.1, and this is .*; go on with that"):
        wrapped().adapt(2, viewer="antialiased", resume=state, **BRIEF)
    assert state.exists() and (tmp_path / "run.resume.x1").exists()


def test_a_time_budget_is_for_both_and_told_as_it_was_given(monkeypatch):
    budgets, run = [], Session.run
    monkeypatch.setattr(Session, "run", lambda self, *given: budgets.append(self.config.time_budget_s) or run(self, *given))
    report = wrapped().adapt(2, viewer="antialiased", time_budget_s=60.0, **BRIEF).report
    assert budgets == [30.0, 30.0] and report.settings.time_budget_s == 60.0 and report.ended_by == "3 steps"


@pytest.mark.parametrize("learned", [True, False])
def test_a_budget_with_time_for_one_start_tries_the_more_promising_one(monkeypatch, learned):
    """The conversion is that if its steps have bettered it."""
    monkeypatch.setattr(Clock, "allows", lambda clock, work, *_: work != "start")
    monkeypatch.setattr("mipmap_plugin.adaptation.conversion.learned", lambda _: learned)
    report = wrapped().adapt(2, viewer="antialiased", time_budget_s=600.0, **BRIEF).report
    [start] = [state for state in report.validation if state.startswith("the start")]
    assert ("without the conversion" in start) != learned


@pytest.mark.parametrize(("after", "learns"), [(31.0, True), (30.0, False), (29.0, False)])
def test_a_conversion_has_learned_if_its_steps_beat_base_and_start(after, learns):
    report = wrapped().adapt(1, viewer="antialiased", recipe="instant").report
    validation = {AS_IT_IS: 20.0, "the start, the closed form": 30.0, "the last state": after}
    assert learned(report.model_copy(update={"validation": validation, "returned": "the last state"})) == learns
    assert not learned(report.model_copy(update={"validation": {}}))


def test_a_budget_that_both_stages_start_takes_is_told_whole_and_once():
    with pytest.warns(UserWarning, match="the time budget of 0.001 s left no time for steps") as said:
        spent = wrapped().adapt(2, viewer="antialiased", time_budget_s=1e-3, **BRIEF).report
    assert spent.ended_by == "time budget of 0.001 s, all of which the conversion and the start took"
    assert [("time budget of" in str(warning.message)) for warning in said].count(True) == 1
    assert [("time budget of 0.001 s" in note) for note in spent.notes].count(True) == 1


def test_what_the_choice_takes_of_a_budget_is_told_beside_both_starts(monkeypatch):
    monkeypatch.setattr(Pace, "of", classmethod(lambda *_: Pace(1.0, 1.0, 1.0, 1e6)))
    with pytest.warns(UserWarning, match="give [0-9]{7} s or more"):  # of which each stage has a half, and its start half of that
        report = wrapped().adapt(2, viewer="antialiased", time_budget_s=1e4, **BRIEF).report
    assert report.ended_by == "time budget of 10000 s, not enough for a step beside the conversion, the start and the choice of a state"


def test_with_a_budget_too_what_has_ended_is_not_taken_further(tmp_path, monkeypatch):
    """What time is left would be enough for further steps of the conversion, of which another zoom-in would come."""
    budget = {**BRIEF, "steps": 20, "time_budget_s": 60.0}
    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.budget.Pace.steps", lambda *_: 3)
    state, steps = tmp_path / "run.resume", []
    press = pressing_at(steps, 6)
    with pytest.raises(Interrupted):
        wrapped().adapt(2, viewer="antialiased", resume=state, observe=press, **budget)
    wrapped().adapt(2, viewer="antialiased", resume=state, observe=press, **budget)
    assert steps[:4] == [0, 1, 2, 3] and steps[6] == steps[5] and steps[-1] <= 23


def test_a_zoom_in_that_fails_leaves_no_state(tmp_path):
    def fail(step, seconds, render):
        if step == 4:
            raise RuntimeError("no memory")

    with pytest.raises(RuntimeError):
        wrapped().adapt(2, viewer="antialiased", resume=tmp_path / "run.resume", observe=fail, **BRIEF)
    assert not list(tmp_path.glob("*resume*"))


def test_an_observer_sees_steps_and_seconds_of_both_counted_on():
    seen = []
    report = wrapped().adapt(2, viewer="antialiased", observe=lambda step, seconds, _: seen.append((step, seconds)) and None, **BRIEF).report
    assert [step for step, _ in seen] == [0, 1, 2, 3, 4, 5, 6] and seen == sorted(seen)
    assert seen[4][1] > report.seconds["conversion"]


def test_states_of_conversions_are_known_as_such(tmp_path):
    state = conversion_state(state_path(tmp_path / "out.ply"))
    assert state.name == "out.ply.resume.x1" and is_adapted(state)


def test_an_observer_that_ends_the_conversion_ends_the_run():
    steps = []
    report = wrapped().adapt(2, viewer="antialiased", observe=lambda step, *_: steps.append(step) or step == 1, **BRIEF).report
    assert steps == [0, 1] and report.ended_by == "0 steps" and "ended by its observer" in report.notes[-1]


def test_a_file_in_the_filter_of_its_training_is_not_converted():
    report = wrapped().adapt(2, **BRIEF).report
    assert "conversion" not in report.seconds and not report.notes
