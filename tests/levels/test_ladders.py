"""Ladders: which levels they keep, what is saved of them, and what is said."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import anchor_checkpoints
import moving
import pytest
import tiny
import torch
from brief_levels import BRIEF, request, wrapped

from mipmap_plugin import cli, load_model, wrap_model
from mipmap_plugin.adaptation.report import AS_IT_IS, Report
from mipmap_plugin.commands.ladder_summary import print_summary
from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.levels.contents import LeftOut, Level
from mipmap_plugin.levels.ladder import NO_FEWER, NOT_BETTER, UNSHOWN, _no_use, _shown, _Work, make_levels
from mipmap_plugin.levels.manifest import MANIFEST, THREE_JS, TOLD, base_pixel, looked_at, read_manifest, refuse_ladder, view_pixel
from mipmap_plugin.levels.request import MERGING_COSTS, Band
from mipmap_plugin.models.places import state_path
from mipmap_plugin.models.vanilla import VanillaModel

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")

BAND = Band(1.0, 0.7, 1.0, 2.0)


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
    ("returned", "splats", "psnr", "reason"),
    [
        ("merged splats", 18, 20, None), ("merged splats", 19, 29, NO_FEWER), ("merged splats", 20, 30.4, NO_FEWER), ("step 3", 22, 30, NO_FEWER),
        ("the closed form", 22, 40, None), (f"{AS_IT_IS}: 30 dB", 20, 30, NOT_BETTER), (f"{AS_IT_IS}: 30 dB", 20, 31, None),
    ],
)  # fmt: skip
def test_a_coarser_level_has_clearly_fewer_splats_than_the_finer_one_or_is_better(returned, splats, psnr, reason):
    report = Report.model_construct(returned=returned, validation={})
    level, finer = (Level(SimpleNamespace(psnr=db, report=report, model=tiny.model(n)), BAND) for db, n in ((psnr, splats), (30, 20)))
    assert _no_use(level, finer, SimpleNamespace(psnr=lambda each, _: each.psnr)) == reason


@pytest.mark.parametrize(("psnr", "base", "splats"), [(27.5, 20, 2), (26.5, 20, 8), (27.5, 28, 8), (29.6, 29.8, 2)])
def test_a_level_whose_steps_regain_too_little_of_what_merging_cost_is_made_again(monkeypatch, psnr, base, splats):
    """It may be 3 dB worse than the finer level, whose PSNR is 30 dB, but not worse than the base, unless it is as good as the finer level."""
    monkeypatch.setattr("mipmap_plugin.levels.ladder.MOST_LOST", 3.0)
    few, many = (SimpleNamespace(psnr=db, model=tiny.model(n)) for db, n in ((psnr, 2), (29, 8)))
    frozen = SimpleNamespace(adapt=lambda scale, *, merging_costs, **_: few if merging_costs == MERGING_COSTS else many)
    yardstick = SimpleNamespace(psnr=lambda each, _: each.psnr, psnr_of_base=lambda *_: base)
    work = _Work(frozen, request(), SimpleNamespace(level=lambda name, make: make(None)), yardstick)
    made, _ = work._next(Level(SimpleNamespace(psnr=30, model=tiny.model(9)), BAND), BAND, 1, 2.0)
    assert made.splats == splats


def test_a_level_that_is_shown_at_no_zoom_is_left_out():
    """Level 1 is worse than both neighbors, so that each of its switches lies at its own scale."""
    levels = [Level(SimpleNamespace(number=number, model=tiny.model(3 - number)), Band(0.5**number, 0.7 * 0.5**number, 1, 2)) for number in range(3)]
    dbs = [lambda zoom: 40 + 10 * math.log2(zoom), lambda _: 10, lambda zoom: 30 - 5 * math.log2(zoom / 0.25)]
    yardstick = SimpleNamespace(psnr=lambda level, zoom: dbs[level.number](zoom), likeness=lambda *_: 30)
    shown, switches, left_out = _shown(levels, yardstick, 0.1)
    assert shown == [levels[0], levels[2]] and len(switches) == 1 and 0.25 < switches[0].zoom < 1
    assert left_out == [LeftOut(0.5, 2, UNSHOWN)]


@pytest.mark.parametrize(("ends", "kept"), [(0.46, 2), (0.4, 3)])
def test_a_level_that_is_hardly_shown_is_left_out(ends, kept):
    """Level 1 is as good as level 0 at x0.47, and as level 2 where it `ends`."""
    levels = [Level(SimpleNamespace(number=n, model=tiny.model(3 - n)), Band(0.55**n, 0.7 * 0.55**n, 1, 2)) for n in range(3)]
    dbs = [lambda zoom: 30 + 400 * math.log2(zoom / 0.47), lambda _: 30, lambda zoom: 30 - 400 * math.log2(zoom / ends)]
    yardstick = SimpleNamespace(psnr=lambda level, zoom: dbs[level.number](zoom), likeness=lambda *_: 30)
    shown, switches, left_out = _shown(levels, yardstick, 0.1)
    assert len(shown) == kept == len(switches) + 1 == 3 - len(left_out)


def test_a_level_is_not_shown_where_a_coarser_one_is_better(monkeypatch):
    """Level 2 is better than level 1 at that one's own scale, x1/2, and up to x0.7."""
    for step in ("FIRST_STEP", "SECOND_STEP"):
        monkeypatch.setattr(f"mipmap_plugin.levels.switching.{step}", 1.05)
    levels = [Level(SimpleNamespace(number=number), Band(0.5**number, 0.7 * 0.5**number, 1, 2)) for number in range(3)]
    dbs = [lambda zoom: 40 + 40 * math.log2(zoom), lambda _: 30, lambda zoom: 30 - 10 * math.log2(zoom / 0.7)]
    yardstick = SimpleNamespace(psnr=lambda level, zoom: dbs[level.number](zoom), likeness=lambda *_: 30)
    _, switches, left_out = _shown(levels, yardstick, 0.1)
    assert 0.8 < switches[0].zoom < 0.9 and 0.65 < switches[1].zoom < 0.75 and not left_out


