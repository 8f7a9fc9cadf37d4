"""Ladders by distance: which levels they keep, what is saved of them, and the command."""

import json
import weakref
from contextlib import nullcontext

import pytest
import tiny
import torch
from levels_by_distance import with_background, wrapped
from pages_read import record_of

from mipmap_plugin import cli, load_model, wrap_model
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.adaptation.views.farther import foreground
from mipmap_plugin.commands.levels import print_summary
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.levels.distance.ladder import by_distance, scene_of
from mipmap_plugin.levels.distance.level import AS_FINER, LevelRun
from mipmap_plugin.levels.manifest import MANIFEST, read_manifest
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.levels.streamed import distances, progression
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.pages.walks import walks_page
from mipmap_plugin.scenes import write_cameras

pytestmark = pytest.mark.usefixtures("few_views")

BRIEF = dict(steps=4, extra_views=2, validation_views=2, warm_up=0, views_per_step=1)


def test_a_ladder_from_end_to_end(tmp_path, small_chunks, capsys):
    """The far splats of every level are those of the first; the manifest gives what PlayCanvas is set to."""
    base = wrapped()
    ladder = base.levels("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF)
    folder = ladder.save(tmp_path / "levels")
    manifest = json.loads((folder / MANIFEST).read_text())
    files = [load_model(folder / level["file"]).gaussians(base.any_camera()) for level in manifest["levels"]]
    assert manifest["by"] == "distance" and len(files) == 3
    first, last = files[0], files[-1]
    far = ladder.contents.scene.pixel_of(first.means) >= manifest["levels"][-1]["pixel_from"] * 2**0.5
    torch.testing.assert_close(last.means[: far.sum()], first.means[far], rtol=1e-6, atol=1e-6)
    assert not torch.equal(last.means[far.sum() :], first.means[~far][: len(last) - far.sum()])
    assert progression(distances(manifest, manifest["canvas"]), 2.0) == pytest.approx((manifest["lodBaseDistance"], manifest["lodMultiplier"]))
    assert manifest["levels"][0]["distance_to"] == pytest.approx(manifest["lodBaseDistance"]) == manifest["levels"][1]["distance_from"]
    assert manifest["levels"][-1]["distance_to"] is None
    assert [level["scale"] for level in manifest["levels"]] == [level.report.scale for level in ladder.contents.levels]
    near, pixels = manifest["base_pixel"], [level["pixel_from"] for level in manifest["levels"][1:]]
    assert [level["scale"] for level in manifest["levels"][1:]] == pytest.approx([near / (pixel * 2**0.5) for pixel in pixels])
    assert [point["pixel"] for point in manifest["curve"]] == sorted({point["pixel"] for point in manifest["curve"]})
    assert [point["zoom"] for point in manifest["curve"]] == pytest.approx([near / point["pixel"] for point in manifest["curve"]])
    keyed = {zoom: psnr for level in manifest["levels"] for zoom, psnr in level["psnr_db"].items()}
    assert keyed == {f"{point['zoom']:.4g}": point["psnr_db"] for point in manifest["curve"]}
    seconds = dict(ladder.levels[-1].report.seconds)
    assert sum(seconds.values()) == pytest.approx(2 * seconds["total"])  # of all phases
    print_summary(folder, manifest)
    assert "3 levels by distance" in capsys.readouterr().out


def test_level_0_is_adapted_to_views_from_farther_back_too(small_chunks):
    """Each view of the training once more, from where its nearest parts are at a scale down to the coarsest."""
    base = wrapped()
    scene = scene_of(base, request := LadderRequest.of("classic", by="distance", coarsest=1 / 4, **BRIEF), request.first_band(base))
    depths, farther = ([foreground(view, scene.splats.means, 0.01) for view in views] for views in (scene.views, scene.farther()))
    scales = [near / far for near, far in zip(depths, farther, strict=True)]
    assert all(1 / 4 < scale < 1 for scale in scales) and max(scales) > 2 * min(scales)
    assert base.levels("classic", by="distance", coarsest=1 / 4, **BRIEF).contents.levels[0].report.views.startswith("6 train views")


def test_levels_by_distance_have_the_filter_of_pictures_of_full_size(small_chunks):
    base, request = wrapped(), LadderRequest.of("classic", by="distance", coarsest=1 / 64, ratio=4.0, **BRIEF)
    scene = scene_of(base, request, request.first_band(base))
    assert {scene.config(level).resize for level in range(1, scene.rule.count)} == {"pil-bicubic"}


@pytest.mark.parametrize(
    ("db", "name"),
    [
        ((30.0, 36.0, 34.0), "merged splats of the finer level"),  # half of the gain is kept
        ((30.0, 36.0, 32.0), "the finer level in closed form"),
        ((30.0, 29.0, 29.8), "merged splats of the finer level"),  # what merging may cost in any recipe
        ((30.0, 29.0, 29.5), AS_FINER),  # all would be worse than that
    ],
)
def test_a_level_that_no_step_betters_is_not_merged_at_any_cost(small_chunks, monkeypatch, db, name):
    """`db`: of the finer level as it is, in closed form, and merged."""
    finer, formed, merged = db
    base, coarser = wrapped(), LevelRun._coarser
    request = LadderRequest.of("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF | {"steps": 0})
    band = request.first_band(base)
    first, quality = base.adapt(1.0, **request.for_first(base, band)).model, {}

    def noted(self, weights, kept):
        student = coarser(self, weights, kept)
        quality[student] = formed if weights is None else merged
        return student

    monkeypatch.setattr(LevelRun, "_coarser", noted)
    monkeypatch.setattr(Validation, "steer", lambda self, model: quality.get(model, finer))
    student, told = LevelRun(scene_of(base, request, band), 1, [first])._start()
    assert told == name
    if name == AS_FINER:
        assert torch.equal(student.parameters()["means"], first.parameters()["means"])


def test_centers_move_by_pixels_of_the_level(small_chunks, monkeypatch):
    """And not by those at the median splat, which may be far away and not move."""
    base, options, pixels = wrapped(), dict(by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF), []

    def noted(model, config, pixel):
        pixels.append(pixel)
        return make_optimizer(model, config, pixel)

    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.run.make_optimizer", noted)
    rule = base.levels("classic", **options).contents.scene.rule
    assert pixels[-2:] == [rule.middle(1), rule.middle(2)]


def test_runs_are_steered_and_states_chosen_by_whole_pictures(small_chunks):
    """By its share of each pixel, a level that spoils what lies behind it looks as good as another."""
    base, request = wrapped(near=100, far=60), LadderRequest.of("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF)
    run = LevelRun(scene_of(base, request, request.first_band(base)), 1, [base.model])
    report = (made := run.run(None)).report
    assert report.returned.startswith("the start")
    for views, told in (("choosing", report.validation[report.returned]), ("steering", report.curve[0].validation_db)):
        [shown], [share] = (each.viewer_psnrs(made.model, getattr(each, views)) for each in (run.whole, run.validation))
        assert told == pytest.approx(shown) != pytest.approx(share)


def test_a_level_keeps_no_pictures_when_it_is_made(small_chunks, monkeypatch):
    """They take gigabytes, and those of all levels filled the memory of a small machine."""
    runs, others = [], []

    class Noted(LevelRun):
        def __post_init__(self):
            others.append(sum(run() is not None for run in runs))
            runs.append(weakref.ref(self))
            super().__post_init__()

    monkeypatch.setattr("mipmap_plugin.levels.distance.ladder.LevelRun", Noted)
    wrapped().levels("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF)
    assert others == [0, 0]


def test_what_takes_long_is_announced(small_chunks, monkeypatch):
    told = []
    for module in ("ladder", "level"):
        monkeypatch.setattr(f"mipmap_plugin.levels.distance.{module}.announced", lambda what: (told.append(what), nullcontext())[1])
    wrapped().levels("classic", by="distance", coarsest=1 / 2, ratio=2.0, **BRIEF)
    first = ["cutting the scene into chunks", "level 0: choosing views"]
    assert told == [*first, "level 1: choosing views", "level 1: merging", "level 1: validation", "measuring the levels"]


def test_a_level_that_is_worse_than_the_finer_one_says_so(small_chunks, monkeypatch):
    monkeypatch.setattr(LevelRun, "_as_finer", lambda *_: 99.0)
    with pytest.warns(UserWarning, match=r"level_1: pictures in which it is shown have .* dB, and 99\.0 with the finer level in its place"):
        report = wrapped().levels("classic", by="distance", coarsest=1 / 2, ratio=2.0, **BRIEF).contents.levels[1].report
    assert report.validation[AS_FINER] == 99.0 and any(note.startswith("level_1:") for note in report.notes)


def test_a_level_whose_steps_gain_nothing_at_rates_that_do_no_harm_ends(small_chunks, monkeypatch):
    """Where a file of its own would go on at full rates, as level 0 does: there is little to lose."""
    monkeypatch.setattr(Steering, "is_stuck", lambda self, progress, config: progress >= 0.5)
    ladder = wrapped().levels("playcanvas", by="distance", coarsest=1 / 2, ratio=2.0, **BRIEF | {"steps": 4})
    first, level = (each.report for each in ladder.contents.levels)
    assert first.ended_by == "4 steps" and level.ended_by == "2 steps, which gained nothing at rates that do no harm"
    assert level.curve[-1].step == 2


def test_a_level_at_the_end_that_is_the_finer_one_again_is_left_out(tmp_path, small_chunks, monkeypatch, capsys):
    base, start = wrapped(near=100, far=60), LevelRun._start
    options = dict(by="distance", coarsest=1 / 8, ratio=2.0, **BRIEF | {"steps": 0})
    whole = base.levels("classic", **options).contents
    assert len(whole.levels) == 4 and not whole.left_out

    def repeating(self):
        student = start(self)
        return (self._for_target(), AS_FINER) if self.number in (1, 3) else student

    monkeypatch.setattr(LevelRun, "_start", repeating)
    ladder = base.levels("classic", **options)
    assert len(ladder.levels) == 3  # the first stays, for another one comes after it
    manifest = read_manifest(ladder.save(tmp_path / "ladder"))
    [left_out], curve = manifest["left_out"], manifest["curve"]
    assert left_out["scale"] == whole.scene.scale(3) and left_out["splats"] == manifest["levels"][2]["splats"]
    assert len(manifest["switches"]) == 2 and manifest["levels"][2]["pixel_to"] is None
    assert [point["pixel"] for point in curve] == [point.pixel for point in whole.curve] and curve[-1]["level"] == 2
    print_summary(tmp_path / "ladder", manifest)
    assert "where a neighbor is shown: nothing was better than the finer level as it is" in capsys.readouterr().out
    assert walks_page("ladder", ladder.contents, manifest, ()).zooms


def test_an_interrupted_ladder_goes_on_with_its_finished_levels(tmp_path, small_chunks, monkeypatch):
    base, options, made = wrapped(near=100, far=60), dict(by="distance", coarsest=1 / 4, ratio=2.0, resume=tmp_path / "state", **BRIEF), []
    whole = base.levels("classic", **{**options, "resume": tmp_path / "other"})
    run = LevelRun.run

    def stopped(self, resume):
        made.append(self.number)
        if len(made) == 2:
            raise KeyboardInterrupt
        return run(self, resume)

    monkeypatch.setattr(LevelRun, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        base.levels("classic", **options)
    resumed = base.levels("classic", **options)
    assert made == [1, 2, 2]
    for one, other in zip(whole.levels, resumed.levels, strict=True):
        assert all(torch.equal(tensor, other.model.parameters()[name]) for name, tensor in one.model.parameters().items())


@pytest.mark.parametrize(
    ("viewer", "by", "far", "expected"),
    [("supersplat", "auto", 200, True), ("supersplat-viewer", "auto", 200, True), ("spark", "auto", 200, False),
     ("supersplat", "auto", 0, False), ("spark", "distance", 0, True), ("supersplat", "zoom", 200, False)],
)  # fmt: skip
def test_auto_is_by_distance_for_streaming_viewers_of_unbounded_scenes(viewer, by, far, expected):
    assert by_distance(wrapped(far=far) if far else wrap_model(tiny.model(), cameras=tiny.cameras(6)), LadderRequest(viewer, by=by)) is expected


def test_auto_is_by_zoom_where_no_cameras_tell_distances():
    """Captures of strangers are shown worse than their bases by the distances of a generated orbit."""
    alone = wrap_model(wrapped().model)
    alone.cameras = []
    assert not by_distance(alone, LadderRequest("supersplat", by="auto"))
    assert by_distance(alone, LadderRequest("supersplat", by="distance"))


def test_auto_is_by_zoom_where_a_bound_asks_for_it():
    assert not by_distance(wrapped(), LadderRequest("supersplat", by="auto", least_db=30.0))
    assert by_distance(wrapped(), LadderRequest("supersplat", by="auto"))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"by": "size"}, "by: must be one of"),
        ({"by": "distance", "least_db": 30.0}, "leave both out"),
        ({"by": "distance", "merge_to": 0.5}, "merge_to:"),
    ],
)
def test_impossible_requests_are_refused(options, reason):
    with pytest.raises(SettingsError, match=reason):
        wrapped(near=20, far=20).levels("classic", **options)


@pytest.fixture
def command(tmp_path):
    """Words of a command that makes a small ladder by distance in tmp_path/out."""
    VanillaModel.from_gaussians(with_background(60, 40), tiny.model(1).trained).save(tmp_path / "base", provenance={})
    write_cameras(tmp_path / "base" / "cameras.json", tiny.cameras(3, width=48, height=36))
    words = ["levels", str(tmp_path / "base"), "--viewer", "playcanvas", "--output", str(tmp_path / "out"), "--by", "distance"]
    return [*words, "--recipe", "instant", "--backend", "cpu", "--threads", "1"]


@pytest.mark.parametrize("by", ["distance", "zoom"])
def test_a_ladder_that_ends_within_its_first_band_has_one_level(tmp_path, capsys, command, by):
    assert cli.main([by if word == "distance" else word for word in (*command, "--coarsest", "1", "--report", "--json")]) == 0
    manifest = json.loads(capsys.readouterr().out)
    assert [level["file"] for level in manifest["levels"]] == ["level_0.ply"] and manifest["switches"] == []
    assert (tmp_path / "out" / "report.html").is_file()


def test_the_page_of_walks_has_the_figures_of_their_manifest(tmp_path, capsys, monkeypatch, command):
    monkeypatch.setattr("mipmap_plugin.levels.distance.yardstick.VIEWS", 1)  # as where only one sees something
    assert cli.main([*command, "--coarsest", "1/4", "--report"]) == 0
    said = capsys.readouterr().out
    assert "lodBaseDistance" in said and said.splitlines()[-1] == f"page: {tmp_path / 'out' / 'report.html'}"
    record, manifest = record_of(tmp_path / "out" / "report.html"), json.loads((tmp_path / "out" / MANIFEST).read_text())
    assert record["ladder"] == manifest and f"on walks backwards at worst {manifest['worst_db']:.1f} dB" in record["lead"]
    scales = [zoom["scale"] for zoom in record["zooms"]]
    assert scales == sorted(scales) and scales[-1] == 1 and scales[0] < 1 / 2 and len(scales) > 3
    curve = {round(point["psnr_db"], 6): point for point in manifest["curve"]}
    for zoom in record["zooms"]:
        assert zoom["mean_of"] == "1 walk that no level was adapted to"
        base, levels, truth = zoom["pictures"]
        assert [base["role"], levels["role"], truth["role"]] == ["base", "adapted", "truth"]
        assert curve[round(levels["mean"]["psnr_db"], 6)]["base_db"] == pytest.approx(base["mean"]["psnr_db"])
