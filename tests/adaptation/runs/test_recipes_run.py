"""Every recipe runs, comes closer to the pseudo truth, and leaves the base as it was; the same seed gives the same bytes."""

import hashlib
import json
import math

import pytest
import tiny
import torch
from brief_runs import BRIEF, BRIEF_PAPER, WHITE, is_finite, shown, wrapped

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.recipes import DEFAULT_IN
from mipmap_plugin.wrap import wrap_model

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
        # The few steps for an antialiased base begin with its own shapes, and are to come up with its closed form.
        assert naive + 15 < first and final > first + (1.3 if screen_filter == "classic" else -0.3)


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


@pytest.mark.parametrize("screen_filter", ["antialiased", "mip"])
def test_without_a_viewer_the_file_is_drawn_as_the_base_was(screen_filter):
    base = wrapped(screen_filter=screen_filter)
    adapted = base.adapt(4, recipe="instant")
    assert adapted.effects == base.effects() and adapted.model.trained.screen_filter == screen_filter
    assert adapted.report.as_trained is None and not any("as its training drew it" in note for note in adapted.report.notes)
    small = base.cameras[0].zoomed(4)
    assert adapted.report.psnr_before() is not None and base.render(small).image.shape == adapted.render(small).image.shape


def test_the_loss_is_what_was_asked_for_and_the_curve_is_in_decibel_all_the_same():
    squares, absolutes = (wrapped().adapt(1 / 4, **{**BRIEF, "loss": loss, "steps": 2, "returns": "last"}) for loss in ("l2", "l1"))
    assert not torch.equal(shown(squares), shown(absolutes))
    assert absolutes.report.curve[0].psnr_db == pytest.approx(squares.report.curve[0].psnr_db, abs=3)


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