@pytest.mark.parametrize(("end", "zoom"), [(0.1, 0.4), (0.45, 0.45)])
def test_a_level_is_shown_below_the_scale_of_the_coarser_one_where_it_is_better_until_the_ladder_ends(monkeypatch, end, zoom):
    """Level 0 is better than level 1 at that one's own scale, x1/2, and down to x0.4."""
    for step in ("FIRST_STEP", "SECOND_STEP"):
        monkeypatch.setattr(f"mipmap_plugin.levels.switching.{step}", 1.02)
    levels = [Level(SimpleNamespace(number=number), Band(0.5**number, 0.7 * 0.5**number, 1, 2)) for number in range(2)]
    dbs = [lambda zoom: 30 + 10 * math.log2(zoom / 0.4), lambda _: 30]
    yardstick = SimpleNamespace(psnr=lambda level, zoom: dbs[level.number](zoom), likeness=lambda *_: 30)
    _, (switch,), _ = _shown(levels, yardstick, end)
    assert switch.zoom == pytest.approx(zoom, rel=0.05)


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
    shown = [[point["psnr_db"] for point in manifest["curve"] if point["level"] == number] for number in range(2)]
    assert manifest["switches"][0]["step_db"] == pytest.approx(shown[0][-1] - shown[1][0])
    assert manifest["worst_db"] == min(point["psnr_db"] for point in manifest["curve"]) and manifest["viewer"] == "antialiased"
    assert [point["zoom"] for point in manifest["curve"]] == sorted((point["zoom"] for point in manifest["curve"]), reverse=True)
    with pytest.raises(OutputExists, match="exists already"):
        refuse_ladder(saved, base, overwrite=False)
    (saved / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match=r"has other things in it, such as notes.txt"):
        refuse_ladder(saved, base, overwrite=True)


