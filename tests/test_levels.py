"""Ladders of levels: bands, starts from finer levels, switches, manifests, and what an interruption leaves."""

import json
import math
import shutil
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import anchor_checkpoints
import moving
import pytest
import tiny
import torch

from mipmap_plugin import cli, load_model, recipes, wrap_model
from mipmap_plugin.adaptation.optimization.run import Run
from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.report import AS_IT_IS, Report
from mipmap_plugin.adaptation.start import candidates
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.image_store import STEPS
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views import over_band
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.commands.ladders import print_summary
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import OutputError, OutputExists, SceneError, SettingsError
from mipmap_plugin.evaluation.tradeoff.measuring import on_backend
from mipmap_plugin.levels.contents import Contents, LeftOut, Level
from mipmap_plugin.levels.ladder import MORE_SPLATS, NOT_BETTER, UNSHOWN, _no_use, _shown, make_levels
from mipmap_plugin.levels.manifest import MANIFEST, base_pixel, write_ladder
from mipmap_plugin.levels.request import FINEST_RATIO, NARROW, STEPS_KEPT, WIDE, Band, LadderRequest
from mipmap_plugin.models.base import Traits
from mipmap_plugin.models.places import state_path
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import Interrupted

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")

BRIEF = dict(steps=1, extra_views=1, validation_views=2, warm_up=0, views_per_step=1)


def wrapped(count=12):
    return wrap_model(tiny.model(count, degree=0), cameras=tiny.cameras(2, width=16, height=12))


def request(viewer="antialiased", **options):
    return LadderRequest.of(viewer, **{"coarsest": 1 / 4, "ratio": 2.0, **BRIEF, **options})


# Bands of views


def test_views_of_a_band_are_spread_evenly_over_it_in_any_run_of_them():
    views = over_band(tiny.cameras(40), AdaptConfig(band=(0.5, 2.0)))
    zooms = sorted(view.zoom for view in views)
    assert 0.5 < zooms[0] < 0.54 and 1.86 < zooms[-1] < 2
    gaps = [math.log2(high / low) for low, high in pairwise(zooms)]
    assert max(gaps) < 3 * 2 / 40
    for first in (0, 11, 29):
        assert any(view.zoom < 1 for view in views[first : first + 3]) and any(view.zoom > 1 for view in views[first : first + 3])


def test_without_a_band_views_stay_the_same_objects():
    views = tiny.cameras()
    assert all(one is other for one, other in zip(over_band(views, AdaptConfig()), views, strict=True))


def test_the_truth_of_a_zoomed_view_is_the_bases_own_image():
    """The base is rendered with its own pixels and dilation, whatever the view's place in the band."""
    base, view, effects = tiny.model(), tiny.cameras()[0], Effects(sh_degree=1)
    truth = PseudoTruth(BaseImages(base, ReferenceBackend(), effects), 1 / 2, AdaptConfig(band=(0.5, 1.0)))
    image = ReferenceBackend().render(base.gaussians(), view, effects).image.clamp(0, 1)
    torch.testing.assert_close(truth(view.zoomed(0.5)), resize(image, (6, 8), "pil-bicubic"), atol=1 / STEPS, rtol=0)


@pytest.mark.parametrize(
    ("band", "reason"),
    [((0.5, 4.0), "a band ends at the base's scale"), ((2.0, 1.0), "^setting band: must rise, got"), ((0.0, 1.0), "each a number above 0, got")],
)
def test_impossible_bands_are_refused(band, reason):
    with pytest.raises(SettingsError, match=reason):
        recipe("default", 1 / 2, band=band)


def test_a_band_is_adapted_to():
    """The report of a run over a band judges it by the band: the base in a viewer, say, is another number there than at one scale."""
    one, band = (wrapped().adapt(1 / 2, viewer="antialiased", band=band, **BRIEF).report for band in ((1.0, 1.0), (0.5, 2.0)))
    assert band.settings.band == (0.5, 2.0)
    assert one.validation["the base as it is"] != band.validation["the base as it is"]


# Starts from a finer level


def test_a_run_starts_from_a_finer_level_and_keeps_a_fraction_of_the_base():
    base = wrapped(40)
    finer = base.adapt(1 / 2, viewer="antialiased", steps=0, most_splats=30, validation_views=2).model
    adapted = base.adapt(1 / 4, viewer="antialiased", start=FinerLevel(finer, 1 / 2), steps=0, merge_to=0.25, merging_costs=99, validation_views=2)
    assert len(finer) <= 30 and adapted.report.gaussians_before == 40
    assert any("merged" in name or "finer level" in name for name in adapted.report.validation)
    assert 10 <= adapted.report.gaussians_after <= 30


