"""wrap_model(...).adapt(...): the base stays, the same seed gives the same bytes, and every recipe ends well in every hard case."""

import hashlib
import json
import math
import re
import signal
import threading
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pressing
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization import loop, resume
from mipmap_plugin.adaptation.optimization.budget import Pace
from mipmap_plugin.adaptation.optimization.estimate import Costs
from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.adaptation.report import PeakMemory
from mipmap_plugin.adaptation.session import Session
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views import remarks
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.errors import BackendUnavailable, OutputExists, SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of, render_mode
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.process import signals
from mipmap_plugin.recipes import DEFAULT_IN
from mipmap_plugin.wrap import Interrupted, wrap_model

WHITE = (1.0, 1.0, 1.0)

# A few steps in which everything happens: both ways to choose views, two views a step, points of the curve, and splats that are dropped.
BRIEF = dict(steps=7, views_per_step=2, merge_to=1.0, extra_views=2, check_every=2, prune_every=3, min_opacity=0.4, patience=None, warm_up=0)
BRIEF_PAPER = dict(steps=7, check_every=2, prune_every=3, densify_gradient=1e-9)


def wrapped(count=40, cameras=None, backend="auto", **trained):
    return wrap_model(tiny.model(count, TrainedScale(**trained)), cameras=tiny.cameras() if cameras is None else cameras, backend=backend)


def is_finite(model) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in model.parameters().values())


def shown(adapted):
    """What the adapted model shows of the first camera, at its scale."""
    return adapted.render(tiny.cameras()[0].zoomed(adapted.report.scale)).image


# Recipes


@pytest.mark.parametrize("scale", [1 / 4, 4])
@pytest.mark.parametrize(("recipe", "settings"), [("default", BRIEF), ("paper", BRIEF_PAPER), ("instant", {})])
def test_every_recipe_runs_and_its_report_is_whole(recipe, settings, scale):
    adapted = wrapped(backend="cpu").adapt(scale, recipe=recipe, **settings)
    report = json.loads(json.dumps(adapted.report.model_dump()))
    steps = settings.get("steps", 0)
    assert (report["scale"], report["settings"]["recipe"], report["ended_by"]) == (scale, recipe, f"{steps} steps")
    assert report["backend"] == "cpu: requested"
    assert (report["gaussians_before"], report["gaussians_after"]) == (40, len(adapted.model))
    assert [point["step"] for point in report["curve"]] == [*range(0, steps, 2), *([steps] if steps else [0])]
    assert all(math.isfinite(point["validation_db"]) for point in report["curve"])
    assert report["returned"].startswith(tuple(report["validation"]))
    assert report["seconds"]["total"] >= report["seconds"]["optimization"] >= 0
    assert ("closed form" in report["seconds"]) == (recipe != "paper")
    assert {"torch", "mipmap_plugin"} <= report["versions"].keys()
    assert is_finite(adapted.model) and shown(adapted).isfinite().all()


def test_zooming_in_comes_closer_to_what_the_base_shows_at_its_own_scale():
    model, view, seen = wrapped(), tiny.cameras()[0], []
    model.adapt(4, views="given", steps=20, crispness=0.25, observe=lambda step, seconds, render: seen.append(render(view.zoomed(4)).clamp(0, 1)))
    base = model.render(view).image.clamp(0, 1)
    shrunk = [resize(image, base.shape[:2], "area") for image in (seen[0], seen[-1])]
    assert psnr(shrunk[1], base) > psnr(shrunk[0], base) + 1


def test_optimizing_comes_closer_to_the_pseudo_truth():
    curve = wrapped().adapt(1 / 4, views="given", steps=24, check_every=8).report.curve
    assert curve[0].psnr_db is None and curve[1].psnr_db < curve[2].psnr_db < curve[3].psnr_db
    assert curve[0].seconds < curve[3].seconds


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased"])
def test_zoomed_out_views_that_nobody_adapted_to_are_closer_to_the_supersampled_base(screen_filter):
    model = wrapped(60, screen_filter=screen_filter)
    started, adapted = model.adapt(1 / 4, recipe="instant"), model.adapt(1 / 4, steps=40, extra_views=8)
    for camera in tiny.cameras(2, seed=9):
        small = camera.zoomed(1 / 4)
        truth = model.render(small, 1 / 4, "scaled", supersampling=4).image
        images = model.render(small, 1 / 4, "classic").image, started.render(small).image, adapted.render(small).image
        naive, first, final = (psnr(image, truth) for image in images)
        assert naive + 15 < first and final > first + (1.3 if screen_filter == "classic" else 0.3)


