"""At which size, and through which lens, other projects trained on the photographs of a scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from largest import Largest
from PIL import Image
from torch_checkpoints import gsplat_folder, splatfacto_folder, splats

from mipmap_plugin.adaptation.views.placing import placed
from mipmap_plugin.models import load_model
from mipmap_plugin.models.hosts import Capture, held_out
from mipmap_plugin.scenes import Scene, load_scene, read_cameras, write_cameras
from mipmap_plugin.wrap import wrap_model

EYE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
APPLIED = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)


def of_gsplat(path, factor):
    folder = gsplat_folder(path, splats(), normalized="false")
    lines = [line for line in (folder / "cfg.yml").read_text().splitlines() if not line.startswith("data_factor")]
    (folder / "cfg.yml").write_text("\n".join([*lines, f"data_factor: {factor}", ""]))
    return load_model(folder)


@pytest.mark.parametrize(("width", "factor", "actual"), [(1000, 3, (333, 250)), (1000, 3, (334, 250)), (1003, 7, (143, 107)), (64, 4, (16, 12))])
def test_gsplat_divides_the_lens_and_then_fits_it_to_the_picture(tmp_path, width, factor, actual):
    """examples/datasets/colmap.py: K over the factor, times the size of the first photograph over a size that was rounded down."""
    [camera] = tiny.cameras(1, width=width, height=width * 3 // 4)
    [new] = of_gsplat(tmp_path / "r", factor).as_trained([camera], Capture(smaller=lambda wanted: actual if wanted == factor else None))
    floored = width // factor, width * 3 // 4 // factor
    assert (new.width, new.height) == (int(floored[0] * (actual[0] / floored[0])), int(floored[1] * (actual[1] / floored[1])))
    assert new.fx == pytest.approx(camera.fx / factor * actual[0] / floored[0], rel=1e-12)
    assert new.cy == pytest.approx(camera.cy / factor * actual[1] / floored[1], rel=1e-12)


def test_gsplat_without_photographs_rounds_as_its_resizing_does(tmp_path):
    [camera] = tiny.cameras(1, width=1003, height=752)
    [new] = of_gsplat(tmp_path / "r", 7).as_trained([camera], Capture())
    assert (new.width, new.height) == (143, 107)


def pictures(folder, size):
    folder.mkdir(parents=True)
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(folder / "a.png")


def transforms(folder, width=3300, height=2200, **facts):
    pictures(folder / "images", (width, height))
    frame = {"file_path": "images/a.png", "transform_matrix": [*EYE, [0, 0, 0, 1]]}
    lens = {"w": width, "h": height, "fl_x": 2000.0, "fl_y": 2000.0, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": [frame], **facts}))
    return load_scene(folder)


def of_nerfstudio(path, scale=1.0, options=""):
    """A run whose config.yml has further options, in an untransformed world."""
    folder = splatfacto_folder(path, splats(), downscale="null")
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": EYE, "scale": scale}))
    (folder / "config.yml").write_text((folder / "config.yml").read_text() + options + "\n")
    return load_model(folder)


@pytest.mark.parametrize(("factors", "factor"), [((), 1), ((2,), 2), ((2, 4), 4), ((4,), 1)])
def test_nerfstudio_halves_as_far_as_there_are_copies(tmp_path, factors, factor):
    scene = transforms(tmp_path / "scene")
    for copy in factors:
        pictures(tmp_path / f"scene/images_{copy}", (3300 // copy, 2200 // copy))
    [camera] = placed(of_nerfstudio(tmp_path / "r"), scene).cameras
    assert (camera.width, camera.fx) == (3300 // factor, 2000 / factor)


def test_nerfstudio_cuts_sizes_off_and_not_the_lens(tmp_path):
    scene = transforms(tmp_path / "scene", width=1701, height=1001)
    pictures(tmp_path / "scene/images_2", (850, 500))
    [camera] = placed(of_nerfstudio(tmp_path / "r"), scene).cameras
    assert (camera.size, camera.fx, camera.cx) == ((500, 850), 1000.0, 1701 / 4)


def test_old_data_of_nerfstudio_was_turned_without_saying_so(tmp_path):
    """ns-process-data wrote no applied_transform at first; its parser assumes the usual one where there is a COLMAP model."""
    usual = [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    new = transforms(tmp_path / "new", applied_transform=usual)
    (tmp_path / "old/colmap/sparse/0").mkdir(parents=True)
    old, other = transforms(tmp_path / "old"), transforms(tmp_path / "other")
    views = [placed(of_nerfstudio(tmp_path / f"r{i}"), scene).cameras[0].viewmat for i, scene in enumerate((new, old, other))]
    assert torch.equal(views[0], views[1]) and not torch.allclose(views[0], views[2])


def test_a_scale_that_was_applied_before_is_not_applied_again(tmp_path):
    """nerfstudio saves its own scale times that of the file, whose poses have it already."""
    shifted = [[1.0, 0, 0, 3], [0, 1, 0, 0], [0, 0, 1, 0]]
    frame = {"file_path": "images/a.png", "transform_matrix": [*shifted, [0, 0, 0, 1]]}
    scene = transforms(tmp_path / "scene", width=64, height=48, applied_scale=0.1, frames=[frame])
    [camera] = placed(of_nerfstudio(tmp_path / "r", scale=0.5 * 0.1), scene).cameras
    torch.testing.assert_close(camera.center, torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("turned", [True, False])
def test_photographs_of_nerfstudio_judge_a_base_of_colmaps_world(tmp_path, turned):
    there = [view.moved(APPLIED) for view in tiny.cameras(3)]
    scene = Scene(tuple(there), {}, tmp_path, ["one"], applied=APPLIED)
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3) if turned else there)
    found = base.place(scene)
    for camera, own in zip(found.cameras, base.cameras, strict=True):
        torch.testing.assert_close(camera.viewmat, own.viewmat)
    assert [("applied_transform" in note) for note in found.notes] == [False, True][: 1 + turned]
    assert wrap_model(tiny.model()).place(scene) is scene


@pytest.mark.parametrize(("there", "here", "turned"), [(12, 2, True), (2, 12, True), (12, 12, False)])
def test_applied_transform_is_taken_back_for_some_of_the_views_and_not_for_cameras_of_a_third_world(tmp_path, there, here, turned):
    views, third = tiny.cameras(12), torch.diag(torch.tensor([-0.3, -0.3, 0.3, 1], dtype=torch.float64))
    scene = Scene(tuple(view.moved(APPLIED) for view in views[:there]), {}, tmp_path, [], applied=APPLIED)
    base = wrap_model(tiny.model(), cameras=[view if turned else view.moved(third) for view in views[:here]])
    assert (base.place(scene) is not scene) == turned


def test_thousands_of_cameras_tell_their_world_without_a_number_for_each_pair(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.views.placing.LOOKED_AT", 8)
    views = tiny.cameras(60)
    scene = Scene(tuple(view.moved(APPLIED) for view in views), {}, tmp_path, [], applied=APPLIED)
    with Largest() as largest:
        assert wrap_model(tiny.model(), cameras=views).place(scene) is not scene
    assert largest.numbers < 60 * 20


def test_gsplat_holds_out_the_views_that_its_options_say(tmp_path):
    """Not every eighth where test_every is another number: a view that was trained on is no test view."""
    cameras = tuple(replace(view, name=f"{i:02d}", split="train" if i % 8 else "test") for i, view in enumerate(tiny.cameras(10)))
    scene = Scene(cameras, {}, tmp_path, ["10 cameras in the order of their names: every 8th is for testing, the others for training", "other"])
    model = of_gsplat(tmp_path / "r", 1)
    assert placed(model, scene).notes == scene.notes
    cfg = tmp_path / "r/cfg.yml"
    cfg.write_text(cfg.read_text() + "test_every: 1000\n")
    here = placed(load_model(tmp_path / "r"), scene)
    assert [camera.name for camera in here.split("test")] == ["00"]
    assert here.notes == ["other", "the checkpoint's options hold out 1 of 10 views: these are for testing"]


def test_views_are_held_out_in_the_order_of_their_files():
    """gsplat and nerfstudio sort names with their endings: a-1.jpg comes before a.jpg."""
    cameras = [replace(view, name=name) for name, view in zip(["a", "a-1", "b"], tiny.cameras(3), strict=True)]
    assert [camera.name for camera in held_out(cameras, [0]) if camera.split == "test"] == ["a-1"]


@pytest.mark.parametrize(
    ("options", "tests"),
    [("eval_mode: fraction\ntrain_split_fraction: 0.75", [4, 9]), ("eval_mode: interval\neval_interval: 4", [0, 4, 8]),
     ("eval_mode: interval", [0, 8]), ("eval_mode: filename", [3, 9]), ("eval_mode: all", []), ("", [])],
)  # fmt: skip
def test_nerfstudio_holds_out_the_views_that_its_config_says(tmp_path, options, tests):
    """data/utils/dataparsers_utils.py, in the order of names, whatever that of the frames is."""
    names = [f"{number:02d}_{'eval' if number in (3, 9) else 'train'}" for number in range(11)]
    cameras = tuple(replace(view, name=name) for name, view in zip(names, tiny.cameras(11), strict=True))[::-1]
    model = of_nerfstudio(tmp_path / "r", options=options)
    held_out = [camera.name for camera in placed(model, Scene(cameras, {}, tmp_path)).split("test")]
    assert sorted(held_out) == [names[number] for number in tests]
    eighths = tuple(replace(camera, split="test" if number % 8 == 0 else "train") for number, camera in enumerate(cameras[::-1]))
    colmap = placed(model, Scene(eighths, {}, tmp_path, points=torch.zeros(1, 3))).split("test")
    assert [camera.name for camera in colmap] == [names[number] for number in (tests if options else [0, 8])]
    listed = Scene((replace(cameras[0], split="test"), *cameras[1:]), {}, tmp_path)  # by the file of the scene, which wins
    assert [camera.name for camera in placed(model, listed).split("test")] == [cameras[0].name]


@pytest.mark.parametrize(
    ("options", "tests"),
    [("assume_colmap_world_coordinate_convention: true\neval_mode: interval\neval_interval: 4", [9, 10, 6]),
     ("assume_colmap_world_coordinate_convention: true\neval_mode: filename", [3, 9]), ("eval_mode: interval\neval_interval: 4", [0, 4, 8])],
)  # fmt: skip
def test_nerfstudio_orders_the_images_of_colmap_by_their_numbers(tmp_path, options, tests):
    """COLMAP numbers images as its threads are done with them (colmap/colmap#3404)."""
    names = [f"{number:02d}_{'eval' if number in (3, 9) else 'train'}" for number in range(11)]
    cameras = tuple(replace(view, name=name) for name, view in zip(names, tiny.cameras(11), strict=True))
    order = [9, 0, 2, 1, 10, 3, 5, 4, 6, 8, 7]
    scene = Scene(cameras, {}, tmp_path, points=torch.zeros(1, 3), numbers=tuple(order.index(place) + 1 for place in range(11)))
    found = placed(of_nerfstudio(tmp_path / "r", options=options), scene).split("test")
    assert [camera.name for camera in found] == [names[number] for number in sorted(tests)]


@pytest.mark.parametrize("names", [["b/0.png", "b/1.png", "a/1.png", "a/0.png"], ["b/0.png", "./b/2.png", "a/3.png", "a/1.png"]])
def test_nerfstudio_orders_frames_by_their_paths(tmp_path, names):
    """data/dataparsers/nerfstudio_dataparser.py: of the cameras of a rig, whose files have the same names or not, one after the other."""
    frames = [{"file_path": name, "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]]} for x, name in enumerate(names)]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 60.0, "w": 64, "h": 48, "frames": frames}))
    found = placed(of_nerfstudio(tmp_path / "r", options="eval_mode: interval\neval_interval: 2"), load_scene(tmp_path)).split("test")
    assert sorted(camera.center[0].item() for camera in found) == [0, names.index(sorted(names[2:])[0])]


@pytest.mark.parametrize(("options", "width"), [({"ds": 8, "fork": 2, "resolution": -1}, 618), ({"ds": 1, "fork": 2}, 4946), ({"ds": 8}, 4946)])
def test_octree_gs_trains_on_the_folder_that_ds_names(tmp_path, options, width):
    """scene/dataset_readers.py of Octree-GS; the option of the same name in Scaffold-GS changes nothing there."""
    path = write_cameras(tmp_path / "cameras.json", tiny.cameras(1, width=4946, height=3286))
    assert read_cameras(path, options)[0].width == width