def test_splats_that_share_no_pixel_are_merged_where_enough_is_left_to_see(monkeypatch):
    def count(least_db):
        monkeypatch.setattr(candidates, "LEAST_DB", least_db)
        monkeypatch.setattr(candidates.StartSearch, "_least_psnr", lambda *_: -math.inf)
        settings = dict(steps=0, merge_to=0.05, merging_costs=99, validation_views=2, returns="last")
        return len(base.adapt(0.9, viewer="antialiased", start=FinerLevel(base.model, 1.0), **settings).model)

    base = wrapped(40)
    assert count(-math.inf) == 2 < count(math.inf)


@pytest.mark.parametrize(
    ("coarse_db", "base_db", "steps", "start"),
    [
        (30.0, 32.0, 1, ("merged", 0.1, True)),
        (30.0, 34.0, 1, ("merged", 0.1, False)),
        (26.0, 20.0, 1, ("merged", 0.1, False)),
        (20.0, 20.0, 1, ("merged", 0.1, False)),
        (30.0, 32.0, 0, ("merged", 0.1, False)),
        (30.0, 33.0, 0, ("finer",)),
    ],
)
def test_what_is_merged_too_coarsely_leaves_the_choice_to_plain_merging(monkeypatch, coarse_db, base_db, steps, start):
    """The finer level has 38 dB and may lose 9, as the closed form may; the base itself may lose 3. Without a step, merging leaves half of what the
    closed form, of 34 dB, gains on the base."""

    def quality(model):
        return Quality(*[{"finer": 38.0, "base": base_db, "formed": 34.0}.get(model[0], coarse_db if model[-1] else 33.0)] * 2)

    def candidate(_, weights, fraction, coarsely=False):
        return ("formed",) if fraction == 1 else ("merged", fraction, coarsely)

    class Base(tuple):
        traits = Traits()

        def parameters(self):
            return {"means": torch.zeros(100, 3)}

    config = SimpleNamespace(most_splats=None, closed_form=True, merge_to=0.1, merging_costs=9.0, returns="best", time_budget_s=None, steps=steps)
    problem = SimpleNamespace(
        base=lambda: Base(["finer"]), coarse_base=lambda: Base(["base"]), config=config, quality=quality, may_lose=9.0, name="the finer level",
        views=[], scale=0.5, phase=lambda _: nullcontext(), base_effects=Effects(0), target=Effects(0), has_blend_weights=False,
    )  # fmt: skip
    monkeypatch.setattr(candidates.BaseWeights, "measured", lambda *_: None)
    monkeypatch.setattr(candidates.StartSearch, "_candidate", candidate)
    assert candidates.StartSearch(problem).best()[0] == start


def test_a_start_has_to_be_finer():
    base = wrapped()
    with pytest.raises(SettingsError, match=r"start: x0.25 is not finer than x0.5; leave it out"):
        base.adapt(1 / 2, viewer="antialiased", start=FinerLevel(base.model, 1 / 4), **BRIEF)


# Counts


@pytest.mark.parametrize("most", [1, 7, 30])
def test_at_most_so_many_splats_are_left_whatever_it_costs(most):
    adapted = wrapped(40).adapt(1 / 2, viewer="antialiased", most_splats=most, steps=2, extra_views=1, validation_views=2)
    assert len(adapted.model) <= most
    assert "the base as it is" in adapted.report.validation and not adapted.report.returned.startswith("the base as it is")


def test_a_count_above_the_bases_changes_nothing():
    options = dict(viewer="antialiased", steps=0, validation_views=2, merge_to=1.0)
    one, other = (wrapped().adapt(1 / 2, **options, **more).model.parameters() for more in ({}, {"most_splats": 12}))
    assert all(torch.equal(one[name], other[name]) for name in one)


# Bands of a ladder


def test_bands_meet_and_end_at_the_coarsest_scale():
    bands = [Band.first(2.0, as_it_is=False)]
    while bands[-1].low > 0.08:
        bands.append(bands[-1].next(2.0, coarsest=0.08))
    assert [band.scale for band in bands] == pytest.approx([1, 1 / 2, 1 / 4, 1 / 8, 0.08])
    assert all(finer.low == coarser.high for finer, coarser in pairwise(bands))
    assert all(band.low < band.scale <= band.high for band in bands)