def test_the_paper_leaves_the_centers_bit_for_bit():
    model = wrapped()
    adapted = model.adapt(1 / 4, recipe="paper", steps=3)
    before, after = model.model.parameters(), adapted.model.parameters()
    assert torch.equal(after["means"], before["means"])
    assert not torch.equal(after["scales"], before["scales"])


def test_the_default_moves_the_centers():
    model = wrapped()
    assert not torch.equal(model.adapt(1 / 4, steps=1, extra_views=0).model.parameters()["means"], model.model.parameters()["means"])


def test_the_paper_resets_opacities_on_white_only():
    white, black = (wrapped(background=color).adapt(1 / 4, recipe="paper", steps=3).model.row_opacities() for color in (WHITE, (0.0, 0.0, 0.0)))
    assert white.max() < 0.012 < 0.2 < black.min()


def test_densifying_adds_splats_and_pruning_takes_them_away():
    assert wrapped().adapt(1 / 4, recipe="paper", **BRIEF_PAPER).report.gaussians_after > 40
    assert 0 < wrapped().adapt(1 / 4, returns="last", **BRIEF).report.gaussians_after < 40


@pytest.mark.parametrize("screen_filter", ["antialiased", "mip"])
def test_without_a_viewer_the_file_is_drawn_as_the_base_was(screen_filter):
    base = wrapped(screen_filter=screen_filter)
    adapted = base.adapt(4, recipe="instant")
    assert adapted.effects == base.effects() and adapted.model.trained.screen_filter == screen_filter
    assert adapted.report.as_trained is None and not any("as its training drew it" in note for note in adapted.report.notes)
    small = base.cameras[0].zoomed(4)
    assert adapted.report.psnr_before() is not None and base.render(small).image.shape == adapted.render(small).image.shape


# Purity


def test_the_base_stays_bit_for_bit(tmp_path):
    path = tiny.folder(tmp_path / "base")
    model = wrap_model(path)
    file = model.model.source
    digest, before = hashlib.sha256(file.read_bytes()).hexdigest(), {name: tensor.clone() for name, tensor in model.model.parameters().items()}
    trained = model.model.trained
    model.adapt(1 / 4, **BRIEF).save(tmp_path / "new.ply")
    model.adapt(1 / 4, recipe="paper", **BRIEF_PAPER)
    assert hashlib.sha256(file.read_bytes()).hexdigest() == digest == model.model.digest
    for name, tensor in model.model.parameters().items():
        assert torch.equal(tensor, before[name]) and not tensor.requires_grad and tensor.grad is None
    assert model.model.trained == trained


@pytest.mark.parametrize(("recipe", "settings"), [("default", BRIEF), ("paper", BRIEF_PAPER)])
def test_the_same_seed_gives_the_same_bytes(tmp_path, recipe, settings):
    first, again, other = (wrapped().adapt(1 / 4, recipe=recipe, seed=seed, **settings).model for seed in (3, 3, 4))
    files = [model.save(tmp_path / f"{i}.ply", provenance={}).read_bytes() for i, model in enumerate((first, again, other))]
    assert files[0] == files[1] != files[2]


def test_the_global_generator_is_neither_used_nor_disturbed():
    torch.manual_seed(5)
    state = torch.get_rng_state()
    wrapped().adapt(1 / 4, recipe="paper", **BRIEF_PAPER)
    assert torch.equal(torch.get_rng_state(), state)


# Ctrl-C and resuming


@pytest.fixture
def ctrl_c(monkeypatch):
    """Called with n, Ctrl-C is pressed in the nth step from then on."""
    return pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))


def with_extras(path):
    """A checkpoint with a column that 3DGS does not know."""
    model = tiny.model(40)
    return VanillaModel(model.parameters(), origin=Origin(extras={"confidence": np.arange(40, dtype=np.float32)})).save(path, provenance={})


@pytest.mark.parametrize("nth", [1, 2, 5, 7])  # the first step; before and after a pruning; the last step
def test_a_resumed_default_run_equals_an_uninterrupted_one(tmp_path, ctrl_c, nth):
    whole = wrapped().adapt(1 / 4, **BRIEF)
    ctrl_c(nth)
    state = tmp_path / "run.resume"
    with pytest.raises(Interrupted, match=rf"interrupted at step {nth}; run the same command again to continue from .*run.resume"):
        wrapped().adapt(1 / 4, resume=state, **BRIEF)
    resumed = wrapped().adapt(1 / 4, resume=state, **BRIEF)
    assert state.exists()  # should the disk be full, nothing is lost
    files = [adapted.save(tmp_path / f"{i}.ply").read_bytes() for i, adapted in enumerate((whole, resumed))]
    assert files[0] == files[1] and not state.exists()
    assert [(p.step, p.psnr_db, p.gaussians) for p in resumed.report.curve] == [(p.step, p.psnr_db, p.gaussians) for p in whole.report.curve]


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


