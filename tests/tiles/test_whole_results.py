"""What is adapted in tiles is one whole scene, of one base, at one scale or at several, by the library and by the command."""

import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
from cut_scenes import base_pictures, cut_in_three

from mipmap_plugin import register_viewer
from mipmap_plugin.adaptation.optimization import loop
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.camera import viewmat_of
from mipmap_plugin.cli import main
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.ply import read_header, read_ply
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.mip import MipModel
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.splatting.packing import COLOR_LIMITS
from mipmap_plugin.splatting.viewers import Viewer
from mipmap_plugin.tiles import plan, run
from mipmap_plugin.tiles.reading import make_cut
from mipmap_plugin.tiles.run import adapt_all_in_tiles, adapt_in_tiles
from mipmap_plugin.tiles.truth import Truths
from mipmap_plugin.wrap import wrap_model

# The whole


def test_a_scene_in_tiles_is_whole_and_better_than_its_base(job, monkeypatch):
    bodies = []
    remove = staging._remove

    def read_before(path, folder):
        if path.name == "out.ply.tiles":
            bodies.extend((path / f"part_{n}.ply").read_bytes() for n in range(3))
        remove(path, folder)

    monkeypatch.setattr(staging, "_remove", read_before)
    joined = adapt_in_tiles(replace(job, settings=job.settings | {"merge_to": 0.6}), 3)
    report = joined.report
    assert len(load_vanilla(joined.file)) == report.gaussians_after == sum(tile["splats_after"] for tile in joined.tiles[-3:])
    assert report.gaussians_after < report.gaussians_before == 80
    assert report.psnr_after() > report.psnr_before() and report.returned == "the joined tiles"
    sidecar = json.loads(joined.file.with_name("out.ply.adaptation.json").read_text())
    assert [(tile["sweep"], tile["tile"]) for tile in sidecar["tiles"]] == [(sweep, number) for sweep in (0, 1) for number in range(3)]
    assert sidecar["validation"] == report.validation
    assert '"tiles": 3' in " ".join(read_header(joined.file).comments)
    # The cores stand in the file one after the other.
    cores = b"".join(body[body.index(b"end_header\n") + 11 :] for body in bodies)
    assert joined.file.read_bytes()[read_header(joined.file).body :] == cores


def test_views_that_look_worse_than_the_base_are_told_of_in_tiles_too(tmp_path):
    views = [replace(view, fx=times * view.fx, fy=times * view.fy) for view, times in zip(tiny.cameras(8), (1, 8) * 4, strict=True)]
    job = Job(Base(tiny.folder(tmp_path / "scene", views, count=20)), tmp_path / "out.ply", 1 / 4, recipe="instant")
    with pytest.warns(UserWarning, match="the file for x0.25 looks worse than the base"):
        report = adapt_in_tiles(job, 2).report
    assert any("the file for x0.25 looks worse than the base" in note for note in report.notes)


def test_a_viewer_that_suits_a_scene_less_than_its_own_renderer_does_is_told_of_in_tiles_too(job, tmp_path):
    views, own = tiny.cameras(3, width=20, height=16), TrainedScale("mip", 0.1)
    shown = replace(job, base=Base(tiny.folder(tmp_path / "mip", views, count=80, trained=own)), scale=0.9, viewer="antimatter15")
    settings = {"views": "given", "validation_views": 2, "closed_form": False, "steps": 0, "merge_to": 1.0, "returns": "last"}
    with pytest.warns(UserWarning, match="drawn as its training drew it"):
        report = adapt_in_tiles(replace(shown, settings=settings), 2).report
    whole = wrap_model(shown.base.checkpoint).adapt(0.9, viewer="antimatter15", **settings).report
    assert report.as_trained == pytest.approx(whole.as_trained, abs=0.01) and report.as_trained > report.psnr_after()
    assert [note for note in report.notes if "the base itself has" in note] and [note for note in whole.notes if "the base itself has" in note]
    shown = replace(shown, target=tmp_path / "at_1.ply", scale=1.0)  # where the base so drawn is the truth
    assert adapt_in_tiles(replace(shown, settings=settings), 2).report.as_trained is None