def test_a_base_that_the_viewer_draws_as_its_training_did_stays_as_it_is():
    ladder = make_levels(wrapped(), request("classic", coarsest=0.6))
    first = ladder.levels[0].adapted
    assert "the base as it is" in first.report.returned
    for name, tensor in wrapped().model.parameters().items():
        torch.testing.assert_close(first.model.parameters()[name], tensor, rtol=0, atol=0)


def test_the_ratio_suits_the_viewer():
    effects = Effects(sh_degree=1)
    usual = LadderRequest("spark")
    assert usual.first_ratio(replace(effects, screen_filter="mip")) == WIDE
    assert usual.first_ratio(replace(effects, screen_filter="classic", eps2d=0.075)) == WIDE
    assert usual.first_ratio(replace(effects, screen_filter="classic", eps2d=0.3)) == NARROW
    assert request(ratio=1.5).first_ratio(effects) == 1.5


def test_levels_below_a_half_are_denser_unless_a_ratio_is_asked_for():
    usual = LadderRequest("spark")
    assert usual.next_ratio(0.7, WIDE) == WIDE and usual.next_ratio(0.4, WIDE) == NARROW and usual.next_ratio(0.4, FINEST_RATIO) == FINEST_RATIO
    assert request(ratio=1.5).next_ratio(0.4, 1.5) == 1.5


def test_a_level_that_starts_from_a_finer_one_takes_fewer_steps():
    assert LadderRequest("spark").steps(1 / 4)["steps"] == math.ceil(STEPS_KEPT * recipe("default", 1 / 4).steps)
    assert LadderRequest("spark", recipe="instant").steps(1 / 4)["steps"] == 0