def test_splats_in_no_picture_have_no_part_in_the_size_of_a_pixel():
    """More than half of all lie right behind the camera, whose distances would follow from them."""
    views, ball = tiny.cameras(1), tiny.gaussians(50)
    behind = tiny.gaussians(60, spread=1e-4, seed=2)
    eye = views[0].center.float()
    hidden = replace(behind, means=behind.means + eye + 0.2 * eye / eye.norm())
    both = ball.joined(hidden)
    sizes = [base_pixel(wrap_model(VanillaModel.from_gaussians(each), cameras=views)) for each in (ball, both, hidden)]
    assert sizes[0] == sizes[1] and 0 < sizes[2] < sizes[0] / 5


def test_the_views_of_the_training_are_at_x1_by_what_they_look_at():
    """Not by what is closest to one of them: viewers would change levels nearer than these are measured."""
    views, ball = [camera.zoomed(scale) for camera, scale in zip(tiny.cameras(3), (1, 1, 2), strict=True)], tiny.gaussians(500, spread=0.3)
    away = float((views[0].center - ball.means.double().median(0).values).norm())
    assert view_pixel(wrap_model(VanillaModel.from_gaussians(ball), cameras=views)) == pytest.approx(away / views[0].fx, rel=0.05)


def test_a_page_sees_the_views_of_the_training_at_x1_also_where_these_look_past_the_middle():
    """Most of what each shows lies three times as far away as the middle of all splats, and one shows nothing."""
    views, ball = tiny.cameras(3), tiny.gaussians(200, spread=0.3)
    away = ball.means.median(0).values - torch.stack([view.center.float() for view in views]).mean(0)
    scene = replace(tiny.gaussians(300, spread=0.3, seed=2), means=tiny.gaussians(300, spread=0.3, seed=2).means + 2 * away).joined(ball)
    blind = replace(views[0], viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).to(views[0].viewmat) @ views[0].viewmat)
    told = torch.tensor(looked_at(wrap_model(VanillaModel.from_gaussians(scene), cameras=[*views, blind])), dtype=torch.float64)
    assert TOLD / 2 < len(told) <= TOLD + 4
    for view in views:
        points = view.to_camera(told[:, :3])
        zooms = (told[:, 3] * view.fx / points[:, 2])[view.in_picture(points)]
        assert float(zooms.median()) == pytest.approx(1, rel=0.1)


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


def test_levels_for_mip_splatting_start_from_finer_ones_that_are_kept(tmp_path):
    """Whose files have the column filter_3D, which makes them checkpoints of another family."""
    ladder = make_levels(wrapped(), request("mip", coarsest=1 / 2, steps=0), resume=tmp_path / "kept")
    assert [len(level.adapted.model) for level in ladder.levels][1:] and (ladder.save(tmp_path / "ladder") / MANIFEST).is_file()


@pytest.mark.parametrize("has_cameras", [True, False])
def test_the_command_tells_of_generated_views_and_the_size_of_a_small_level_in_kilobytes(tmp_path, capsys, has_cameras):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)) if has_cameras else tiny.ply(tmp_path / "base.ply")
    words = ["levels", str(base), "--viewer", "classic", "--output", str(tmp_path / "ladder"), "--coarsest", "1"]
    assert cli.main([*words, "--backend", "cpu", "--threads", "1"]) == 0
    said, size = capsys.readouterr(), json.loads((tmp_path / "ladder/levels.json").read_text())["levels"][0]["bytes"]
    assert ("no cameras are known" in said.err) is not has_cameras and f" splats, {size / 1e3:.0f} kB, " in said.out


@pytest.mark.parametrize(
    ("viewer", "by", "lies", "told"), [("spark", "zoom", True, True), ("classic", "zoom", True, False), ("spark", "distance", False, False)]
)
def test_a_ladder_by_zoom_has_the_module_for_three_js(tmp_path, capsys, viewer, by, lies, told):
    """And what it needs to know of the scene. It is told of for viewers of three.js."""
    base, ladder = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)), tmp_path / "ladder"
    words = ["levels", str(base), "--viewer", viewer, "--by", by, "--output", str(ladder), "--coarsest", "1/2", "--steps", "1", "--views", "given"]
    assert cli.main(words) == 0
    assert (ladder / THREE_JS).is_file() is lies and (str(ladder / THREE_JS) in capsys.readouterr().out) is told
    if lies:
        means = load_model(ladder / "level_0.ply").parameters()["means"]
        assert read_manifest(ladder)["middle"] == pytest.approx(means.median(0).values.tolist())