def test_a_viewer_that_rounds_the_positions_of_a_scene_far_out_is_told_of_in_tiles_too(job, tmp_path):
    there, views = tiny.gaussians(80), tiny.cameras(3, width=20, height=16)
    away = torch.tensor([1e6, 0.0, 0.0])
    VanillaModel.from_gaussians(replace(there, means=there.means + away)).save(tmp_path / "far.ply", provenance={})
    moved = [view.looking_from(viewmat_of(view.viewmat[:3, :3].mT, view.center + away.double()), view.name) for view in views]
    write_cameras(tmp_path / "far.json", moved)
    far = replace(job, base=Base(tmp_path / "far.ply", tmp_path / "far.json"), viewer="spark", settings=job.settings | {"steps": 0})
    with pytest.warns(UserWarning, match="spark keeps positions in 16 bits"):
        adapt_in_tiles(far, 2)


def test_a_large_scene_takes_fewer_steps_in_tiles_too(job, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", dict(steps=16, most_draws=1.0, check_every=2))
    settings = {name: value for name, value in job.settings.items() if name != "steps"}
    report = adapt_in_tiles(replace(job, settings=settings), 2).report
    assert report.settings.steps == report.curve[-1].step == 4
    assert report.ended_by.startswith("2 tiles of 4 steps (of 16, because the scene is large")


@pytest.mark.parametrize(
    ("settings", "ended_by", "step"),
    [
        ({}, "2 tiles of 4 steps", 4),
        ({"target_db": 1.0, "warm_up": 0.5}, "target of 1 dB against the pseudo truth, 2 tiles of 2 steps", 2),
        ({"time_budget_s": 1e-6}, "time budget of 1e-06 s, 2 tiles of 1 step at most", 1),
        ({"steps": 0}, "2 tiles of 0 steps", 0),
    ],
)
def test_the_report_says_why_the_run_ended(job, settings, ended_by, step):
    joined = adapt_in_tiles(replace(job, settings=job.settings | settings), 2)
    assert (joined.report.ended_by, joined.report.curve[-1].step) == (ended_by, step)
    if not settings:
        assert {tile["ended_by"] for tile in joined.tiles} == {"the end of the sweep"}


def test_a_file_for_a_filter_that_the_tag_does_not_tell_whole_is_read_back_with_its_dilation(job):
    """The base of tiles too, as one that was converted at x1."""
    base = tiny.folder(job.target.with_name("base"), trained=TrainedScale("mip", 0.1))
    again = replace(job.base, checkpoint=next(base.rglob("point_cloud.ply")), cameras=base / "cameras.json")
    for asked in (replace(job, viewer="mip"), replace(job, base=again, target=job.target.with_name("again.ply"))):
        made = load_model(adapt_in_tiles(replace(asked, settings=job.settings | {"steps": 0}), 2).file)
        assert (made.trained.screen_filter, made.trained.eps2d) == ("mip", 0.1)
        assert isinstance(made, MipModel) == (asked.viewer == "mip")  # whose loader requires filter_3D


def test_tiles_stay_within_the_colors_that_a_viewers_file_holds(job):
    bright = tiny.gaussians(80)
    bright.sh[:, 0] += 1
    base = Base(VanillaModel.from_gaussians(bright).save(job.target.with_name("bright.ply"), provenance={}), job.base.checkpoint / "cameras.json")
    made = load_vanilla(adapt_in_tiles(replace(job, base=base, viewer="spark"), 2).file)
    assert made.parameters()["sh0"].max() <= np.float32(COLOR_LIMITS[1])


def test_a_model_folder_is_written_as_one(job, tmp_path):
    joined = adapt_in_tiles(replace(job, target=tmp_path / "out"), 2)
    assert (tmp_path / "out" / "cameras.json").is_file() and (tmp_path / "out" / "cfg_args").is_file()
    assert joined.file == tmp_path / "out" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    assert len(load_vanilla(tmp_path / "out")) == joined.report.gaussians_after


def test_a_model_folder_is_written_beside_the_checkpoint(job, capsys):
    """Where the scale in its name looks like a suffix."""
    words = ["adapt", str(job.base.checkpoint), "--scale", "1/2", "--steps", "0", "--views", "given", "--tiles", "2"]
    assert main([*words, "--cameras", str(job.base.checkpoint.with_name("{name}") / "cameras.json")]) == 0
    assert (job.base.checkpoint.with_name("scene_x0.5") / "point_cloud").is_dir()


def test_the_bar_of_a_tile_says_which_it_is_and_no_db(job, monkeypatch):
    """Which it has not: it is measured as a part of the whole."""
    told, began = [], loop.StepsBar.__init__
    monkeypatch.setattr(loop.StepsBar, "__init__", lambda bar, **options: (told.append(options["desc"]), began(bar, **options))[1])
    monkeypatch.setattr(loop.StepsBar, "set_postfix_str", lambda bar, text: told.append(text))
    monkeypatch.setattr(run, "announced", lambda what: (told.append(what), nullcontext())[1])
    adapt_in_tiles(replace(job, settings=job.settings | {"closed_form": False, "steps": 2}), 2)
    assert set(told) == {"cutting", "adapting tile 1 x0.5", "adapting tile 2 x0.5", "40 splats", "measuring the whole", "writing out.ply"}


def test_the_steps_of_tiles_load_no_compiler(job, monkeypatch):
    """As without tiles, where a backend moves the splats, too."""
    monkeypatch.setitem(sys.modules, "torch.fx.experimental.symbolic_shapes", None)
    assert adapt_in_tiles(job, 2).report.curve[-1].step > 0


def test_no_tile_grows_beyond_what_the_settings_allow(job):
    settings = dict(steps=8, prune_every=2, densify_gradient=1e-9, most_growth=1.2, views="given", validation_views=2)
    assert 80 < adapt_in_tiles(replace(job, recipe="paper", settings=settings), 2).report.gaussians_after <= 96


def test_tiles_without_cameras_have_the_filter_that_fits_generated_views(job):
    job = replace(job, base=Base(tiny.ply(job.target.with_name("bare.ply"), count=80)), scale=1 / 16)  # of 24 px
    assert adapt_in_tiles(replace(job, settings=job.settings | {"steps": 0}), 2).report.settings.resize == "area"


# Several scales


def test_scales_share_the_cut_and_the_pictures_of_the_base(job, monkeypatch):
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.25)]
    alone = adapt_in_tiles(replace(jobs[1], target=job.target.with_name("alone.ply")), 2).file
    cuts, sizes = [], base_pictures(monkeypatch)
    monkeypatch.setattr(plan, "make_cut", lambda *asked: (cuts.append(asked), make_cut(*asked)))
    files = [joined.file for joined in adapt_all_in_tiles(jobs, 2)]
    assert len(cuts) == 1 and sizes == [(16, 20)] * 5  # three views, and two of validation
    assert read_ply(files[1]).columns["x"].tobytes() == read_ply(alone).columns["x"].tobytes()