def test_a_resumed_run_moves_no_coefficients_that_a_whole_one_leaves_alone(tmp_path, ctrl_c):
    """View-dependent color that no viewer evaluates has no gradient, also after splats were dropped."""
    base = wrap_model(VanillaModel.from_gaussians(tiny.with_bands(0, 1)), cameras=tiny.cameras(), backend="cpu")
    whole = base.adapt(1 / 4, **BRIEF, returns="last")
    ctrl_c(5)
    with pytest.raises(Interrupted):
        base.adapt(1 / 4, resume=tmp_path / "state", **BRIEF, returns="last")
    resumed = base.adapt(1 / 4, resume=tmp_path / "state", **BRIEF, returns="last")
    assert len(whole.model) < len(base.model)
    assert all(torch.equal(tensor, resumed.model.parameters()[name]) for name, tensor in whole.model.parameters().items())


@pytest.mark.parametrize("nth", [2, 5])  # before and after splats were cloned
@pytest.mark.parametrize("views", [1, 2])  # two share an activation
def test_a_resumed_paper_run_equals_an_uninterrupted_one(tmp_path, ctrl_c, nth, views):
    settings = {**BRIEF_PAPER, "views_per_step": views}
    whole = wrapped(background=WHITE).adapt(1 / 4, recipe="paper", **settings).model
    ctrl_c(nth)
    with pytest.raises(Interrupted):
        wrapped(background=WHITE).adapt(1 / 4, recipe="paper", resume=tmp_path / "state", **settings)
    resumed = wrapped(background=WHITE).adapt(1 / 4, recipe="paper", resume=tmp_path / "state", **settings).model
    files = [model.save(tmp_path / f"{i}.ply", provenance={}).read_bytes() for i, model in enumerate((whole, resumed))]
    assert files[0] == files[1]


def test_a_run_interrupted_twice_equals_an_uninterrupted_one(tmp_path, ctrl_c):
    whole = wrapped().adapt(1 / 4, **BRIEF)
    for _ in range(2):
        ctrl_c(2)
        with pytest.raises(Interrupted):
            wrapped().adapt(1 / 4, resume=tmp_path / "state", **BRIEF)
    resumed = wrapped().adapt(1 / 4, resume=tmp_path / "state", **BRIEF)
    assert torch.equal(shown(resumed), shown(whole))


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
    report = wrapped().adapt(1 / 4, **{**BRIEF, "time_budget_s": 1e6}).report
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


def test_a_resumed_run_merges_as_the_whole_one_did(tmp_path, ctrl_c):
    merging = {**BRIEF, "merge_to": 0.5, "merging_costs": 9.0}
    whole = wrapped().adapt(1 / 4, **merging)
    ctrl_c(3)
    with pytest.raises(Interrupted):
        wrapped().adapt(1 / 4, resume=tmp_path / "state", **merging)
    resumed = wrapped().adapt(1 / 4, resume=tmp_path / "state", **merging)
    assert resumed.report.gaussians_after < resumed.report.gaussians_before
    assert torch.equal(shown(resumed), shown(whole))


def test_extra_columns_outlive_a_resumption_unless_splats_were_dropped(tmp_path, ctrl_c):
    path = with_extras(tmp_path / "base.ply")
    for name, settings, kept in [("all", {**BRIEF, "min_opacity": 0.0}, True), ("some", {**BRIEF, "returns": "last"}, False)]:
        ctrl_c(5)
        with pytest.raises(Interrupted):
            wrap_model(path, cameras=tiny.cameras()).adapt(1 / 4, resume=tmp_path / "state", **settings)
        resumed = wrap_model(path, cameras=tiny.cameras()).adapt(1 / 4, resume=tmp_path / "state", **settings)
        assert ("confidence" in read_ply(resumed.save(tmp_path / f"{name}.ply")).columns) == kept


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


def test_ctrl_c_without_a_file_to_resume_from_says_so(ctrl_c):
    ctrl_c(1)
    with pytest.raises(Interrupted, match="interrupted at step 1; nothing was written, because no file to resume from was named"):
        wrapped().adapt(1 / 4, **BRIEF)