def test_levels_of_a_large_scene_take_fewer_steps_unless_asked_for(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", recipes.DEFAULT_OUT | dict(steps=40, most_draws=1.0, extra_views=2))

    def steps(**settings):
        ladder = make_levels(wrapped(), LadderRequest("classic", coarsest=1 / 2, ratio=4.0, settings={"validation_views": 2, **settings}))
        return ladder.levels[1].adapted.report.settings.steps

    assert steps() == math.ceil(STEPS_KEPT * 40 / 4)
    assert steps(steps=5) == 5


@pytest.mark.parametrize("change", [{"split": "test"}, {"time": 0.5}, {"width": 33}])
def test_levels_of_other_cameras_are_not_gone_on_with(tmp_path, change):
    base = wrapped()
    make_levels(base, request(coarsest=0.9), tmp_path / "state")
    base.cameras[-1] = replace(base.cameras[-1], **change)
    with pytest.raises(SettingsError, match="holds levels of another base, viewer or settings"):
        make_levels(base, request(coarsest=0.9), tmp_path / "state")


@pytest.mark.usefixtures("small_orbits")
def test_levels_of_another_vertical_are_not_gone_on_with(tmp_path):
    base, other = (wrap_model(tiny.model(), up=up) for up in ("z", None))
    asked = request(coarsest=0.9, steps=0, extra_views=2)
    make_levels(base, asked, tmp_path / "state")
    with pytest.raises(SettingsError, match="holds levels of another base, viewer or settings"):
        make_levels(other, asked, tmp_path / "state")


def test_levels_of_another_model_are_not_gone_on_with(tmp_path):
    """One whose parameters have the same sums."""
    first, other = wrapped(), wrapped()
    with torch.no_grad():
        other.model.parameters()["means"].copy_(first.model.parameters()["means"].flip(0))
    make_levels(first, request(coarsest=0.9), tmp_path / "state")
    with pytest.raises(SettingsError, match="holds levels of another base, viewer or settings"):
        make_levels(other, request(coarsest=0.9), tmp_path / "state")


@pytest.mark.parametrize(
    ("options", "reason"),
    [({"coarsest": 2.0}, "goes down"), ({"ratio": 1.0}, "ratio: must be"), ({"until_splats": 0}, "until_splats"), ({"band": (0.5, 1)}, "band: set"),
     ({"least_db": math.nan}, "least_db: must be a number of dB"), ({"recipe": "nonsense"}, "there is no recipe"), ({"steps": -1}, "setting steps")],
)  # fmt: skip
def test_impossible_ladders_are_refused(options, reason):
    with pytest.raises(SettingsError, match=reason):
        request(**options)


def test_a_group_of_viewers_has_no_ladder():
    with pytest.raises(SettingsError, match="portable is a group of viewers"):
        make_levels(wrapped(), request("portable"))


# Ladders


def test_levels_of_a_bound_are_made_again_for_narrower_bands():
    """No level of so few steps is this good, so that every band ends up at the finest ratio."""
    ladder = make_levels(wrapped(), request(coarsest=0.6, ratio=2.0, least_db=99.0))
    assert [level.band.scale for level in ladder.levels] == pytest.approx([1, (2 * FINEST_RATIO) ** -0.5])
    assert [level.band.scale for level in make_levels(wrapped(), request(coarsest=0.6, ratio=2.0)).levels] == pytest.approx([1, 0.6])


def test_a_level_that_is_the_base_again_is_left_out(tmp_path, monkeypatch, capsys):
    """The next one is made from the level before, whose splats are fewer or as many."""
    base, starts = wrapped(), []
    adapt = base.adapt

    def adapted(scale, **options):
        starts.append(options.get("start"))
        made = adapt(scale, **options)
        held = f"{AS_IT_IS}: 30.00 dB on validation views" if len(starts) == 2 else made.report.returned
        return replace(made, report=made.report.model_copy(update={"returned": held}))

    monkeypatch.setattr(base, "adapt", adapted)
    ladder = make_levels(base, request(), resume=tmp_path / "state")
    assert [level.band.scale for level in ladder.levels] == pytest.approx([1, 1 / 4]) and starts[2].scale == 1
    assert [(left.scale, left.reason) for left in ladder.contents.left_out] == [(pytest.approx(1 / 2), NOT_BETTER)]
    manifest = json.loads((ladder.save(tmp_path / "ladder") / MANIFEST).read_text())
    assert len(manifest["left_out"]) == 1 and 0.24 < manifest["switches"][0]["zoom"] <= 1
    assert [level["file"] for level in manifest["levels"]] == ["level_0.ply", "level_1.ply"] and not (tmp_path / "ladder/level_2.ply").exists()
    print_summary(tmp_path, manifest)
    assert f"no level of its own at x0.5, where a neighbor is shown: {NOT_BETTER}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("returned", "splats", "reason"),
    [("merged splats", 9, None), ("merged splats", 10, None), ("step 3", 11, MORE_SPLATS), (f"{AS_IT_IS}: 30 dB", 9, NOT_BETTER)],
)
def test_a_coarser_level_has_no_more_splats_than_a_finer_one(returned, splats, reason):
    level = SimpleNamespace(adapted=SimpleNamespace(report=Report.model_construct(returned=returned, validation={})), splats=splats)
    assert _no_use(level, SimpleNamespace(splats=10)) == reason


def test_a_level_that_is_shown_at_no_zoom_is_left_out():
    """Level 1 is worse than both neighbors, so that each of its switches lies at its own scale."""
    levels = [Level(SimpleNamespace(number=number, model=tiny.model(3 - number)), Band(0.5**number, 0, 1, 2)) for number in range(3)]
    dbs = [lambda zoom: 40 + 10 * math.log2(zoom), lambda _: 10, lambda zoom: 30 - 5 * math.log2(zoom / 0.25)]
    yardstick = SimpleNamespace(psnr=lambda level, zoom: dbs[level.number](zoom), likeness=lambda *_: 30)
    shown, switches, left_out = _shown(levels, yardstick)
    assert shown == [levels[0], levels[2]] and len(switches) == 1 and 0.25 < switches[0].zoom < 1
    assert left_out == [LeftOut(0.5, 2, UNSHOWN)]


def test_a_ladder_ends_with_few_enough_splats():
    ladder = make_levels(wrapped(), request(until_splats=12))
    assert len(ladder.levels) == 1


