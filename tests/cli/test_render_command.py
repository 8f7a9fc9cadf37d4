"""`render`: the pictures that it writes, and their names."""

from dataclasses import replace
from unittest.mock import Mock

import moving
import numpy as np
import pytest
import tiny
import torch
from commands_run import refused
from PIL import Image

from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.evaluation.measure import baselines
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped, wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


def test_a_wrong_scale_of_render_is_named(run, model_folder):
    code, _, err = run("render", model_folder, "--output", "out", "--scale", "0")
    assert code == 2 and "scale must be a number or a fraction from 1e-09 to" in err and "Annotated" not in err


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
    assert "none of 2 views shows a splat: the cameras seem to be of another scene" in " ".join(err.split())


def test_render_says_that_its_views_are_generated(run, tmp_path):
    out = run("render", tiny.ply(tmp_path / "a.ply"), "--output", tmp_path / "out", "--up", "z")[1]
    assert out.endswith("\nseen from a generated orbit, from above the horizon, with z up; --cameras gives the scene's own cameras\n")


def test_render_says_that_a_viewer_draws_no_such_splats(run, tmp_path):
    folder, scene = moving.write_deformable(tmp_path / "moving"), write_cameras(tmp_path / "cameras.json", tiny.cameras(1))
    code, _, err = run("render", folder, "--output", tmp_path / "out", "--viewer", "spark", "--cameras", scene, "--backend", "reference")
    assert code == 0 and "spark: a network moves its splats" in err and "what its settings would make of these splats" in " ".join(err.split())


def test_render_takes_a_folder_and_not_the_name_of_a_picture(run, model_folder, tmp_path):
    code, _, err = run("render", model_folder, "--output", tmp_path / "view.PNG")
    assert code == 2 and "view.PNG: pictures are written to a folder, each by the name of its view; give the folder" in err
    assert not (tmp_path / "view.PNG").exists()


@pytest.mark.parametrize("name", ["train_view_1", "train_view_1.png"])
def test_a_view_may_be_called_as_its_picture_is(run, model_folder, tmp_path, name):
    assert run("render", model_folder, "--output", tmp_path / "out", "--view", name)[0] == 0
    assert [picture.name for picture in (tmp_path / "out").iterdir()] == ["train_view_1.png"]


def test_render_refuses_names_that_are_not_there_and_pictures_that_are(run, model_folder, tmp_path):
    refused(run("render", model_folder, "--output", tmp_path / "out", "--view", "nowhere"), "there is no view nowhere; the first of 4 are view_")
    words = ["render", model_folder, "--output", tmp_path / "out", "--view", "view_1"]
    assert run(*words)[0] == 0
    refused(run(*words), "train_view_1.png exists already; pass --overwrite")
    refused(run(*words, "--overwrite", "--supersampling", "0"), "supersampling must be a whole number of at least 1")
    assert run(*words, "--overwrite")[0] == 0


@pytest.mark.parametrize("more", [(), ("--overwrite",)])
def test_render_goes_on_with_the_pictures_that_are_missing(run, model_folder, tmp_path, monkeypatch, more):
    words = ["render", model_folder, "--output", tmp_path / "out", "--depth", *more]
    if more:
        assert run(*words, "--scale", "1/2")[0] == 0
    drawn, draw = [], Wrapped.render

    def tired(self, camera, *args, **options):
        drawn.append(camera.name)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        return draw(self, camera, *args, **options)

    monkeypatch.setattr(Wrapped, "render", tired)
    code, _, err = run(*words)
    assert code == 130 and "interrupted with 2 pictures finished; run the same command again to go on" in err
    if not more:
        assert "exists already; pass --overwrite" in refused(run(*words, "--scale", "1/2"))  # another request is no going on
    drawn += ["so that none is the third"]
    code, out, err = run(*words)
    assert code == 0 and out.startswith("4 pictures in") and len(drawn) == 3 + 1 + 2
    assert "finished before it was interrupted: 2; they are not rendered again" in err
    assert sorted(file.suffix for file in (tmp_path / "out").iterdir()) == [".npy"] * 4 + [".png"] * 4
    assert Image.open(tmp_path / "out" / "train_view_1.png").size == (32, 24)


def test_pictures_that_another_command_has_replaced_are_not_taken_for_finished(run, model_folder, tmp_path, monkeypatch):
    words = ["render", model_folder, "--output", tmp_path / "out", "--overwrite"]
    draw = Wrapped.render
    with monkeypatch.context() as interrupted:
        interrupted.setattr(Wrapped, "render", Mock(side_effect=[draw(wrap_model(model_folder), tiny.cameras(1)[0]), KeyboardInterrupt]))
        assert run(*words)[0] == 130
    assert run(*words, "--scale", "1/2")[0] == 0
    assert run(*words)[0] == 0
    assert {Image.open(file).size for file in (tmp_path / "out").iterdir()} == {(32, 24)}


def test_depth_of_a_picture_that_is_replaced_goes_with_it(run, model_folder, tmp_path):
    words = ["render", model_folder, "--output", tmp_path / "out", "--view", "view_1"]
    assert run(*words, "--depth", "--normals")[0] == 0
    assert run(*words, "--normals", "--scale", "1/2", "--overwrite")[0] == 0
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["train_view_1.png", "train_view_1_normals.npy"]


def test_a_depth_that_was_deleted_after_an_interruption_is_written_again(run, model_folder, tmp_path, monkeypatch):
    words = ["render", model_folder, "--output", tmp_path / "out", "--depth", "--overwrite"]
    first = wrap_model(model_folder).render(tiny.cameras(1)[0], outputs=["depth"])
    with monkeypatch.context() as interrupted:
        interrupted.setattr(Wrapped, "render", Mock(side_effect=[first, KeyboardInterrupt]))
        assert run(*words)[0] == 130
    [depth] = (tmp_path / "out").glob("*_depth.npy")
    depth.unlink()
    assert run(*words)[0] == 0 and depth.exists()


def test_picture_names_are_unique_and_stay_in_their_folder():
    given = [("a", "train"), ("a", "train"), ("a", "test"), ("../../b", "test"), ("c\\d", "train"), ("a_2", "train")]
    named = [replace(tiny.cameras(1)[0], name=name, split=split) for name, split in given]
    assert picture_names(named) == ["train_a_1.png", "train_a_3.png", "test_a.png", "test_.._.._b.png", "train_c_d.png", "train_a_2.png"]


@pytest.mark.parametrize("words", [["render"], ["tradeoff", "--scale", "1/2"]])
def test_a_file_where_pictures_are_to_go_is_named(run, tmp_path, words):
    (tmp_path / "taken").write_text("precious")
    command, *options = words
    said = f"{tmp_path / 'taken'} is a file, not a folder; choose another path"
    refused(run(command, tiny.ply(tmp_path / "a.ply"), "--output", tmp_path / "taken", *options), said)
