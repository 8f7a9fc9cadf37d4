"""`inspect`: what it says of a checkpoint."""

import json
import re
import shlex
from dataclasses import replace

import anchor_checkpoints
import numpy as np
import pytest
import tiny
import torch
from commands_run import NO_STEP, refused

from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.evaluation import viewer_differences
from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import write_cameras

pytestmark = pytest.mark.usefixtures("few_views")

# What can be given of a file without cameras.
WITHOUT = "give the scene (--cameras), or say what is up (--up z, for one)"


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


def test_inspect_tells_of_a_backend_that_fails_and_says_the_rest(run, model_folder):
    def fails(self, gaussians, camera, effects):
        raise RuntimeError("no driver")

    BACKENDS.add("fast", type("Fast", (CpuBackend,), {"speed": 99, "render": fails, "__module__": "theirs"}))
    code, out, _ = run("inspect", model_folder)
    assert code == 0 and re.search(r"\nviewers: +not drawn: backend 'fast' \(taken as the fastest.*\) failed: RuntimeError: no driver\n", out)


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


def test_a_folder_of_a_base_and_its_adaptations_is_the_base(run, tmp_path):
    ply = tiny.ply(tmp_path / "a.ply")
    assert run("adapt", ply, "--scale", "1/2", "--recipe", "instant")[0] == 0
    assert f"file:         {ply}\n" in run("inspect", tmp_path, "--no-viewers")[1]


def test_inspect_as_json(run, tmp_path):
    code, out, _ = run("inspect", tiny.ply(tmp_path / "a.ply"), "--json")
    facts = json.loads(out)
    assert code == 0
    assert (facts["family"], facts["splats"], facts["cameras"]) == ("3dgs", 60, f"none beside the checkpoint; {WITHOUT}")
    assert isinstance(facts["effects"], list) and isinstance(facts["notes"], list)


def test_the_next_command_for_a_lone_file_can_be_run_as_it_is(run, tmp_path):
    """It ended with --cameras SCENE, and there is no such file."""
    ply = tiny.ply(tmp_path / "a.ply")
    [words] = re.findall("next: mipmap-plugin (.+)", run("inspect", ply, "--no-viewers")[1])
    assert run(*words.split(), *NO_STEP)[0] == 0


def test_cameras_beside_a_lone_file_are_named_but_not_read(run, tmp_path):
    """They may be of another scene."""
    ply, cameras = tiny.ply(tmp_path / "a.ply"), tmp_path / "cameras.json"
    cameras.write_text("[]")
    out = run("inspect", ply, "--no-viewers")[1]
    assert f"cameras:      none are read; {cameras} may be of this scene; {WITHOUT}\n" in out
    assert f"adapt {ply} --scale 1/4 --cameras {cameras}\n" in out
    err = run("adapt", ply, "--scale", "1/2", "--recipe", "instant")[2]
    assert f"give the scene's cameras (--cameras), such as {cameras}, if it is of this scene" in " ".join(err.split())


def test_inspect_sees_a_lone_file_by_given_cameras(run, model_folder, tmp_path):
    ply, cameras = tiny.ply(tmp_path / "a.ply"), model_folder / "cameras.json"
    out = run("inspect", ply, "--no-viewers", "--cameras", cameras)[1]
    assert "\ncameras:      4, 32 x 24 px, " in out and f"adapt {ply} --scale 1/4 --cameras {cameras}\n" in out
    code, _, err = run("inspect", ply, "--cameras", tmp_path / "none.json")
    assert code == 2 and "none.json: there is no such file" in err


def test_cameras_that_see_nothing_of_a_lone_file_make_it_doubtful(run, tmp_path):
    """Viewers were said to be the same."""
    back = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    turned = [replace(camera, viewmat=back @ camera.viewmat) for camera in tiny.cameras(3)]
    write_cameras(tmp_path / "others.json", turned)
    _, out, _ = run("inspect", tiny.ply(tmp_path / "a.ply"), "--cameras", tmp_path / "others.json")
    assert "doubtful: read health before you adapt it" in out and "none of 3 views shows a splat: the cameras seem to be of another scene" in out
    assert re.search(r"\nviewers: +not compared: there is nothing in 3 views of its cameras\n", out)


def test_inspect_says_how_far_viewers_are_from_training(run, model_folder):
    pytest.importorskip("numba")
    [line] = [line for line in run("inspect", model_folder)[1].splitlines() if line.startswith("viewers:")]
    assert re.fullmatch(r"viewers: +spark .* dB, classic the same, antialiased .* dB, compared with its training, at x1 in 3 views", line)
    assert "viewers:      not requested" in run("inspect", model_folder, "--no-viewers")[1]


def test_numbers_and_colors_are_told_in_words(run, tmp_path):
    out = run("inspect", tiny.ply(tmp_path / "a.ply", count=1200), "--no-viewers")[1]
    assert "splats:       1,200\n" in out and ", background black\n" in out


def test_splats_of_an_adapted_file_are_counted_at_its_scale_as_adapt_does(run, tmp_path):
    """At x1 levels of detail show more than twice as many."""
    anchor_checkpoints.write(tmp_path / "base", anchor_checkpoints.Layout("octree"), count=80)
    cameras = ["--cameras", write_cameras(tmp_path / "cameras.json", tiny.cameras(6)), "--json"]
    [report] = json.loads(run("adapt", tmp_path / "base", "--scale", "1/4", "--steps", "1", *cameras)[1])
    assert json.loads(run("inspect", tmp_path / "base_x0.25", *cameras)[1])["splats"] == report["gaussians_after"]


def test_inspect_says_what_it_knows_before_it_draws(run, model_folder, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(viewer_differences, "viewer_differences", lambda wrapped: said.append(capsys.readouterr().out) or "none")
    rest = run("inspect", model_folder)[1]
    assert said[0].startswith("file:") and "health:" in said[0] and rest.startswith("viewers:      none\nnotes:")
    run("inspect", model_folder, "--json")
    assert said[1] == ""


def test_inspect_of_an_iteration(run, model_folder):
    code, out, _ = run("inspect", model_folder, "--iteration", "30000", "--no-viewers")
    assert code == 0 and f"next: mipmap-plugin adapt {model_folder}/point_cloud/iteration_30000 --scale 1/4" in out
    refused(run("inspect", model_folder, "--iteration", "7"), "7")