def test_a_second_ctrl_c_is_immediate_and_the_old_handler_comes_back(slowly):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_adapting_in_a_thread():
    done = []
    thread = threading.Thread(target=lambda: done.append(wrapped().adapt(1 / 4, steps=1, extra_views=0)))
    thread.start()
    thread.join()
    assert done[0].report.ended_by == "1 steps"


# Ending early


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
    assert report.ended_by == "1 steps (planned for the time budget in place of 7)" and report.settings.steps == 7


def test_the_knee_ends_the_run():
    report = wrapped().adapt(1 / 4, **{**BRIEF, "steps": 50, "check_every": 1, "patience": 2, "min_gain_db": 1000}).report
    assert report.ended_by == "knee: 2 checks in a row gained less than 1000 dB"
    assert report.curve[-1].step == 3


# Hard cases


def black_on_black() -> VanillaModel:
    splats = tiny.gaussians(5)
    return VanillaModel.from_gaussians(replace(splats, sh=torch.full((5, 1, 3), -9.0)))


@pytest.mark.parametrize("recipe", ["default", "paper"])
def test_no_gradient_at_all_leaves_finite_splats(recipe):
    model = wrap_model(black_on_black(), cameras=tiny.cameras(1))
    adapted = model.adapt(1 / 4, recipe=recipe, views="given", steps=3, prune_every=2, merge_to=1.0)
    assert is_finite(adapted.model) and len(adapted.model) == 5


@pytest.mark.parametrize("settings", [dict(min_opacity=0.99, returns="last"), dict(min_opacity=0.99, recipe="paper", densify_gradient=1e-9)])
def test_everything_pruned_leaves_one_splat(settings):
    adapted = wrapped().adapt(1 / 4, **{"views": "given", "steps": 5, "prune_every": 1, **settings})
    assert is_finite(adapted.model) and adapted.report.gaussians_after == 1


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("views", ["given", "jittered"])
def test_one_view_and_the_same_view_twice(views, count):
    adapted = wrapped(cameras=tiny.cameras(1) * count).adapt(1 / 4, views=views, steps=3, extra_views=2, check_every=3)
    assert is_finite(adapted.model) and adapted.report.curve[-1].psnr_db > 20


@pytest.mark.parametrize(("scale", "size"), [(64, (4, 3)), (1 / 64, (32, 24)), (0.3, (31, 23)), (1e-9, (32, 24))])
@pytest.mark.parametrize("recipe", ["default", "paper"])
def test_extreme_and_crooked_scales(recipe, scale, size):
    views = tiny.cameras(1, width=size[0], height=size[1])
    adapted = wrapped(10, cameras=views).adapt(scale, recipe=recipe, views="given", steps=2)
    image = adapted.render(views[0].zoomed(scale)).image
    assert image.shape == (*views[0].zoomed(scale).size, 3)
    assert is_finite(adapted.model) and image.isfinite().all()


@pytest.mark.parametrize("degree", [0, 3])
def test_every_sh_degree_adapts(degree):
    model = wrap_model(tiny.model(10, degree=degree), cameras=tiny.cameras())
    adapted = model.adapt(1 / 4, steps=2, extra_views=0)
    assert adapted.model.sh_degree == degree and is_finite(adapted.model)


def test_double_precision_adapts_in_double_precision():
    splats = tiny.gaussians(10).to(dtype=torch.float64)
    adapted = wrap_model(VanillaModel.from_gaussians(splats), cameras=tiny.cameras()).adapt(1 / 4, steps=2, extra_views=0)
    assert adapted.model.parameters()["means"].dtype == torch.float64