def test_a_saved_ladder_says_what_it_is(tmp_path):
    base = wrapped()
    saved = base.levels("antialiased", coarsest=1 / 2, ratio=2.0, **BRIEF).save(tmp_path / "ladder")
    manifest = json.loads((saved / MANIFEST).read_text())
    levels = manifest["levels"]
    assert [level["scale"] for level in levels] == pytest.approx([1, 1 / 2])
    for level in levels:
        model = load_model(saved / level["file"])
        assert len(model) == level["splats"] and (saved / level["file"]).stat().st_size == level["bytes"] and model.digest == level["sha256"]
    assert levels[0]["shown_to"] is None and levels[-1]["shown_from"] is None
    switches = [each["zoom"] for each in manifest["switches"]]
    assert [level["shown_from"] for level in levels[:-1]] == [level["shown_to"] for level in levels[1:]] == switches
    assert manifest["worst_db"] == min(point["psnr_db"] for point in manifest["curve"]) and manifest["viewer"] == "antialiased"
    assert [point["zoom"] for point in manifest["curve"]] == sorted((point["zoom"] for point in manifest["curve"]), reverse=True)
    with pytest.raises(OutputExists, match="exists already"):
        write_ladder(Contents(request(), base, [], [], []), saved, overwrite=False)
    (saved / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match=r"has other things in it, such as notes.txt"):
        write_ladder(Contents(request(), base, [], [], []), saved, overwrite=True)


def test_splats_in_no_picture_have_no_part_in_the_size_of_a_pixel():
    """More than half of all lie right behind the camera, whose distances would follow from them."""
    views, ball = tiny.cameras(1), tiny.gaussians(50)
    behind = tiny.gaussians(60, spread=1e-4, seed=2)
    eye = views[0].center.float()
    hidden = replace(behind, means=behind.means + eye + 0.2 * eye / eye.norm())
    both = ball.joined(hidden)
    sizes = [base_pixel(wrap_model(VanillaModel.from_gaussians(each), cameras=views)) for each in (ball, both, hidden)]
    assert sizes[0] == sizes[1] and 0 < sizes[2] < sizes[0] / 5


def test_a_ladder_is_saved_when_its_base_is_gone(tmp_path):
    base = tiny.ply(tmp_path / "base.ply", degree=0)
    ladder = wrap_model(base, cameras=tiny.cameras(2, width=16, height=12)).levels("classic", coarsest=1.0)
    base.unlink()
    assert (ladder.save(tmp_path / "ladder") / MANIFEST).is_file()


def test_a_folder_that_is_no_ladder_is_never_replaced(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").write_bytes(b"1")
    for output in (base, tmp_path / "photos"):
        words = ["levels", str(base), "--viewer", "antialiased", "--output", str(output), "--overwrite"]
        assert cli.main(words) == 2
        assert "choose another" in capsys.readouterr().err
    assert (tmp_path / "photos" / "one.jpg").exists() and (base / "point_cloud").is_dir()


def test_an_interrupted_ladder_goes_on_with_what_is_ready(tmp_path, monkeypatch):
    whole = make_levels(wrapped(), request(coarsest=1 / 2), resume=tmp_path / "a").save(tmp_path / "whole")
    base = wrapped()
    adapt, scales = base.adapt, []

    def interrupted(scale, **options):
        scales.append(scale)
        if len(scales) == 2:
            raise Interrupted("Ctrl-C")
        return adapt(scale, **options)

    monkeypatch.setattr(base, "adapt", interrupted)
    with pytest.raises(Interrupted):
        make_levels(base, request(coarsest=1 / 2), resume=tmp_path / "b")
    again = make_levels(base, request(coarsest=1 / 2), resume=tmp_path / "b").save(tmp_path / "again")
    assert scales == pytest.approx([1, 1 / 2, 1 / 2])
    assert not (tmp_path / "a").exists() and not (tmp_path / "b").exists()
    for file in whole.glob("*.ply"):
        assert file.read_bytes() == (again / file.name).read_bytes()


def test_levels_for_mip_splatting_start_from_finer_ones_that_are_kept(tmp_path):
    """Whose files have the column filter_3D, which makes them checkpoints of another family."""
    ladder = make_levels(wrapped(), request("mip", coarsest=1 / 2, steps=0), resume=tmp_path / "kept")
    assert [len(level.adapted.model) for level in ladder.levels][1:] and (ladder.save(tmp_path / "ladder") / MANIFEST).is_file()


def test_an_interrupted_command_says_that_finished_levels_are_kept(tmp_path, monkeypatch, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12), count=12)
    words = ["levels", str(base), "--viewer", "antialiased", "--output", str(tmp_path / "ladder"), "--coarsest", "1/2", "--recipe", "instant"]
    words += ["--views", "given"]

    def ends(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as first:
        first.setattr("mipmap_plugin.levels.ladder._curve", ends)
        assert cli.main(words) == 130
        assert f"go on with the levels that {tmp_path / 'ladder.resume'} keeps" in capsys.readouterr().err
    monkeypatch.setattr("mipmap_plugin.wrap.Wrapped.adapt", None)
    assert cli.main(words) == 0


@pytest.mark.parametrize("has_cameras", [True, False])
def test_levels_of_generated_views_are_said_to_be(tmp_path, capsys, has_cameras):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)) if has_cameras else tiny.ply(tmp_path / "base.ply")
    words = ["levels", str(base), "--viewer", "classic", "--output", str(tmp_path / "ladder"), "--coarsest", "1"]
    assert cli.main([*words, "--backend", "cpu", "--threads", "1"]) == 0
    assert ("no cameras are known" in capsys.readouterr().err) is not has_cameras