@pytest.mark.parametrize("scale", [0.5, 0.125])
def test_truths_are_those_without_tiles(job, scale):
    """At x1/8 too, where the base is drawn with half of its pixels."""
    scene = cut_in_three(replace(job, scale=scale))
    expected = PseudoTruth(BaseImages(scene.wrapped.model, scene.backend, scene.base_effects), scale, scene.config)
    for view in scene.used_views:
        torch.testing.assert_close(Truths(scene)[view.name], expected(view), atol=1e-4, rtol=0)


def test_scales_of_other_views_draw_their_own(job, monkeypatch):
    """At x1/8 four samples a pixel are drawn from half of the base's pixels."""
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.125)]
    sizes = base_pictures(monkeypatch)
    assert all(joined.file.exists() for joined in adapt_all_in_tiles(jobs, 2))
    assert sizes == [(16, 20)] * 5 + [(8, 10)] * 5


def test_viewers_of_other_near_planes_draw_their_own_views(job):
    """Nothing but splats a tenth of a unit away is in the second view, which one viewer draws and the other does not."""
    register_viewer("close", Viewer("close", "One that draws what is close", "nowhere", "classic", 0.3, near_plane=0.01), replace=True)
    away = torch.tensor([50.0, 0, 0])
    near = replace(tiny.gaussians(40, spread=0.005), scales=torch.full((40, 3), 0.002))
    whole = tiny.gaussians(80).joined(replace(near, means=near.means + away))
    first, *others = tiny.cameras(3, width=20, height=16)
    beside = first.looking_from(viewmat_of(torch.eye(3, dtype=torch.float64), away.double() - torch.tensor([0, 0, 0.1])), "near")
    base = job.target.with_name("near")
    VanillaModel.from_gaussians(whole, TrainedScale()).save(base, provenance={})
    write_cameras(base / "cameras.json", [first, beside, *others])
    job = replace(job, base=Base(base))
    jobs = [replace(job, viewer=viewer, target=job.target.with_name(f"{viewer}.ply")) for viewer in ("classic", "close")]
    alone = adapt_in_tiles(replace(jobs[1], target=job.target.with_name("alone.ply")), 2)
    *_, last = adapt_all_in_tiles(jobs, 2)
    assert "4 given views" in alone.report.views and last.report.validation == alone.report.validation