# What is refused


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (dict(recipe="best"), "there is no recipe 'best'; choose from default, instant, paper, thorough"),
        (dict(stepz=3), r"there is no setting stepz; did you mean steps\? mipmap_plugin.config has all of them"),
        (dict(recipe="defualt"), r"there is no recipe 'defualt'; choose from .*; did you mean default\?"),
        (dict(recipe=print), r"^recipes are given by their names, got builtin_function_or_method; register your own first, by register_recipe"),
        (dict(viewer=["spark", "three"]), "^viewers are given by their names, got list; register your own first, by register_viewer"),
        (dict(upsampler=print), "^setting upsampler: must be the name of an upsampler, which register_upsampler gives to a function, got "),
        (dict(upsampler=Path("nowhere.pth")), "^there is no upsampler file nowhere.pth"),
        (dict(views=[tiny.cameras(1)[0]] * 3), "^setting views: must be 'given', .* or 'jittered', got a list$"),
        (dict(backend="cpu"), "^backend is no setting of an adaptation; give it to wrap_model$"),
        (dict(resume=""), "^resume must be a text .*, got an empty text$"),
        (dict(scale=[1 / 2, 1 / 4]), r"got \[0.5, 0.25\]; give one at a time$"),
        (dict(nosuch=3), "there is no setting nosuch; mipmap_plugin.config has all of them"),
        (dict(resume=5), r"resume must be a text such as 'output/bicycle', or a pathlib.Path, got int"),
        (dict(observe=5), "observe must be a Callable, got int"),
        (dict(steps=-1), "^setting steps: must be a whole number of at least 0, got -1$"),
        (dict(resize="nearest"), "^setting resize: must be 'fitting', 'box', .* or 'lanczos', got 'nearest'$"),
        (dict(views="some"), "^setting views: must be 'given', 'train', 'test', 'orbit' or 'jittered', got 'some'$"),
        (dict(time_budget_s=0), "^setting time_budget_s: must be a number above 0, or None, got 0$"),
        (dict(rates={"means": -1}), r"^setting rates\.means: must be a number of at least 0, got -1$"),
        (dict(upsampler="swin"), "there is no upsampler 'swin'; choose from bicubic, lanczos"),
        (dict(views="test"), "there are no test views among the 4 cameras; use the view policy 'given'"),
        (dict(resize="box", scale=0.3, steps=1), "is not a whole multiple of"),
    ],
)
def test_settings_that_cannot_be_served_are_refused_in_a_sentence(settings, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrapped().adapt(**{"scale": 4, **settings})


def test_an_unknown_backend_and_one_that_cannot(monkeypatch):
    monkeypatch.setattr(ReferenceBackend, "lacking", lambda self, needs: ["it has no gradients"] if needs.gradients else [])
    assert wrapped(backend="reference").adapt(4, recipe="instant").report.ended_by == "0 steps"  # which needs none
    assert wrapped(backend="reference").adapt(1 / 4, steps=0, merge_to=1.0).report.ended_by == "0 steps"
    ways = 'cannot do without gradients: recipe="instant" alone needs none'
    with pytest.raises(BackendUnavailable, match=rf"backend 'reference' cannot do this(, but cpu can)?: it has no gradients; steps {ways}$"):
        wrapped(backend="reference").adapt(1 / 4)
    for settings in (dict(steps=0), dict(recipe="instant", merge_to=0.5), dict(recipe="instant", most_splats=10)):
        with pytest.raises(BackendUnavailable, match=rf"; merging {ways}, and neither does merge_to=1\.0 without most_splats"):
            wrapped(backend="reference").adapt(1 / 4, **settings)
    monkeypatch.setattr(ReferenceBackend, "lacking", lambda self, needs: ["it is switched off"])
    with pytest.raises(BackendUnavailable, match=r"cannot do this(, but cpu can)?: it is switched off$"):
        wrapped(backend="reference").adapt(1 / 4)


# Saving


def test_saving_writes_the_splats_the_tag_the_provenance_and_the_report(tmp_path):
    adapted = wrap_model(tiny.ply(tmp_path / "base.ply"), cameras=tiny.cameras()).adapt(1 / 4, **BRIEF)
    saved = adapted.save(tmp_path / "new.ply")
    comments = read_ply(saved).comments
    assert saved == tmp_path / "new.ply" and "SplatRenderMode: default" in comments and render_mode(comments) == "classic"
    provenance = provenance_of(comments)
    assert (provenance["scale"], provenance["base"]) == (0.25, hashlib.sha256((tmp_path / "base.ply").read_bytes()).hexdigest())
    assert provenance["settings"]["steps"] == 7 and "seconds" not in json.dumps(provenance)
    sidecar = json.loads((tmp_path / "new.ply.adaptation.json").read_text())
    assert sidecar == json.loads(json.dumps(adapted.report.model_dump()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["base.ply", "new.ply", "new.ply.adaptation.json"]


def test_any_classic_viewer_shows_the_file_as_the_adapted_model_shows_itself(tmp_path):
    model = wrap_model(tiny.model(40, TrainedScale(screen_filter="antialiased")), cameras=tiny.cameras())
    adapted = model.adapt(1 / 4, viewer="classic", **BRIEF)
    loaded = wrap_model(adapted.save(tmp_path / "new.ply"))
    small = tiny.cameras()[0].zoomed(1 / 4)
    torch.testing.assert_close(loaded.render(small, screen_filter="classic").image, adapted.render(small).image, atol=1e-5, rtol=0)


def test_a_model_folder_becomes_a_model_folder(tmp_path):
    saved = wrap_model(tiny.folder(tmp_path / "base")).adapt(4, recipe="instant").save(tmp_path / "new")
    assert saved == tmp_path / "new/point_cloud/iteration_30000/point_cloud.ply"
    assert saved.with_name("point_cloud.ply.adaptation.json").is_file()
    assert len(wrap_model(tmp_path / "new").cameras) == 4


def test_an_output_that_exists_is_not_overwritten_unless_asked(tmp_path):
    adapted = wrapped().adapt(4, recipe="instant")
    (tmp_path / "new.ply").write_text("precious")
    with pytest.raises(OutputExists, match=r"new\.ply exists already; pass --overwrite"):
        adapted.save(tmp_path / "new.ply")
    assert (tmp_path / "new.ply").read_text() == "precious"
    assert not (tmp_path / "new.ply.adaptation.json").exists()
    adapted.save(tmp_path / "new.ply", overwrite=True)
    assert len(load_model(tmp_path / "new.ply")) == 40


def test_a_report_without_its_model_is_not_overwritten_unless_asked(tmp_path):
    adapted, report = wrapped().adapt(4, recipe="instant"), tmp_path / "new.ply.adaptation.json"
    report.write_text("precious")
    with pytest.raises(OutputExists, match=r"new\.ply\.adaptation\.json exists already; pass --overwrite"):
        adapted.save(tmp_path / "new.ply")
    assert report.read_text() == "precious" and not (tmp_path / "new.ply").exists()
    adapted.save(tmp_path / "new.ply", overwrite=True)
    assert json.loads(report.read_text())["scale"] == 4


@pytest.mark.parametrize("answer", [True, np.float64(1) < 2, torch.ones(()) < 2])
def test_an_observer_ends_a_run_by_true_of_any_library(answer):
    assert wrapped().adapt(1 / 4, **BRIEF, observe=lambda step, *_: step == 2 and answer).report.ended_by == "its observer"


def test_an_observer_sees_images_without_gradients():
    seen, view = [], tiny.cameras(1)[0].zoomed(1 / 4)
    wrapped().adapt(1 / 4, **BRIEF, observe=lambda step, seconds, render: seen.append(render(view)))
    assert len(seen) == 8 and not any(image.requires_grad for image in seen)
    assert seen[0].numpy().shape == (*view.size, 3) and not torch.equal(seen[0], seen[-1])


@pytest.mark.parametrize("answer", [None, 1, "yes", torch.ones(2, 2), [True]])
def test_no_other_answer_of_an_observer_ends_a_run(answer):
    assert wrapped().adapt(1 / 4, **BRIEF, observe=lambda *_: answer).report.ended_by == "7 steps"


def test_a_bare_file_without_cameras_adapts_on_an_orbit(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.views.ORBIT_PIXELS", 24)
    adapted = wrap_model(tiny.ply(tmp_path / "base.ply")).adapt(1 / 4, steps=2, extra_views=3)
    assert adapted.report.views == "3 views of a generated orbit at 24 px (the checkpoint came without cameras)"
    assert is_finite(adapted.model)


def test_an_adapted_model_can_be_adapted_again():
    first = wrapped().adapt(1 / 2, steps=1, extra_views=0)
    half = [camera.zoomed(1 / 2) for camera in tiny.cameras()]
    again = wrap_model(first.model, cameras=half).adapt(1 / 2, steps=1, extra_views=0)
    assert is_finite(again.model) and again.model is not first.model


def test_the_loss_is_what_was_asked_for_and_the_curve_is_in_decibel_all_the_same():
    squares, absolutes = (wrapped().adapt(1 / 4, **{**BRIEF, "loss": loss, "steps": 2, "returns": "last"}) for loss in ("l2", "l1"))
    assert not torch.equal(shown(squares), shown(absolutes))
    assert absolutes.report.curve[0].psnr_db == pytest.approx(squares.report.curve[0].psnr_db, abs=3)


def test_a_phase_on_a_gpu_ends_when_the_gpu_is_done(monkeypatch):
    """What it is still at would count as the next one's."""
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    session = SimpleNamespace(scale=0.5, device=torch.device("cuda"), seconds={"merging": 1.0})
    with Session.phase(session, "merging"):
        pass
    assert session.seconds["merging"] > 1 and waited == [session.device] * 2


def test_memory_is_counted_on_a_gpu_and_from_its_beginning(monkeypatch):
    device, most = torch.device("cuda"), {"bytes": 5 << 30}
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda which: most.update(bytes=0 if which == device else None))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda which: most["bytes"])
    peak = PeakMemory(device)
    most["bytes"] += 3 << 20
    assert peak.mib() == 3
    assert PeakMemory(torch.device("cpu")).mib() is None
    assert wrapped().adapt(1 / 4, recipe="instant").report.peak_memory_mib is None


@pytest.mark.parametrize("scale", [Fraction(1, 2), np.float32(0.5), torch.tensor(0.5), Decimal("0.5")])
def test_a_scale_is_a_number_of_any_type(scale):
    report = wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(scale, steps=0).report
    assert type(report.scale) is float and report.scale == 0.5


@pytest.mark.parametrize("cameras", ["cameras.json", [3], 7])
def test_what_are_no_cameras_is_refused(cameras):
    with pytest.raises(SettingsError, match=r"cameras must be of the type mipmap_plugin.Camera"):
        wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(0.5, cameras=cameras, steps=0)
    with pytest.raises(SettingsError, match=r"cameras must be of the type mipmap_plugin.Camera"):
        wrap_model(tiny.model(), cameras=[cameras])


def test_cameras_that_show_nothing_are_refused():
    behind = torch.eye(4)
    behind[2, 3] = -1000.0  # all splats lie behind it
    away = replace(tiny.cameras(1)[0], viewmat=behind)
    with pytest.raises(SettingsError, match="none of the 1 views shows a splat"):
        wrap_model(tiny.model(), cameras=[away]).adapt(0.5, steps=0, views="given")


def test_a_scene_of_which_most_is_before_the_near_plane_is_told_of():
    """What is left is adapted all the same."""
    base = wrap_model(tiny.model(), cameras=tiny.cameras())
    depths = torch.stack([camera.to_camera(base.model.parameters()["means"].detach())[:, 2] for camera in base.cameras])
    base.trained = replace(base.trained, near_plane=float(depths.median()))  # each splat is far enough in some views
    with pytest.warns(UserWarning, match=r"(4|5)\d% of the splats in a view's picture lie nearer than .* units, where renderers of 3DGS draw none"):
        base.adapt(1 / 2, recipe="instant")


@pytest.mark.usefixtures("small_orbits")
def test_without_cameras_the_orbit_is_told_of(recwarn):
    wrap_model(tiny.model()).adapt(1 / 2, steps=0, extra_views=2, merge_to=1.0)
    assert [each for each in recwarn if str(each.message).startswith("no cameras are known: views of a generated orbit")]
    recwarn.clear()
    wrap_model(tiny.model()).adapt(1 / 2, steps=0, extra_views=2, merge_to=1.0, views="orbit")
    assert not recwarn


def test_a_base_that_is_gone_from_the_disk_is_adapted_all_the_same(tmp_path):
    base = wrap_model(tiny.ply(tmp_path / "a.ply"), cameras=tiny.cameras())
    (tmp_path / "a.ply").unlink()
    assert base.adapt(0.5, steps=0).report.ended_by == "0 steps"


def test_what_was_adapted_to_another_scale_is_not_adapted_again(tmp_path):
    base = wrap_model(tiny.model(), cameras=tiny.cameras())
    files = [base.adapt(scale, steps=0, viewer="antialiased").save(tmp_path / f"{scale}.ply") for scale in (0.5, 1.0)]
    with pytest.raises(SettingsError, match=r"0\.5\.ply was adapted to x0\.5, at which alone it looks right; adapt the checkpoint that"):
        wrap_model(files[0], cameras=tiny.cameras()).adapt(0.5, steps=0)
    wrap_model(files[1], cameras=tiny.cameras()).adapt(0.5, steps=0)


@pytest.mark.parametrize("times", [2, 4])
def test_lenses_that_differ_too_much_are_told_of(times, recwarn):
    wide, *others = tiny.cameras()
    wrap_model(tiny.model(), cameras=[wide, *others, replace(wide, fx=times * wide.fx, fy=times * wide.fy)]).adapt(1 / 2, recipe="instant")
    assert [str(each.message) for each in recwarn if "focal lengths of the cameras are" in str(each.message)] if times > 3 else not recwarn


def test_a_scene_nearer_than_the_near_plane_is_refused_with_what_to_do():
    splats = tiny.gaussians()
    small = VanillaModel.from_gaussians(replace(splats, means=splats.means * 0.01, scales=splats.scales * 0.01))
    smaller = torch.diag(torch.tensor([0.01, 0.01, 0.01, 1.0], dtype=torch.float64))
    views = [view.moved(smaller) for view in tiny.cameras(2)]
    with pytest.raises(SettingsError, match=r"all splats lie nearer than 0.2 units, .* scale the scene up, with its cameras if it has any"):
        wrap_model(small, cameras=views).adapt(0.5, steps=0, views="given")


def shrunk(factor):
    """The model in units so small."""
    splats = tiny.gaussians()
    return VanillaModel.from_gaussians(replace(splats, means=splats.means * factor, scales=splats.scales * factor))


def test_a_scene_in_small_units_is_told_of_where_the_near_plane_keeps_an_orbit_away_from_it():
    base = wrap_model(shrunk(0.02))
    where = r"the scene is 0.0\d+ units wide, and no view shows it larger than \S+ px: renderers of 3DGS draw nothing nearer than 0.2 units; "
    where += "scale the scene up, with its cameras if it has any"  # here it has none
    [remark] = remarks(base.views(), base.model, 0.2, orbit=True)
    assert re.match(where, remark) and not remarks(base.views(), base.model, 0.2, orbit=False)
    with pytest.raises(SettingsError, match=r"renderers of 3DGS draw nothing nearer than 0\.2 units"):
        wrap_model(shrunk(1e-4)).adapt(0.5, recipe="instant")
    with pytest.raises(SettingsError, match="the cameras seem to be in other units"):
        far = torch.diag(torch.tensor([100.0, 100.0, 100.0, 1.0], dtype=torch.float64))
        wrap_model(tiny.model(), cameras=[view.moved(far) for view in tiny.cameras(2)]).adapt(0.5, recipe="instant")


@pytest.mark.parametrize("viewer", [None, "spark"])  # for which it is converted at x1 before
def test_a_small_scene_may_be_zoomed_into(viewer):
    far = torch.diag(torch.tensor([12.0, 12.0, 12.0, 1.0], dtype=torch.float64))
    base = wrap_model(tiny.model(), cameras=[view.moved(far) for view in tiny.cameras(2)])
    small = r"no view shows it larger than \d\S* px: the cameras seem to be in other units"
    for scale in (0.5, 1.1):
        with pytest.raises(SettingsError, match=small):
            base.adapt(scale, steps=1, viewer=viewer)
    with pytest.warns(UserWarning, match=small):
        assert base.adapt(8, steps=1, viewer=viewer, extra_views=1).report.scale == 8


def test_a_model_of_which_nothing_is_drawn_is_refused_and_one_of_which_little_is_is_not():
    faint = tiny.model()
    faint.parameters()["opacities"][:] = -8.0
    base = wrap_model(faint, cameras=tiny.cameras(2))
    for scale in (0.5, 1):
        with pytest.raises(SettingsError, match="below 1/255 and are never drawn; the training or the export failed"):
            base.adapt(scale, steps=0, views="given")
    faint.parameters()["opacities"][7] = 2.0
    away = replace(tiny.cameras(1)[0], viewmat=HALF_TURN @ tiny.cameras(1)[0].viewmat)
    wrap_model(faint, cameras=[away, *tiny.cameras(2)]).adapt(0.5, steps=0, views="given")


def test_views_that_show_nothing_do_not_count_in_the_mean():
    """They are at 120 dB, whatever the others show."""
    away = [replace(view, viewmat=HALF_TURN @ view.viewmat) for view in tiny.cameras(3)]
    model = wrap_model(tiny.model(), cameras=[*tiny.cameras(3), *away])
    alone = wrap_model(tiny.model(), cameras=tiny.cameras(3))
    settings = dict(steps=1, views_per_step=400, extra_views=0)  # many views for validation
    both, without = (each.adapt(0.5, **settings).report.psnr_before() for each in (model, alone))
    assert both == pytest.approx(without, abs=6)


HALF_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


# Small zoom-ins


def test_the_smallest_zoom_ins_take_no_steps_unless_they_are_asked_for_or_another_way_to_draw_is_learned(monkeypatch):
    """Steps would learn to undo the filter that shrinks their picture."""
    base = wrap_model(tiny.model(), cameras=tiny.cameras())
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_IN", DEFAULT_IN | {"steps": 2})
    small, asked, other = base.adapt(1.05), base.adapt(1.05, steps=2), base.adapt(1.05, viewer="spark")
    assert small.report.curve[-1].step == 0 and "a zoom below x1.1 shows hardly more than the base" in small.report.ended_by
    assert asked.report.curve[-1].step == 2 and other.report.curve[-1].step > 0


@pytest.mark.parametrize(("screen_filter", "fits"), [("classic", "pil-bicubic"), ("antialiased", "area"), ("mip", "area")])
def test_a_zoom_in_is_shrunk_by_the_filter_that_fits_its_base(screen_filter, fits):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(), screen_filter=screen_filter)
    assert base.adapt(2, steps=1, extra_views=1).report.settings.resize == fits
    assert base.adapt(2, steps=1, extra_views=1, resize="lanczos").report.settings.resize == "lanczos"