def test_the_size_of_a_small_level_is_told_in_kilobytes(tmp_path, capsys):
    base, ladder = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)), tmp_path / "ladder"
    words = ["levels", str(base), "--viewer", "classic", "--output", str(ladder), "--coarsest", "1"]
    assert cli.main([*words, "--backend", "cpu", "--threads", "1"]) == 0
    size = json.loads((ladder / "levels.json").read_text())["levels"][0]["bytes"]
    assert f" splats, {size / 1e3:.0f} kB, " in capsys.readouterr().out


def interrupt():
    raise Interrupted("Ctrl-C")


def test_a_ladder_that_failed_before_its_first_level_is_in_nobodys_way(tmp_path, monkeypatch):
    base = wrapped()
    monkeypatch.setattr(base, "adapt", lambda *_, **__: interrupt())
    with pytest.raises(Interrupted):
        make_levels(base, request(), resume=tmp_path / "state")
    assert make_levels(wrapped(), request(coarsest=0.6), resume=tmp_path / "state").levels


@pytest.mark.parametrize("by", ["zoom", "distance"])
def test_a_ladder_that_failed_before_its_first_level_leaves_nothing(tmp_path, monkeypatch, by):
    base = wrapped()
    monkeypatch.setattr(base, "adapt", lambda *_, **__: interrupt())
    with pytest.raises(Interrupted):
        make_levels(base, request(by=by), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_first_level_that_is_broken_off_before_its_state_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "start", lambda *_: interrupt())
    with pytest.raises(Interrupted):
        make_levels(wrapped(), request(), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_first_level_whose_state_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OutputError("no space")

    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.resume.save_run", full)
    monkeypatch.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, task, config, on_interrupt, observe: on_interrupt(run))
    with pytest.raises(OutputError, match="no space"):
        make_levels(wrapped(), request(), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_ladder_that_is_killed_before_its_first_level_leaves_its_state_at_most(tmp_path, monkeypatch):
    base, state = wrapped(), tmp_path / "new" / "state"
    adapt, found = base.adapt, []

    def watched(scale, **options):
        return adapt(scale, observe=lambda *_: found.append({each.name for each in state.iterdir()}), **options)

    monkeypatch.setattr(base, "adapt", watched)
    make_levels(base, request(coarsest=1.0, steps=2), resume=state)
    assert len(found) == 3 and set().union(*found) == {".level_0.ply.resume.lock"}


def test_what_a_ladder_that_was_killed_leaves_is_in_nobodys_way(tmp_path):
    for left in ("level_0.ply.resume.lock", "request.json.0.tmp"):  # of a process that has ended
        (tmp_path / f".{left}" / "new").mkdir(parents=True)
    ladder = make_levels(wrapped(), request(coarsest=1.0), resume=tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {"request.json", "level_0.ply", "level_0.ply.adaptation.json"} and ladder.levels


def test_a_ladder_whose_first_level_has_a_state_keeps_it(tmp_path, monkeypatch):
    base, state = wrapped(), tmp_path / "state"
    monkeypatch.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, task, config, on_interrupt, observe: on_interrupt(run))
    with pytest.raises(Interrupted):
        make_levels(base, request(steps=1), resume=state)
    monkeypatch.undo()
    assert [each.name for each in state.iterdir()] == ["level_0.ply.resume"]
    assert make_levels(base, request(steps=1, coarsest=1.0), resume=state).levels  # its first level is the same


def test_an_interruption_is_told_also_where_somebody_has_deleted_the_folder(tmp_path, monkeypatch):
    base = wrapped()

    def interrupted(scale, resume, **_):
        shutil.rmtree(resume.parent, ignore_errors=True)
        interrupt()

    monkeypatch.setattr(base, "adapt", interrupted)
    with pytest.raises(Interrupted, match="Ctrl-C"):
        make_levels(base, request(), resume=tmp_path / "state")


def test_a_ladder_in_memory_keeps_no_truths():
    """It is written as PLYs, which round nothing."""
    assert [level.adapted.judge for level in make_levels(wrapped(), request(coarsest=1.0)).levels] == [None]


def test_levels_that_another_run_kept_meanwhile_are_not_mixed_with_these(tmp_path, monkeypatch):
    base = wrapped()
    adapt = base.adapt

    def overtaken(scale, **options):
        make_levels(wrapped(), request(coarsest=0.6), resume=tmp_path / "state")
        return adapt(scale, **options)

    monkeypatch.setattr(base, "adapt", overtaken)
    with pytest.raises(SettingsError, match="levels of another base, viewer or settings"):
        make_levels(base, request(), resume=tmp_path / "state")


def test_a_damaged_unfinished_ladder_is_told(tmp_path):
    (tmp_path / "request.json").write_text("{")
    (tmp_path / "level_0.ply").touch()
    with pytest.raises(SceneError, match=r"request\.json: is not JSON"):
        make_levels(wrapped(), request(), resume=tmp_path)


@pytest.mark.parametrize("write", [anchor_checkpoints.write, moving.write_deformable], ids=["anchors", "moving"])
@pytest.mark.parametrize("by", ["auto", "zoom", "distance"])
def test_what_no_viewer_draws_has_no_levels(tmp_path, write, by):
    write(tmp_path / "base")
    base = wrap_model(tmp_path / "base", cameras=tiny.cameras(2))
    with pytest.raises(SettingsError, match="levels are files for viewers, so adapt it to one scale at a time"):
        make_levels(base, request("supersplat", by=by))


def test_a_level_of_a_kept_ladder_has_views(tmp_path):
    level = make_levels(wrapped(), request(coarsest=1.0), resume=tmp_path / "state").levels[0].adapted
    assert [view.size for view in level.views()] == [view.size for view in wrapped().views()] and "<img" in level._repr_html_()


def test_levels_of_another_ladder_are_not_taken(tmp_path, monkeypatch):
    base = wrapped()
    adapt = base.adapt
    monkeypatch.setattr(base, "adapt", lambda scale, **options: adapt(scale, **options) if scale == 1 else interrupt())
    with pytest.raises(Interrupted):
        make_levels(base, request(), resume=tmp_path / "state")
    with pytest.raises(SettingsError, match="levels of another base, viewer or settings"):
        make_levels(wrapped(), request(coarsest=1 / 8), resume=tmp_path / "state")
    with pytest.raises(SettingsError, match="levels of another base, viewer or settings"):
        make_levels(on_backend(wrapped(), "reference"), request(), resume=tmp_path / "state")
    (tmp_path / "state" / "request.json").write_text("")
    with pytest.raises(SceneError, match=r"request\.json: is not JSON"):
        make_levels(wrapped(), request(), resume=tmp_path / "state")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("mine")
    with pytest.raises(SettingsError, match="it has other things in it"):
        make_levels(wrapped(), request(), resume=tmp_path / "other")


def test_the_command_makes_a_ladder_and_prints_it(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12), count=12)
    options = ["--viewer", "antialiased", "--coarsest", "1/2", "--ratio", "2", "--recipe", "instant", "--views", "given"]
    words = ["levels", str(base), "--output", str(tmp_path / "ladder"), "--json", *options]
    assert cli.main(words) == 0
    manifest = json.loads(capsys.readouterr().out)
    assert manifest == json.loads((tmp_path / "ladder" / MANIFEST).read_text())
    print_summary(tmp_path, manifest)
    said = capsys.readouterr().out
    print_summary(tmp_path, manifest | {"levels": manifest["levels"][:1]})
    assert capsys.readouterr().out.startswith(f"{tmp_path}, for antialiased: 1 level\n")
    assert "2 levels" in said and "level_1.ply  x0.5, shown up to" in said and "at worst" in said
    assert not state_path(tmp_path / "ladder").exists() and not (tmp_path / "ladder" / "report.html").exists()
    assert cli.main(words) == 2 and "--overwrite" in capsys.readouterr().err
