"""Times: which moment each view of a moving scene is adapted at."""

import json
from dataclasses import replace

import moving
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.views.moments import with_times
from mipmap_plugin.cli import main
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes import jittered
from mipmap_plugin.wrap import wrap_model


def test_views_without_a_time_get_all_times_evenly_in_random_order():
    views, note = with_times(tiny.cameras(11), seed=0)
    times = [view.time for view in views]
    assert sorted(times) == pytest.approx([step / 10 for step in range(11)]) and times != sorted(times)
    assert note == "11 of them without a time of their own, spread over 0..1"
    assert [view.time for view in with_times(tiny.cameras(11), seed=0)[0]] == times
    assert [view.time for view in with_times(tiny.cameras(11), seed=1)[0]] != times


def test_views_keep_the_times_that_they_have():
    cameras = [replace(camera, time=0.25) for camera in tiny.cameras(3)]
    assert with_times(cameras, seed=0) == (cameras, "at their own times")
    mixed, note = with_times([*cameras, *tiny.cameras(1)], seed=0)
    assert ([view.time for view in mixed], note[:4]) == ([0.25, 0.25, 0.25, 0.0], "1 of")


def test_jittered_views_take_the_times_of_the_cameras():
    cameras = [replace(camera, time=number / 3) for number, camera in enumerate(tiny.cameras(4))]
    assert {view.time for view in jittered(cameras, 8, torch.Generator().manual_seed(0))} == {0.0, 1 / 3, 2 / 3, 1.0}


def test_the_report_says_how_a_moving_scene_was_sampled_and_that_of_a_static_one_has_no_times(tmp_path):
    moves = wrap_model(moving.write_deformable(tmp_path / "m")).adapt(4, recipe="instant")
    times = "104 of them without a time of their own, spread over 0..1, each at the nearest of 24 moments"
    assert moves.report.views == f"4 train views and 100 around them, {times}"
    static = wrap_model(tiny.model(), cameras=tiny.cameras()).adapt(4, recipe="instant")
    assert "time" not in static.report.views


FAMILIES = {
    "deformable": (lambda path: moving.write_deformable(path, moving.deform_state(width=64)), "deform/iteration_40000/deform.pth"),
    "4dgs": (lambda path: moving.write_hexplane(path, "no_do=False, no_dshs=False"), "point_cloud/iteration_14000/deformation.pth"),
}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("scale", "settings"), [(1 / 4, dict(steps=15, extra_views=4)), (4, dict(recipe="instant"))])
def test_adapting_gains_and_leaves_the_network_as_it_was(tmp_path, family, scale, settings):
    write, network = FAMILIES[family]
    wrapped = wrap_model(write(tmp_path / "m"))
    adapted = wrapped.adapt(scale, **settings)
    base, now = moving.decibels(wrapped, adapted, [moving.at(time) for time in (0.0, 0.5, 1.0)])
    assert now > base + 1
    assert "without a time of their own, spread over 0..1" in adapted.report.views
    adapted.save(tmp_path / "out")
    assert (tmp_path / "out" / network).read_bytes() == (tmp_path / "m" / network).read_bytes()


@pytest.mark.parametrize("write", [moving.write_deformable, moving.write_hexplane])
def test_inspect_says_that_the_scene_moves(tmp_path, capsys, write):
    write(tmp_path / "m")
    assert main(["inspect", str(tmp_path / "m")]) == 0
    output = capsys.readouterr().out
    assert "is frozen: they adapt as they are before they move" in output and "without a time shows the moment 0" in output


def test_render_shows_the_moments_that_are_asked_for(tmp_path, capsys):
    folder, words = moving.write_hexplane(tmp_path / "m"), ["--view", tiny.cameras(1)[0].name]
    for output, times in (("one", ["0"]), ("two", ["0.25", "1"])):
        assert main(["render", str(folder), "--output", str(tmp_path / output), *words, *(w for t in times for w in ("--time", t))]) == 0
    [one], two = sorted((tmp_path / "one").iterdir()), sorted((tmp_path / "two").iterdir())
    assert [picture.stem.rpartition("_")[2] for picture in two] == ["t0.25", "t1"] and "_t0" not in one.stem
    assert len({picture.read_bytes() for picture in (one, *two)}) == 3


def test_a_view_has_the_exposure_of_its_name_at_each_moment(tmp_path):
    folder, name = moving.write_hexplane(tmp_path / "m"), tiny.cameras(1)[0].name
    (folder / "exposure.json").write_text(json.dumps({name: [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}))
    words = ["render", str(folder), "--view", name, "--time", "0.25", "--time", "1"]
    assert main([*words, "--output", str(tmp_path / "plain")]) == main([*words, "--output", str(tmp_path / "exposed"), "--exposure"]) == 0
    plain, exposed = ({picture.name: picture.read_bytes() for picture in (tmp_path / each).iterdir()} for each in ("plain", "exposed"))
    assert len(plain) == 2 and plain.keys() == exposed.keys() and plain != exposed


def test_render_refuses_times_of_no_scene(tmp_path, capsys):
    still, moves = tiny.folder(tmp_path / "still", tiny.cameras(1)), moving.write_hexplane(tmp_path / "m")
    cases = (still or tmp_path / "still", "0.5", "nothing moves in this scene"), (moves, "1.5", "must be from 0 to 1, got 1.5")
    for folder, time, sentence in cases:
        assert main(["render", str(folder), "--output", str(tmp_path / "out"), "--time", time]) == 2
        assert sentence in capsys.readouterr().err


def carried(folder, far):
    """What adapting at x1/16 finds without cameras where the field carries all splats that far along x, in world units."""
    state = moving.deform_state()
    state["gaussian_warp.bias"] = state["gaussian_warp.bias"] + torch.tensor([far, 0.0, 0.0])
    moving.write_deformable(folder, state)
    (folder / "cameras.json").unlink()
    wrapped = wrap_model(folder)
    return wrapped, wrapped.adapt(1 / 16, steps=2, extra_views=6, validation_views=4).report


def test_splats_that_a_field_carries_far_away_are_adapted_as_those_that_stay(tmp_path):
    (_, stays), (wrapped, goes) = carried(tmp_path / "stays", 0.0), carried(tmp_path / "goes", 30.0)
    assert wrapped.viewpoints.orbit.center[0] == pytest.approx(30, abs=0.5)
    gains = [report.psnr_after() - report.psnr_before() for report in (stays, goes)]
    assert gains[0] > 3 and gains[1] == pytest.approx(gains[0], abs=0.01)
    with pytest.raises(SettingsError, match="the cameras seem to be in other units"):
        wrapped.adapt(1 / 16, cameras=tiny.cameras(4), views="given", steps=2)
