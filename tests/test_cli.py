"""The command line: what it prints and writes, its exit codes, and one sentence instead of a traceback for everything that is wrong."""

import errno
import gc
import json
import re
import shlex
import signal
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import moving
import numpy as np
import pressing
import pytest
import tiny
import torch
from PIL import Image

from mipmap_plugin import registry
from mipmap_plugin.backends.conformance import CASES, MORE, Outcome
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.commands.adapt import adapt
from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.commands.repeated import refuse_repeated
from mipmap_plugin.commands.types import read_scale
from mipmap_plugin.evaluation import backends as backends_module
from mipmap_plugin.evaluation import viewer_differences
from mipmap_plugin.evaluation.measure import baselines
from mipmap_plugin.evaluation.published import PUBLISHED
from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped, wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

QUICK = ["--views", "given", "--steps", "2"]
NO_STEP = ["--steps", "0"]


@pytest.fixture
def run(capsys, tmp_path_factory, monkeypatch):
    """Call the command line in a folder of its own; return (exit code, what it said on stdout, what on stderr)."""
    monkeypatch.chdir(tmp_path_factory.mktemp("here"))

    def call(*words):
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as leaving:  # how the argument parser ends
            code = leaving.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def model_folder(tmp_path):
    return tiny.folder(tmp_path / "base", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"))


def refused(answer, *words):
    """Check that it ended in one sentence on stderr, with nothing on stdout, and return the sentence."""
    code, out, err = answer
    assert (code, out) == (2, "")
    assert err.startswith("mipmap-plugin: ") and err.count("\n") == 1
    assert all(word in err for word in words), err
    return err


def refused_once_named(answer, *words):
    """As `refused`, after lines on stdout that say what the file is."""
    code, out, err = answer
    assert [line.split(":")[0] for line in out.splitlines()] in ([], ["file", "family"])
    return refused((code, "", err), *words)


def record_of(page):
    """The JSON within a page."""
    return json.loads(re.search(r'<script type="application/json" id="record">(.*?)</script>', page.read_text(), re.DOTALL)[1])


def splats_of(report):
    """The bytes of the splats of an adapted PLY, whose header has the seconds of the run."""
    return Path(report["file"]).read_bytes().partition(b"end_header\n")[2]


# inspect


def test_the_version(run):
    assert re.fullmatch(r"mipmap-plugin \d+\.\d+\.\d+\S*\n", run("--version")[1])


def test_inspect_says_what_a_checkpoint_is(run, model_folder):
    code, out, err = run("inspect", model_folder)
    assert (code, err) == (0, "")
    facts = "family:       3dgs", "splats:       60", "1 in use of 1", "classic, 0.3 px²", "4, 32 x 24 px", "health:"
    assert all(fact in out for fact in (*facts, "screen filter: on"))
    assert [line.split(":")[0] for line in out.splitlines()[:3]] == ["file", "family", "verdict"]
    assert f"\nverdict:      sound; next: mipmap-plugin adapt {model_folder} --scale 1/4\n" in out and out.count("family:") == 1


def test_inspect_of_an_adapted_file_ends_with_a_command_that_runs(run, tmp_path):
    """It is copied as it stands; --output is required."""
    provenance = {"scale": 0.25, "viewer": None}
    ply = load_model(tiny.ply(tmp_path / "a.ply", count=20)).save(tmp_path / "b c.ply", provenance=provenance)
    cameras = tiny.folder(tmp_path / "scene", tiny.cameras(1))
    verdict = re.search(r"verdict: +(.+)", run("inspect", ply, "--cameras", cameras, "--no-viewers")[1])[1]
    told, _, command = verdict.partition("; next: ")
    assert told.startswith("sound, adapted to x0.25, at which alone it looks right")
    assert run(*shlex.split(command)[1:]) == (0, "1 picture in DIR, at x0.25, which the file was adapted for\n", "")


def test_inspect_lists_the_effects_that_are_off_if_asked(run, model_folder):
    brief, whole = run("inspect", model_folder, "--no-viewers")[1], run("inspect", model_folder, "--no-viewers", "--all")[1]
    off = whole.count(": off, ")
    assert off > 10 and ": off, " not in brief and f"{off} more are off (--all)" in brief and "more are off" not in whole
    assert brief.count(": on, ") == whole.count(": on, ") > 0


def test_inspect_doubts_a_file_of_another_convention(run, tmp_path):
    ply = tiny.ply(tmp_path / "a.ply", count=200)
    columns = read_ply(ply).columns
    columns["opacity"][:] = 0.5
    write_ply(tmp_path / "b.ply", columns)
    assert "\nverdict:      doubtful: read health before you adapt it\n" in run("inspect", tmp_path / "b.ply")[1]


@pytest.mark.usefixtures("small_orbits")
def test_splats_that_are_left_out_are_told_of(run, tmp_path):
    """Whatever the command, and in the log: what is drawn is not all of the file."""
    columns = read_ply(tiny.ply(tmp_path / "a.ply", count=20)).columns
    columns["x"][:3] = np.nan
    write_ply(tmp_path / "b.ply", columns)
    said = f"mipmap-plugin: {tmp_path / 'b.ply'}: 3 of 20 splats were dropped: 3 of 20 splats hold a NaN in means\n"
    assert "\nverdict:      doubtful: 3 of 20 splats were dropped" in run("inspect", tmp_path / "b.ply", "--no-viewers")[1]
    words = ["adapt", tmp_path / "b.ply", "--scale", "1/2", "--recipe", "instant", "--log", tmp_path / "log"]
    assert said in run(*words)[2]
    assert "3 of 20 splats were dropped" in (tmp_path / "log").read_text()


@pytest.mark.parametrize("option", ["--scale", "--output"])
def test_an_output_that_names_a_file_becomes_no_folder(run, tmp_path, option):
    ply = tiny.ply(tmp_path / "a.ply")
    if option == "--scale":  # several files
        refused(run("adapt", ply, "--scale", "1/2", "--scale", "1/4", "--output", tmp_path / "b.ply"), "several files are written there")
    else:
        refused(run("adapt", ply, "--scale", "1/2", "--output", tmp_path / "b.pt"), "not written as .pt; give a .ply, or the path of a folder")
    assert not [*tmp_path.glob("b*")]


def test_a_wrong_scale_of_render_is_named(run, model_folder):
    code, _, err = run("render", model_folder, "--output", "out", "--scale", "0")
    assert code == 2 and "scale must be a number or a fraction from 1e-09 to" in err and "Annotated" not in err


@pytest.mark.usefixtures("small_orbits")
def test_a_folder_of_a_base_and_its_adaptations_is_the_base(run, tmp_path):
    ply = tiny.ply(tmp_path / "a.ply")
    assert run("adapt", ply, "--scale", "1/2", "--recipe", "instant")[0] == 0
    assert f"file:         {ply}\n" in run("inspect", tmp_path, "--no-viewers")[1]


def test_inspect_as_json(run, tmp_path):
    code, out, _ = run("inspect", tiny.ply(tmp_path / "a.ply"), "--json")
    facts = json.loads(out)
    assert code == 0
    assert (facts["family"], facts["splats"], facts["cameras"]) == ("3dgs", 60, "none beside the checkpoint")
    assert isinstance(facts["effects"], list) and isinstance(facts["notes"], list)


@pytest.mark.usefixtures("small_orbits")
def test_cameras_beside_a_lone_file_are_named_but_not_read(run, tmp_path):
    """They may be of another scene."""
    ply, cameras = tiny.ply(tmp_path / "a.ply"), tmp_path / "cameras.json"
    cameras.write_text("[]")
    out = run("inspect", ply, "--no-viewers")[1]
    assert f"cameras:      none are read; {cameras} may be of this scene\n" in out
    assert f"adapt {ply} --scale 1/4 --cameras {cameras}\n" in out
    err = run("adapt", ply, "--scale", "1/2", "--recipe", "instant")[2]
    assert f"give the scene's cameras (--cameras), such as {cameras}, if it is of this scene" in " ".join(err.split())


def test_inspect_sees_a_lone_file_by_given_cameras(run, model_folder, tmp_path):
    ply, cameras = tiny.ply(tmp_path / "a.ply"), model_folder / "cameras.json"
    out = run("inspect", ply, "--no-viewers", "--cameras", cameras)[1]
    assert "\ncameras:      4, 32 x 24 px, " in out and f"adapt {ply} --scale 1/4 --cameras {cameras}\n" in out
    code, _, err = run("inspect", ply, "--cameras", tmp_path / "none.json")
    assert code == 2 and "none.json: there is no such file" in err


def test_inspect_says_how_far_viewers_are_from_training(run, model_folder):
    pytest.importorskip("numba")
    [line] = [line for line in run("inspect", model_folder)[1].splitlines() if line.startswith("viewers:")]
    assert re.fullmatch(r"viewers: +spark .* dB, classic the same, antialiased .* dB, compared with its training, at x1 in 3 views", line)
    assert "viewers:      not requested" in run("inspect", model_folder, "--no-viewers")[1]


def test_inspect_says_what_it_knows_before_it_draws(run, model_folder, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(viewer_differences, "viewer_differences", lambda wrapped: said.append(capsys.readouterr().out) or "none")
    rest = run("inspect", model_folder)[1]
    assert said[0].startswith("file:") and "health:" in said[0] and rest.startswith("viewers:      none\nnotes:")
    run("inspect", model_folder, "--json")
    assert said[1] == ""


def test_inspect_of_an_iteration(run, model_folder):
    assert run("inspect", model_folder, "--iteration", "30000")[0] == 0
    refused(run("inspect", model_folder, "--iteration", "7"), "7")


# adapt


def test_adapt_two_scales_into_a_folder(run, model_folder, tmp_path):
    words = ["adapt", model_folder, "--scale", "1/4", "--scale", "2", "--output", tmp_path / "out", "--log", tmp_path / "log.txt", *QUICK]
    code, out, _ = run(*words)
    assert code == 0
    what, where = out.splitlines()[::2], out.splitlines()[1::2]
    for scale, name in [(0.25, "base_x0.25"), (2, "base_x2")]:
        ply = tmp_path / "out" / name / "point_cloud/iteration_30000/point_cloud.ply"
        assert provenance_of(read_ply(ply).comments)["scale"] == scale
        assert json.loads(ply.with_name("point_cloud.ply.adaptation.json").read_text())["scale"] == scale
        assert where.pop(0).startswith(f"{ply}, made for renderers that draw as 3DGS does")
        assert re.fullmatch(rf"x{scale:g}: (\S+ -> \S+ dB on views|holds the base as it is, ).*, 60 -> \d+ splats, \d+\.\d s", what.pop(0))
    log = (tmp_path / "log.txt").read_text()
    assert "ended by 2 steps" in log and "backend cpu: " in log and "the 4 given views" in log
    assert not list(tmp_path.rglob("*.resume"))


def test_a_file_that_is_written_takes_no_memory_while_the_next_is_made(run, model_folder, tmp_path, monkeypatch):
    made, left, adapt = [], [], Wrapped.adapt

    def watched(*arguments, **options):
        gc.collect()
        left.append([each() for each in made])
        adapted = adapt(*arguments, **options)
        made.append(weakref.ref(adapted))
        return adapted

    monkeypatch.setattr(Wrapped, "adapt", watched)
    assert run("adapt", model_folder, "--scale", "1/4", "--scale", "1/2", "--output", tmp_path / "out", *NO_STEP)[0] == 0
    assert left == [[], [None]]


@pytest.mark.usefixtures("small_orbits")
def test_adapt_writes_beside_the_checkpoint_unless_told_otherwise(run, tmp_path):
    base = tiny.ply(tmp_path / "base.ply")
    code, out, _ = run("adapt", base, "--scale", "4", *NO_STEP, "--json")
    assert code == 0
    [report] = json.loads(out)
    assert report["file"] == str(tmp_path / "base_x4.ply") and report["settings"]["recipe"] == "default"
    assert len(load_model(tmp_path / "base_x4.ply")) == 60


def test_adapt_hands_its_options_on(run, model_folder, tmp_path):
    options = ["--recipe", "paper", "--seed", "7", "--resize", "area", "--upsampler", "lanczos", "--background", "white", "--time-budget-s", "60"]
    code, out, _ = run("adapt", model_folder, "--scale", "1/2", "--output", tmp_path / "a.ply", "--json", *options, *QUICK)
    assert code == 0
    settings = json.loads(out)[0]["settings"]
    assert {name: settings[name] for name in ("recipe", "seed", "resize", "upsampler", "time_budget_s", "steps", "views")} == {
        "recipe": "paper", "seed": 7, "resize": "area", "upsampler": "lanczos", "time_budget_s": 60, "steps": 2, "views": "given",
    }  # fmt: skip


def test_adapt_takes_cameras_from_elsewhere(run, tmp_path):
    views = tiny.scene(tmp_path / "scene", train=tiny.cameras(3))
    answer = run("adapt", tiny.ply(tmp_path / "a.ply"), "--scale", "1/2", "--cameras", views, "--json", *QUICK)
    assert answer[0] == 0 and "the 5 given views" in json.loads(answer[1])[0]["views"]


def test_the_same_scale_twice_is_one_scale(run, model_folder, tmp_path):
    code, out, _ = run("adapt", model_folder, "--scale", "4", "--scale", "4/1", "--output", tmp_path / "a.ply", *NO_STEP)
    assert code == 0 and out.count("x4:") == 1


@pytest.mark.usefixtures("small_orbits")
def test_an_output_that_exists_needs_overwrite_and_is_refused_before_any_work(run, tmp_path, monkeypatch):
    base = tiny.ply(tmp_path / "base.ply")
    (tmp_path / "base_x4.ply").write_text("precious")
    with monkeypatch.context() as first:
        first.setattr("mipmap_plugin.wrap.Wrapped.adapt", lambda *_, **__: pytest.fail("worked in vain"))
        refused(run("adapt", base, "--scale", "2", "--scale", "4"), "base_x4.ply exists already; pass --overwrite")
    assert (tmp_path / "base_x4.ply").read_text() == "precious" and not (tmp_path / "base_x2.ply").exists()
    assert run("adapt", base, "--scale", "4", "--overwrite", *NO_STEP)[0] == 0
    assert len(load_model(tmp_path / "base_x4.ply")) == 60


def test_ctrl_c_ends_with_130_and_the_same_command_goes_on(run, model_folder, tmp_path, monkeypatch):
    command = ["adapt", model_folder, "--scale", "1/4", *QUICK]
    run(*command, "--output", tmp_path / "whole.ply")
    pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))(1)
    code, out, err = run(*command, "--output", tmp_path / "new.ply")
    assert (code, out) == (130, "")
    assert "interrupted at step 1; run the same command again to continue from" in err and "Traceback" not in err
    assert (tmp_path / "new.ply.resume").exists() and not (tmp_path / "new.ply").exists()
    assert run(*command, "--output", tmp_path / "new.ply")[0] == 0
    assert (tmp_path / "new.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert not (tmp_path / "new.ply.resume").exists()


def test_ctrl_c_between_two_files_and_the_same_command_goes_on(run, model_folder, tmp_path, monkeypatch):
    """What is finished is not made again; the page says of it what it can."""
    command = ["adapt", model_folder, "--scale", "1/4", "--scale", "1/2", *QUICK]
    whole = json.loads(run(*command, "--output", tmp_path / "whole", "--json")[1])
    pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))(3)
    command += ["--output", tmp_path / "new", "--report"]
    code, _, err = run(*command)
    assert code == 130 and "run the same command again to continue from" in err
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["base_x0.25", "base_x0.5.resume"]
    code, out, err = run(*command, "--json")
    again = json.loads(out)
    assert (code, err) == (0, "") and [report["scale"] for report in again] == [0.25, 0.5]
    assert [Path(report["file"]).relative_to(tmp_path / "new") for report in again] == [
        Path(report["file"]).relative_to(tmp_path / "whole") for report in whole
    ]
    assert [splats_of(report) for report in again] == [splats_of(report) for report in whole]
    record = record_of(tmp_path / "new" / "base_adapted.report.html")
    assert [report["title"] for report in record["adaptations"]] == ["×1/4", "×1/2"] and [zoom["label"] for zoom in record["zooms"]] == ["×1/2"]
    assert record["notes"][0] == "×1/4: an earlier command made it, and its pictures are not drawn again"


