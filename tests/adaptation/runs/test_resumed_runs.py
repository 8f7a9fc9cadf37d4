"""A run that is interrupted and resumed equals one that was not."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from brief_runs import BRIEF, BRIEF_PAPER, WHITE, resumed, shown, wrapped

from mipmap_plugin.adaptation.optimization.budget import Pace
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Interrupted, wrap_model


def anew(base, settings):
    """A run by a base that `base` makes each time, as another process would."""
    return lambda **resume: base().adapt(1 / 4, **settings, **resume)


def with_extras(path):
    """A checkpoint with a column that 3DGS does not know."""
    return tiny.model(40).with_extras({"confidence": np.arange(40, dtype=np.float32)}).save(path, provenance={})


@pytest.mark.parametrize("nth", [1, 2, 5, 7])  # the first step; before and after a pruning; the last step
def test_a_resumed_default_run_equals_an_uninterrupted_one(tmp_path, ctrl_c, nth):
    adapt, state = anew(wrapped, BRIEF), tmp_path / "run.resume"
    whole, again = adapt(), resumed(adapt, state, ctrl_c, nth)
    assert state.exists()  # should the disk be full, nothing is lost
    files = [adapted.save(tmp_path / f"{i}.ply").read_bytes() for i, adapted in enumerate((whole, again))]
    assert files[0] == files[1] and not state.exists()
    assert [(p.step, p.psnr_db, p.gaussians) for p in again.report.curve] == [(p.step, p.psnr_db, p.gaussians) for p in whole.report.curve]


def test_a_resumed_run_moves_no_coefficients_that_a_whole_one_leaves_alone(tmp_path, ctrl_c):
    """View-dependent color that no viewer evaluates has no gradient, also after splats were dropped."""
    base = wrap_model(VanillaModel.from_gaussians(tiny.with_bands(0, 1)), cameras=tiny.cameras(), backend="cpu")
    adapt = anew(lambda: base, BRIEF | {"returns": "last"})
    whole, again = adapt(), resumed(adapt, tmp_path / "state", ctrl_c, 5)
    assert len(whole.model) < len(base.model)
    assert all(torch.equal(tensor, again.model.parameters()[name]) for name, tensor in whole.model.parameters().items())


@pytest.mark.parametrize("nth", [2, 5])  # before and after splats were cloned
@pytest.mark.parametrize("views", [1, 2])  # two share an activation
def test_a_resumed_paper_run_equals_an_uninterrupted_one(tmp_path, ctrl_c, nth, views):
    adapt = anew(lambda: wrapped(background=WHITE), BRIEF_PAPER | {"recipe": "paper", "views_per_step": views})
    both = adapt(), resumed(adapt, tmp_path / "state", ctrl_c, nth)
    files = [adapted.model.save(tmp_path / f"{i}.ply", provenance={}).read_bytes() for i, adapted in enumerate(both)]
    assert files[0] == files[1]


@pytest.mark.parametrize(("merging", "times"), [({}, 2), ({"merge_to": 0.5, "merging_costs": 9.0}, 1)])
def test_a_run_that_is_interrupted_once_or_twice_equals_an_uninterrupted_one(tmp_path, ctrl_c, merging, times):
    adapt = anew(wrapped, BRIEF | merging)
    whole, again = adapt(), resumed(adapt, tmp_path / "state", ctrl_c, *[2] * times)
    assert torch.equal(shown(again), shown(whole))
    assert not merging or again.report.gaussians_after < again.report.gaussians_before


def test_a_resumed_run_tells_the_seconds_of_both_processes(tmp_path, ctrl_c, monkeypatch):
    """By what they were spent on: what the first made counts as no step."""
    truth = Costs.truth
    monkeypatch.setattr(Costs, "truth", lambda self, *request: (truth(self, *request), self.truths.__setitem__(request[0], 100.0))[0])
    ctrl_c(3)
    with pytest.raises(Interrupted):
        wrapped().adapt(1 / 4, resume=tmp_path / "state", **BRIEF)
    first = load_torch(tmp_path / "state")["costs"][0]
    resumed = wrapped().adapt(1 / 4, resume=tmp_path / "state", **BRIEF).report
    assert first >= 200 and resumed.seconds["pseudo truth"] >= first + 100


def test_a_run_ends_before_truths_that_its_time_budget_has_no_time_for(monkeypatch):
    truth = Costs.truth
    monkeypatch.setattr(Costs, "truth", lambda self, *request: (truth(self, *request), self.truths.__setitem__(request[0], 1e7))[0])
    base = wrap_model(tiny.model(40), cameras=tiny.cameras(), threads=1)  # several make all of these few truths at once
    report = base.adapt(1 / 4, **{**BRIEF, "time_budget_s": 1e6}).report
    assert report.ended_by.startswith("time budget") and 0 < report.curve[-1].step < BRIEF["steps"]


def test_a_resumed_run_goes_on_as_planned(tmp_path, ctrl_c, monkeypatch):
    """Of a time budget, also where the machine has become slower."""
    settings, paces = {**BRIEF, "time_budget_s": 1e6}, iter([Pace(1.0, 1.0, 1.0, 0.5), Pace(1e6, 1.0, 1.0)])
    monkeypatch.setattr(Pace, "of", classmethod(lambda *_: next(paces)))
    ctrl_c(3)
    with pytest.raises(Interrupted):
        wrapped().adapt(1 / 4, resume=tmp_path / "state", **settings)
    saved = load_torch(tmp_path / "state")
    assert (saved["planned"], saved["reserved"]) == (BRIEF["steps"], 0.5)
    resumed = wrapped().adapt(1 / 4, resume=tmp_path / "state", **settings).report
    assert resumed.ended_by == f"{BRIEF['steps']} steps" and resumed.curve[-1].step == BRIEF["steps"]


def test_extra_columns_outlive_a_resumption_unless_splats_were_dropped(tmp_path, ctrl_c):
    path = with_extras(tmp_path / "base.ply")
    for name, settings, kept in [("all", {**BRIEF, "min_opacity": 0.0}, True), ("some", {**BRIEF, "returns": "last"}, False)]:
        adapted = resumed(anew(lambda: wrap_model(path, cameras=tiny.cameras()), settings), tmp_path / "state", ctrl_c, 5)
        assert ("confidence" in read_ply(adapted.save(tmp_path / f"{name}.ply")).columns) == kept


def test_columns_that_new_splats_do_not_have_are_told_of_once_and_in_the_report(tmp_path):
    base = wrap_model(with_extras(tmp_path / "base.ply"), cameras=tiny.cameras())
    with pytest.warns(UserWarning, match="extra columns confidence are dropped") as caught:
        pruned = base.adapt(1 / 4, **BRIEF, returns="last")
    assert len(caught) == len(pruned.report.notes) == 1
    assert base.adapt(1 / 4, steps=0, merge_to=1.0).report.notes == []  # whose splats are those of the base


def test_a_reset_of_opacities_keeps_extra_columns(tmp_path):
    model = wrap_model(with_extras(tmp_path / "base.ply"), cameras=tiny.cameras(), background=WHITE)
    saved = model.adapt(1 / 4, recipe="paper", steps=3).save(tmp_path / "new.ply")
    assert "confidence" in read_ply(saved).columns


def test_a_state_is_refused_with_anything_else_than_its_own_run(tmp_path, ctrl_c):
    ctrl_c(1)
    state = tmp_path / "state"
    with pytest.raises(Interrupted):
        wrapped().adapt(1 / 4, resume=state, **BRIEF)
    others = [
        (wrapped(), 1 / 4, {**BRIEF, "seed": 1}),
        (wrapped(), 1 / 2, BRIEF),
        (wrapped(cameras=tiny.cameras(3)), 1 / 4, BRIEF),
        (wrapped(cameras=[replace(camera, cx=camera.cx + 1) for camera in tiny.cameras()]), 1 / 4, BRIEF),
        (wrapped(background=WHITE), 1 / 4, BRIEF),
        (wrapped(screen_filter="antialiased"), 1 / 4, BRIEF),
        (wrapped(41), 1 / 4, BRIEF),
        (wrapped(), 1 / 4, {**BRIEF, "viewer": "spark"}),
    ]
    for model, scale, settings in others:
        with pytest.raises(SettingsError, match="belongs to another base, settings or views; repeat the run with those, or delete it"):
            model.adapt(scale, resume=state, **settings)
    assert state.exists()


def test_a_file_that_is_no_state_is_refused(tmp_path):
    (tmp_path / "state").write_text("no state")
    with pytest.raises(SettingsError, match=r"state: not the state of an interrupted run \(\w+\); delete it to start anew"):
        wrapped().adapt(1 / 4, resume=tmp_path / "state", **BRIEF)