def test_a_ladder_in_memory_keeps_no_truths():
    """It is written as PLYs, which round nothing."""
    assert [level.adapted.judge for level in make_levels(wrapped(), request(coarsest=1.0)).levels] == [None]


@pytest.mark.parametrize("write", [anchor_checkpoints.write, moving.write_deformable], ids=["anchors", "moving"])
@pytest.mark.parametrize("by", ["auto", "zoom", "distance"])
def test_what_no_viewer_draws_has_no_levels(tmp_path, write, by):
    write(tmp_path / "base")
    base = wrap_model(tmp_path / "base", cameras=tiny.cameras(2))
    with pytest.raises(SettingsError, match="levels are files for viewers, so adapt it to one scale at a time"):
        make_levels(base, request("supersplat", by=by))


@pytest.mark.parametrize(
    ("lost", "told"),
    [((-2, 0.4, 0.5), ""), ((1, 0.9, 0.2), "at x1 to x0.5 the base alone is better, by up to 1.0 dB"), ((0, 0, 2.6), "at x0.25 the")],
)
def test_it_is_told_where_the_base_alone_is_better(tmp_path, capsys, lost, told):
    curve = [{"zoom": 0.5**number, "psnr_db": 30.0, "base_db": 30.0 + db} for number, db in enumerate(lost)]
    print_summary(tmp_path, {"viewer": "spark", "levels": [], "switches": [], "curve": curve, "worst_db": 30, "mean_db": 30, "measured": ""})
    said = capsys.readouterr().out
    assert told in said if told else "better" not in said


def test_no_level_advises_to_leave_out_the_viewer_that_a_ladder_needs(monkeypatch, recwarn):
    monkeypatch.setattr("mipmap_plugin.adaptation.session.psnr_as_trained", lambda *_: 99.0)
    advice = "adapt without a viewer"
    wrapped().adapt(1 / 2, viewer="antialiased", **BRIEF)
    assert advice in str(recwarn.pop(UserWarning).message)
    ladder = make_levels(wrapped(), request(coarsest=1 / 2))
    assert not any(advice in str(each.message) for each in recwarn) and advice not in str([level.adapted.report.notes for level in ladder.levels])


def test_the_command_makes_a_ladder_and_prints_it(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12), count=12)
    options = ["--viewer", "antialiased", "--coarsest", "1/2", "--ratio", "2", "--recipe", "instant", "--views", "given"]
    words = ["levels", str(base), "--output", str(tmp_path / "ladder"), "--json", *options]
    assert cli.main(words) == 0
    manifest = json.loads(capsys.readouterr().out)
    assert manifest == json.loads((tmp_path / "ladder" / MANIFEST).read_text())
    print_summary(tmp_path, manifest)
    said = capsys.readouterr().out
    base = [point["base_db"] for point in manifest["curve"]]
    assert f"the base alone: at worst {min(base):.1f} dB, {sum(base) / len(base):.1f} on average\n" in said
    print_summary(tmp_path, manifest | {"levels": manifest["levels"][:1]})
    assert capsys.readouterr().out.startswith(f"{tmp_path}, for antialiased: 1 level\n")
    print_summary(tmp_path, manifest | {"levels": [manifest["levels"][0] | {"psnr_db": {"1": 27.53, "0.5": 27.46}}]})
    assert ": 27.5 dB, " in capsys.readouterr().out
    assert "2 levels" in said and "level_1.ply  x0.5, shown up to" in said and "at worst" in said
    assert f", at most {abs(manifest['switches'][0]['step_db']):.1f} lost or gained at a switch; the base" in said
    assert not state_path(tmp_path / "ladder").exists() and not (tmp_path / "ladder" / "report.html").exists()
    assert cli.main(words) == 2 and "--overwrite" in capsys.readouterr().err