def test_adapt_to_the_bases_own_scale_gives_the_base(run, model_folder, tmp_path):
    code, out, err = run("adapt", model_folder, "--scale", "1", "--output", tmp_path / "same.ply", "--report")
    assert (code, err) == (0, "") and out.startswith("x1: holds the base as it is, 60 -> 60 splats, 0.0 s\n")
    assert read_ply(tmp_path / "same.ply").columns["x"].shape == (60,)


def test_ctrl_c_anywhere_else_says_interrupted(run, model_folder, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.models.load_model", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    code, _, err = run("inspect", model_folder)
    assert code == 130 and err.strip() == "mipmap-plugin: interrupted"


# render


def test_render_writes_the_test_views_at_the_scale(run, model_folder, tmp_path):
    words = ["--scale", "1/2", "--cameras", model_folder / "cameras.json"]
    code, out, _ = run("render", model_folder, "--output", tmp_path / "out", *words)
    assert (code, out) == (0, f"4 pictures in {tmp_path / 'out'}\n")
    pictures = sorted((tmp_path / "out").iterdir())
    assert len(pictures) == 4  # cameras.json alone does not say which views are for testing, and two have one name
    assert all(Image.open(picture).size == (16, 12) for picture in pictures)


def test_render_of_one_view_is_the_view(run, model_folder, tmp_path):
    words = ["--view", "view_1", "--screen-filter", "scaled", "--supersampling", "2", "--background", "white"]
    code, out, _ = run("render", model_folder, "--output", tmp_path / "out", *words)
    assert code == 0 and out.startswith("1 picture in")
    [picture] = (tmp_path / "out").iterdir()
    assert picture.name == "train_view_1.png" and Image.open(picture).getpixel((0, 0)) == (255, 255, 255)


def test_render_writes_the_row_of_supersampling_that_evaluate_judges(run, tmp_path):
    splats = tiny.gaussians()
    VanillaModel.from_gaussians(replace(splats, sh=3 * splats.sh), TrainedScale()).save(tmp_path / "bright", provenance={})  # beyond a screen's white
    write_cameras(tmp_path / "bright" / "cameras.json", tiny.cameras(2))
    words = ["--scale", "1/4", "--view", "view_1", "--screen-filter", "scaled", "--supersampling", "4"]
    assert run("render", tmp_path / "bright", "--output", tmp_path / "out", *words)[0] == 0
    base = wrap_model(tmp_path / "bright")
    [row] = [each for each in baselines(base, 1 / 4, "area") if each.name == "supersampling, 4 x 4"]
    [view] = [view for view in base.cameras if view.name == "view_1"]
    shown = np.asarray(Image.open(tmp_path / "out" / "train_view_1.png")).astype(int)
    assert abs(shown - (row.render(view) * 255).round().numpy()).max() <= 1
    assert abs(shown - (base.render(view.zoomed(1 / 4), 1 / 4, "scaled", 4).image.clamp(0, 1) * 255).round().numpy()).max() > 1


def test_render_says_that_no_view_shows_anything(run, tmp_path):
    behind = torch.zeros(4, 4, dtype=torch.float64)
    behind[2, 3] = -100.0
    away = [replace(camera, viewmat=camera.viewmat + behind) for camera in tiny.cameras(2)]
    scene = write_cameras(tmp_path / "cameras.json", away)
    code, out, err = run("render", tiny.ply(tmp_path / "a.ply"), "--output", tmp_path / "out", "--cameras", scene)
    assert (code, out) == (0, f"2 pictures in {tmp_path / 'out'}\n")
    assert "none of the 2 views shows a splat: the cameras seem to be of another scene" in " ".join(err.split())


def test_render_says_that_a_viewer_draws_no_such_splats(run, tmp_path):
    folder, scene = moving.write_deformable(tmp_path / "moving"), write_cameras(tmp_path / "cameras.json", tiny.cameras(1))
    code, _, err = run("render", folder, "--output", tmp_path / "out", "--viewer", "spark", "--cameras", scene, "--backend", "reference")
    assert code == 0 and "spark: a network moves its splats" in err and "what its settings would make of these splats" in " ".join(err.split())


def test_render_takes_a_folder_and_not_the_name_of_a_picture(run, model_folder, tmp_path):
    code, _, err = run("render", model_folder, "--output", tmp_path / "view.PNG")
    assert code == 2 and "view.PNG: pictures are written to a folder, each by the name of its view; give the folder" in err
    assert not (tmp_path / "view.PNG").exists()


def test_render_refuses_names_that_are_not_there_and_pictures_that_are(run, model_folder, tmp_path):
    refused(run("render", model_folder, "--output", tmp_path / "out", "--view", "nowhere"), "there is no view nowhere; the first of 4 are view_")
    words = ["render", model_folder, "--output", tmp_path / "out", "--view", "view_1"]
    assert run(*words)[0] == 0
    refused(run(*words), "train_view_1.png exists already; pass --overwrite")
    refused(run(*words, "--overwrite", "--supersampling", "0"), "supersampling: must be at least 1")
    assert run(*words, "--overwrite")[0] == 0


def test_picture_names_are_unique_and_stay_in_their_folder():
    given = [("a", "train"), ("a", "train"), ("a", "test"), ("../../b", "test"), ("c\\d", "train"), ("a_2", "train")]
    named = [replace(tiny.cameras(1)[0], name=name, split=split) for name, split in given]
    assert picture_names(named) == ["train_a_1.png", "train_a_3.png", "test_a.png", "test_.._.._b.png", "train_c_d.png", "train_a_2.png"]


# evaluate


def test_evaluate_prints_a_table_and_writes_its_rows(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    wanted = ["--scale", "1", "--scale", "1/4", "--recipe", "instant", "--protocol", "P1"]
    words = ["evaluate", model_folder, "--images", scene, "--output", tmp_path / "rows.json", *wanted]
    code, out, _ = run(*words)
    assert code == 0
    assert "truth: P1" in out and "real dB over 2 views\n" in out and "| x1 " in out and "| x0.25 " in out and "base, resized" in out
    assert "instant, 1 of 2 judged views adapted to" in out  # the folder has no cfg_args, and one of its cameras is judged
    written = json.loads((tmp_path / "rows.json").read_text())
    rows = written["rows"]
    assert written["notes"] == [] and written["judged_views"] == [2]
    assert [row["name"] for row in rows][:2] == ["base", "base"] and rows[0]["psnr_db"] > 50
    refused(run(*words), "rows.json exists already; pass --overwrite")


def test_evaluate_says_where_a_file_is_adapted_to_images_of_another_filter_than_the_truths(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    words = ["evaluate", model_folder, "--images", scene, "--scale", "1/2", "--recipe", "default", "--recipe", "instant", "--steps", "1"]
    told = "P1 makes photographs smaller by another filter (box) than base images are for default (pil-bicubic); --resize area adapts to"
    notes = []
    for options in (["--protocol", "P1"], ["--protocol", "P1", "--resize", "area"], ["--protocol", "P3"]):
        code, out, err = run(*words, *options, "--no-report", "--json")
        assert code == 0, err
        notes.append(json.loads(out)["notes"])
    assert [len(each) for each in notes] == [1, 0, 0] and notes[0][0].startswith(told)


def test_evaluate_as_json(run, model_folder, tmp_path):
    code, out, _ = run("evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--scale", "1", "--json")
    assert code == 0 and json.loads(out)["rows"][0]["name"] == "base"


def test_evaluate_says_which_rows_are_missing_and_that_no_row_is_exposed(run, model_folder, tmp_path, monkeypatch):
    few = replace(ReferenceBackend.capabilities, screen_filters=frozenset({"classic", "antialiased"}))
    monkeypatch.setattr(ReferenceBackend, "capabilities", few)
    (model_folder / "exposure.json").write_text(json.dumps({"view_0": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}))
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--backend", "reference"]
    exposed = "exposure.json changes 1 of 1 images, which is not applied here: part of every difference from a photograph is exposure"
    missing = r"there is no row 'window', since backend 'reference' cannot do this(, but cpu can)?: it has the screen filters .*, not window"
    code, out, _ = run(*words, "--scale", "1/2")
    assert code == 0 and re.fullmatch(missing, out.splitlines()[-3]) and out.splitlines()[-2] == exposed and "| window" not in out
    code, out, _ = run(*words, "--scale", "1", "--json")
    assert code == 0 and json.loads(out)["notes"] == [exposed]


def test_evaluate_and_tradeoff_tell_of_photographs_that_are_absent(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    (scene / "test" / "view_1.png").unlink()
    note = "transforms_test.json: 1 listed image is absent; 1 camera is left out because the file has no w and h"
    words = [model_folder, "--images", scene, "--scale", "1/2", "--recipe", "instant", "--json"]
    code, out, err = run("evaluate", *words, "--output", tmp_path / "rows.json")
    assert code == 0 and f"mipmap-plugin: {scene}: {note}\n" in err
    assert json.loads(out)["judged_views"] == [1] and json.loads(out)["notes"] == [note]
    page = (tmp_path / "rows.html").read_text()
    assert note in page and "photographs, protocol P1, 1 view" not in page and "photographs, protocol P3, 1 view" in page
    code, out, err = run("tradeoff", *words, "--output", tmp_path / "out", "--no-picture", "--no-renderers", "--repeats", "1")
    assert code == 0 and f"mipmap-plugin: {scene}: {note}\n" in err and json.loads(out)["scales"][0]["notes"] == [note]


def test_evaluate_averages_several_scenes_and_prints_the_published_rows(run, model_folder, tmp_path):
    scenes = [tiny.scene(tmp_path / "one"), tiny.scene(tmp_path / "two")]
    words = ["--scale", "1/4", "--published", "nerf-synthetic"]
    code, out, _ = run("evaluate", model_folder, model_folder, "--images", *scenes, *words)
    assert code == 0
    assert "| one       | x0.25 | P3 " in out and "| mean of 2 | x0.25 | P3 " in out
    trained = "trained at 800 px for zoom-out and at 100 px for zoom-in; rows of other protocols, and of bases trained at another size"
    assert f"published, mean over the 8 scenes of NeRF-Synthetic, {trained}, are not comparable" in out and "Mipmap-GS (arXiv 2408.06286)" in out
    refused(run("evaluate", model_folder, "--images", *scenes, "--scale", "1/4"), "--images: give one for each checkpoint", "; got 2, for 1 of these")


def test_checkpoints_of_one_scene_are_told_apart_and_not_averaged(run, model_folder, tmp_path):
    scene, other = tiny.scene(tmp_path / "scene"), tiny.folder(tmp_path / "other", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"), seed=1)
    answer = run("evaluate", model_folder, other, "--images", scene, scene, "--scale", "1/2", "--output", tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    bases = {row["scene"]: row["psnr_db"] for row in rows if row["name"] == "base"}
    assert answer[0] == 0 and list(bases) == [f"scene, {model_folder}", f"scene, {other}"]
    pictures = [zoom["pictures"] for zoom in record_of(tmp_path / "rows.html")["zooms"]]
    assert [each["mean"]["psnr_db"] for zoom in pictures for each in zoom if each["name"] == "base"] == [*bases.values()]


@pytest.mark.parametrize("dataset", ["nerf-synthetic", "mip-nerf-360"])
def test_published_rows_that_do_not_exist_are_no_empty_table(run, model_folder, tmp_path, dataset):
    scene = tiny.scene(tmp_path / "one")
    out = run("evaluate", model_folder, "--images", scene, "--scale", "3/8", "--published", dataset, "--no-report")[1]
    said = out.splitlines()[-1].partition("they are at ")[2].replace(" and", ",").split(", ")
    assert {read_scale(scale) for scale in said} == {row.scale for row in PUBLISHED if row.dataset == dataset}


def test_an_option_that_counts_once_is_not_given_twice(run, model_folder, tmp_path):
    scenes = [tiny.scene(tmp_path / "one"), tiny.scene(tmp_path / "two")]
    twice = ["--images", scenes[0], f"--images={scenes[1]}"]
    refused(run("evaluate", model_folder, *twice, "--scale", "1/4"), "--images is given 2 times", "; give it once, with all its values behind it\n")
    budgets = ["--time-budget-s", "1", "--time_budget_s", "2"]
    refused(run("adapt", model_folder, "--scale", "1/4", *budgets), "--time-budget-s is given 2 times", "; give it once\n")
    refuse_repeated(adapt, ["adapt", "--json", "--json", "--scale", "1/4", "--scale", "4", "--seed", "1", "--", "--seed", "--seed"])


def test_a_lone_file_is_judged_by_photographs_with_the_cameras_that_are_given(run, tmp_path):
    scene, lone = tiny.scene(tmp_path / "scene", train=tiny.cameras(2)), tiny.ply(tmp_path / "a.ply")
    words = ["--images", scene, "--scale", "1/2", "--no-report", "--json"]
    code, out, err = run("evaluate", lone, *words, "--cameras", scene)
    assert code == 0 and {row["name"] for row in json.loads(out)["rows"]} > {"base", "scaled"}, err
    refused(run("evaluate", lone, *words), "its base scale is not known; give its model folder, or its cameras (--cameras)")
    quick = ["--output", tmp_path / "out", "--recipe", "instant", "--no-picture", "--no-renderers", "--repeats", "1", "--supersampling", "2"]
    assert run("tradeoff", lone, "--images", scene, "--scale", "1/2", *quick, "--cameras", scene)[0] == 0
    refused(run("evaluate", lone, *words, "--cameras", scene, scene), "--cameras: give one for each checkpoint", "; got 2, for 1 of these")


def test_evaluate_refuses_what_cannot_be_judged(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    refused(run("evaluate", tiny.ply(tmp_path / "a.ply"), "--images", scene, "--scale", "1"), "has no cameras, so its base scale is not known")
    refused(run("evaluate", model_folder, "--images", scene, "--scale", "4"), "the photographs have only 32 x 24")
    refused(run("evaluate", model_folder, "--images", tmp_path / "nowhere", "--scale", "1"), "there is no such file or folder")


def test_a_checkpoint_of_which_nothing_is_drawn_is_refused_before_the_work(run, tmp_path):
    faint = tiny.model()
    faint.parameters()["opacities"][:] = -8.0
    faint.save(tmp_path / "faint", provenance={})
    write_cameras(tmp_path / "faint" / "cameras.json", tiny.cameras(3))
    photographs = ["--images", tiny.scene(tmp_path / "scene"), "--scale", "1/2"]
    for words in (
        ["adapt", "--scale", "1/2"],
        ["levels", "--viewer", "spark", "--output", tmp_path / "levels"],
        ["tradeoff", "--scale", "1/2", "--output", tmp_path / "tradeoff"],
        ["evaluate", *photographs],
        ["adapt", "--scale", "1/2", "--tiles", "2", "--backend", "cpu"],
    ):
        refused(run(words[0], tmp_path / "faint", *words[1:]), "an opacity below 1/255")


# backends


def test_backends_lists_each_with_its_reasons(run, monkeypatch):
    code, out, _ = run("backends")
    assert code == 0 and "| reference " in out and "adapts 3DGS?" in out
    code, out, _ = run("backends", "--json")
    assert code == 0 and {"name": "reference", "device": "cpu", "reasons": [], "note": ""} in json.loads(out)


def test_backends_check_prints_a_table_and_fails_if_a_case_does(run, monkeypatch):
    outcomes = [Outcome("fine", 1e-6, True, True, ""), Outcome("odd", 0.5, True, False, "the image differs")]
    monkeypatch.setattr(backends_module, "CASES", {"one": None})
    monkeypatch.setattr(backends_module, "check_backend", lambda backend, cases, dtype, device: outcomes)
    code, out, err = run("backends", "--check", "reference")
    assert code == 2 and "FAIL: the image differs" in out and "| fine " in out
    assert err == "mipmap-plugin: backend 'reference' fails 1 of 2 cases: odd\n"
    assert out.rstrip().endswith("2 cases: 2 run, 0 skipped, 1 failed")
    outcomes.pop()
    assert run("backends", "--check", "reference")[0] == 0
    outcomes += [Outcome(f"other {i}", 0.0, True, True, "it has no colors", skipped=True) for i in range(20)]
    code, _, err = run("backends", "--check", "reference")
    assert code == 2 and "passes 1 of 21 cases, too few to tell whether it is right; of the others it says: it has no colors\n" in err
    refused(run("backends", "--check", "gpu"), "there is no backend 'gpu'")
    refused(run("backends", "--full"), "give --check NAME")


@pytest.mark.parametrize("full", [False, True])
def test_backends_check_goes_case_by_case_and_further_where_asked(full, run, monkeypatch):
    """So that a bar can show how far it is; in one thread, and then in as many as before."""
    asked, threads = [], torch.get_num_threads()

    def one(backend, cases, dtype, device):
        asked.append((list(cases), torch.get_num_threads()))
        return [Outcome(case, 0.0, True, True, "") for case in cases]

    monkeypatch.setattr(backends_module, "check_backend", one)
    torch.set_num_threads(2)
    assert run("backends", "--check", "reference", *(["--full"] if full else []))[0] == 0
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    assert asked == [([case], 1) for case in [*CASES, *(MORE if full else [])]]


# One sentence, no traceback


def malformed(folder: Path) -> dict[str, Path]:
    sound = tiny.ply(folder / "sound.ply").read_bytes()
    header = sound.index(b"end_header\n") + len(b"end_header\n")
    contents = {
        "empty.ply": b"",
        "text.ply": b"not a splat",
        "header_only.ply": sound[: header - 20],
        "cut.ply": sound[:-100],
        "no_rows.ply": sound[:header],
        "mesh.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
        "lfs.ply": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
        "zip.ply": b"PK\x03\x04" + b"\0" * 40,
        "poison.ply": sound[:header] + b"\xff" * (len(sound) - header),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (folder / "empty_folder").mkdir()
    return {name: folder / name for name in [*contents, "empty_folder", "absent.ply"]}


@pytest.mark.parametrize("command", ["inspect", "adapt"])
def test_malformed_checkpoints_end_in_one_sentence(run, tmp_path, command):
    for name, path in malformed(tmp_path).items():
        words = ["--scale", "4"] if command == "adapt" else []
        assert name in refused_once_named(run(command, path, *words)), name
    assert not [path for path in tmp_path.iterdir() if "_x4" in path.name]


@pytest.mark.parametrize("content", ["", "{", "[]", "[1]", '[{"id": 0}]', '{"frames": []}', "\0"])
def test_malformed_cameras_end_in_one_sentence(run, model_folder, content):
    (model_folder / "cameras.json").write_text(content)
    assert "cameras.json" in refused_once_named(run("inspect", model_folder))


@pytest.mark.parametrize("content", ["", "{}", '{"frames": []}', '{"frames": [{"file_path": "a"}]}', '{"frames": [{"w": 4, "h": 4}]}'])
def test_malformed_scenes_end_in_one_sentence(run, model_folder, tmp_path, content):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/transforms_test.json").write_text(content)
    refused(run("evaluate", model_folder, "--images", tmp_path / "scene", "--scale", "1"), "scene")


def test_a_damaged_photograph_ends_in_one_sentence(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    picture = scene / "test/view_0.png"
    picture.write_bytes(picture.read_bytes()[:200])
    refused(run("evaluate", model_folder, "--images", scene, "--scale", "1"), "view_0.png")


def test_a_damaged_state_ends_in_one_sentence(run, model_folder, tmp_path):
    (tmp_path / "new.ply.resume").write_bytes(b"PK\x03\x04 not quite")
    refused(run("adapt", model_folder, "--scale", "1/4", "--output", tmp_path / "new.ply", *QUICK), "not the state of an interrupted run")


def test_requests_that_cannot_be_served_end_in_one_sentence(run, model_folder):
    refused(run("adapt", model_folder, "--scale", "4", "--backend", "gpu"), "there is no backend 'gpu'; choose from", "reference")
    refused(run("adapt", model_folder, "--scale", "4", "--upsampler", "swin"), "there is no upsampler 'swin'; choose from bicubic, lanczos")
    refused(run("adapt", model_folder, "--scale", "4", "--steps", "-1"), "setting steps: must be a whole number of at least 0, got -1")
    refused(run("adapt", model_folder), "--scale is required; give --scale 1/4")
    refused(run("evaluate", model_folder, "--images", model_folder), "--scale is required; give --scale 1/4")
    refused(run("adapt", model_folder, "--scale", "4", "--cameras", "nowhere.json"), "nowhere.json: there is no such file")


def test_a_broken_plugin_breaks_only_itself(run, tmp_path, monkeypatch):
    from importlib.metadata import EntryPoint

    points = [EntryPoint("broken", "no_such_package:Backend", "mipmap_plugin.backends")]
    monkeypatch.setattr(registry, "entry_points", lambda group: [point for point in points if point.group == group])
    assert "No module named 'no_such_package'" in run("backends")[1]
    refused(run("adapt", tiny.ply(tmp_path / "a.ply"), "--scale", "4", "--backend", "broken"), "'broken'", "cannot be loaded")


def test_list_says_where_names_come_from_and_what_is_wrong_with_one(run, tmp_path, monkeypatch):
    place = tmp_path / "stranger-1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    groups = ["viewers]\nspark = stranger:SPARK\nkiosk = stranger:KIOSK\n", "recipes]\nbrief = stranger:brief\n", "models]\nnpz = nobody:FAMILY\n"]
    groups.append("upsamplers]\nkiosk = stranger:KIOSK\n")
    (place / "entry_points.txt").write_text("\n".join(f"[mipmap_plugin.{group}" for group in groups))
    (tmp_path / "stranger.py").write_text("brief = lambda scale, network: dict(steps=3)\nKIOSK = ('spark', 'unity')\n")
    monkeypatch.syspath_prepend(tmp_path)
    code, out, err = run("list")
    assert (code, err) == (0, "")
    assert "recipes:      default, instant, paper, thorough\n              brief: stranger:brief of stranger 1.0\n" in out
    assert "kiosk: stranger:KIOSK of stranger 1.0\n" in out
    assert "spark: stranger:SPARK of stranger 1.0, not used: the name is taken by a built-in one; choose another\n" in out
    assert "npz: nobody:FAMILY of stranger 1.0, not used: 'npz' (nobody:FAMILY) cannot be loaded: ModuleNotFoundError" in out
    assert "kiosk: stranger:KIOSK of stranger 1.0, not used: upsampler 'kiosk' is of type tuple; make it a function" in out
    listed = json.loads(run("list", "recipes", "--json")[1])
    assert listed["recipes"]["of packages"] == {"brief": "stranger:brief of stranger 1.0"}


@pytest.mark.parametrize("words", [["render"], ["tradeoff", "--scale", "1/2"]])
def test_a_file_where_pictures_are_to_go_is_named(run, tmp_path, words):
    (tmp_path / "taken").write_text("precious")
    command, *options = words
    said = f"{tmp_path / 'taken'} is a file, not a folder; choose another path"
    refused(run(command, tiny.ply(tmp_path / "a.ply"), "--output", tmp_path / "taken", *options), said)


@pytest.mark.usefixtures("small_orbits")
def test_a_full_disk_ends_in_one_sentence_and_leaves_the_old_file(run, tmp_path, monkeypatch):
    base, output = tiny.ply(tmp_path / "base.ply"), tmp_path / "new.ply"
    output.write_text("precious")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mipmap_plugin.formats.atomic.os.replace", full)
    words = ["--output", output, "--overwrite", *NO_STEP]
    code, out, err = run("adapt", base, "--scale", "4", *words)
    orbit, said = err.splitlines()
    assert (code, out) == (2, "") and "generated orbit" in orbit and "new.ply cannot be written: No space left on device" in said
    assert output.read_text() == "precious" and sorted(path.name for path in tmp_path.iterdir()) == ["base.ply", "new.ply"]


@pytest.mark.usefixtures("small_orbits", "brief_ladders")
def test_levels_without_cameras_are_told_of_once(run, tmp_path):
    """Each of several levels is adapted to the orbit."""
    base = tiny.ply(tmp_path / "base.ply")
    words = ["--viewer", "playcanvas", "--coarsest", "1/2", "--steps", "0", "--backend", "cpu", "--threads", "1"]
    code, _, err = run("levels", base, *words, "--output", tmp_path / "levels")
    assert code == 0 and err.count("views of a generated orbit are adapted to") == 1
    assert err.count("would change levels at the distances of a generated orbit") == 1


def test_an_output_below_a_file_ends_in_one_sentence(run, tmp_path):
    base = tiny.ply(tmp_path / "base.ply")
    refused(run("adapt", base, "--scale", "4", "--output", base / "new.ply", *NO_STEP), "new.ply")


@pytest.mark.parametrize("words", ["", "fly", "adapt", "adapt a.ply --scale 0", "adapt a.ply --scale 1/0", "inspect a --what"])
def test_words_that_are_not_understood_exit_with_2(run, words):
    code, _, err = run(*words.split())
    assert code == 2 and "Traceback" not in err


@pytest.mark.parametrize(("text", "scale"), [("1/4", 0.25), ("4", 4.0), ("1e-3", 0.001), ("1 / 4", 0.25), ("×1/4", 0.25), ("0.25x", 0.25)])
def test_scales_are_fractions_or_numbers(text, scale):
    assert read_scale(text) == scale


@pytest.mark.parametrize("text", ["", "x", "0", "-1/4", "1/0", "inf", "nan", "1e999", "1e308", "1e5", "1e-50", "25%", "1:4", "0,25", "1 4", "×"])
def test_scales_that_are_no_zoom(text):
    with pytest.raises(ValueError, match=r"scale must be a number or a fraction from 1e-09 to 10000, such as 1/4, 0\.25 or 4, got "):
        read_scale(text)


def test_the_module_runs():
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-m", "mipmap_plugin", "--help"], capture_output=True, text=True, cwd=root)
    assert done.returncode == 0 and done.stderr == ""
    assert all(command in done.stdout for command in ("inspect", "adapt", "render", "evaluate", "backends", "demo"))


@pytest.mark.parametrize("output", [[], ["--output", "~/half.ply"], ["--output=~/half.ply"]])
def test_a_tilde_is_the_home_folder_where_no_shell_says_so(run, tmp_path, monkeypatch, output):
    monkeypatch.setenv("HOME", str(tmp_path))
    tiny.ply(tmp_path / "base.ply")
    code, out, _ = run("adapt", "~/base.ply", "--scale", "1/2", "--recipe", "instant", *output)
    assert code == 0 and str(tmp_path / ("half.ply" if output else "base_x0.5.ply")) in out and "~" not in out