# The command


def test_the_command(job, capsys):
    options = ["--scale", "1/2", "--steps", "0", "--views", "given", "--output", str(job.target)]
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2"]) == 0
    out = capsys.readouterr().out
    assert "x0.5, 2 tiles:" in out and str(job.target) in out
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2", "--skip-existing", "--overwrite"]) == 0
    assert "finished before" in capsys.readouterr().out
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2", "--skip-existing", "--json"]) == 0
    assert [report["file"] for report in json.loads(capsys.readouterr().out)] == [str(job.target)]


def test_the_command_for_several_scales_skips_what_is_finished(job, capsys):
    options = ["--steps", "0", "--views", "given", "--tiles", "2", "--scale", "1/2"]
    assert main(["adapt", str(job.base.checkpoint), *options, "--json"]) == 0
    capsys.readouterr()
    assert main(["adapt", str(job.base.checkpoint), *options, "--scale", "1/4", "--json"]) == 0
    reports = json.loads(capsys.readouterr().out)
    assert [report["scale"] for report in reports] == [0.5, 0.25]


def test_the_command_skips_what_is_finished_of_a_network_that_tiles_do_not_use(job, tmp_path, capsys):
    (tmp_path / "net.pth").write_bytes(b"weights")
    options = ["--steps", "0", "--views", "given", "--tiles", "2", "--scale", "1/2", "--upsampler", str(tmp_path / "net.pth")]
    words = ["adapt", str(job.base.checkpoint), *options]
    assert main(words) == 0 and "is not used, because x0.5 is no zoom-in" in capsys.readouterr().err
    assert main([*words, "--skip-existing"]) == 0 and "finished before" in capsys.readouterr().out


def test_the_command_removes_the_lock_of_one_that_was_killed_at_a_further_scale(job):
    """It held those of all its scales."""
    options = ["--steps", "0", "--views", "given", "--tiles", "2", "--scale", "1/2", "--json"]
    assert main(["adapt", str(job.base.checkpoint), *options]) == 0
    lock = job.base.checkpoint.with_name(".scene_x0.5.tiles.lock")
    lock.mkdir()
    assert main(["adapt", str(job.base.checkpoint), *options, "--skip-existing"]) == 0 and not lock.exists()


def test_the_command_says_how_to_go_on_with_several_scales(job, capsys, monkeypatch):
    monkeypatch.setattr(run, "adapt_all_in_tiles", Mock(side_effect=KeyboardInterrupt("interrupted")))
    options = ["adapt", str(job.base.checkpoint), "--steps", "0", "--tiles", "2", "--scale", "1/2"]
    two = ["--scale", "1/4"]
    for further, again in (([], "again to go on"), (two, "again to go on"), ([*two, "--overwrite"], "with --skip-existing")):
        assert main([*options, *further]) == 130
        assert again in capsys.readouterr().err
