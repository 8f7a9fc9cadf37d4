"""The photographs of a COLMAP scene: where they are found, at which sizes a training took them, and those of a real phone capture."""


import pytest
from colmap_files import names, write_photographs, write_text_model
from PIL import Image

from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.evaluation.judged import judged_views
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.scenes import load_photographs, load_scene

pycolmap = pytest.importorskip("pycolmap", reason="COLMAP scenes are read by pycolmap, an extra")


@pytest.mark.parametrize(("folder", "prefix"), [("images", "images/"), (".", "")])
def test_photographs_are_found_from_the_folder_above_images(tmp_path, folder, prefix):
    """COLMAP may have been run on that, or a program may write the model beside the photographs."""
    write_text_model(tmp_path / "desk", [f"{prefix}{name}" for name in names(2)])
    write_photographs(tmp_path / "desk" / folder, names(2))
    assert len(load_scene(tmp_path / "desk").images) == 2


@pytest.mark.parametrize("cfg", [{"images": "images_2"}, {"fork": 2, "ds": 2}], ids=["3dgs", "octree"])
def test_photographs_of_another_folder_keep_the_field_of_view(tmp_path, cfg):
    write_text_model(tmp_path / "sparse/0", names(2), points=0)
    write_photographs(tmp_path / "images_2", ["000.png"], size=(32, 24))
    scene = load_scene(tmp_path, {**cfg, "eval": True})
    there, absent = scene.cameras
    assert there.size == absent.size == (24, 32)  # the absent one by the name of its folder
    assert (there.fx, there.fy) == (absent.fx, absent.fy) == (35, 36)
    assert list(scene.images) == [there]
    assert scene.points is None and scene.numbers == (1, 2)


@pytest.mark.parametrize("cfg", [None, {"images": "images", "eval": True}])
def test_copies_are_the_photographs_where_there_are_no_others(tmp_path, cfg):
    """mip-NeRF 360 has images_4 and images_8, and large photographs beside them that people delete. Sizes stay those of the training."""
    write_text_model(tmp_path / "sparse/0", names(2), "SIMPLE_RADIAL", "70 32 24 0.1")
    write_photographs(tmp_path / "images_8", names(2), size=(8, 6))
    write_photographs(tmp_path / "images_4", names(1), size=(16, 12))
    scene = load_scene(tmp_path, cfg)
    assert {camera.size for camera in scene.cameras} == {(45, 61)} and {camera.fx for camera in scene.cameras} == {70}
    assert list(scene.images.values()) == [tmp_path / "images_4/000.png"] and scene.smaller(8) == (8, 6)
    assert scene.image(scene.cameras[0], (0, 0, 0)).shape == (10, 14, 3)
    assert any(note == "there is no folder images: the photographs are those of images_4" for note in scene.notes)


def test_a_wide_lens_makes_photographs_larger_when_they_are_undistorted(tmp_path):
    """A training on the undistorted ones is adapted to the whole ones, but not to copies."""
    write_text_model(tmp_path / "sparse/0", names(2), "SIMPLE_RADIAL", "40 32 24 -0.2")
    write_photographs(tmp_path / "images", names(2))
    scene = load_scene(tmp_path)
    [view] = Photographs(scene, scene.cameras, (0, 0, 0)).cameras
    assert (view.width, view.height) == (77, 51)
    write_photographs(tmp_path / "images_4", names(2), size=(16, 12))
    assert scene.smaller(4) == (19, 13)
    (tmp_path / "images").rename(tmp_path / "images_2")
    write_photographs(tmp_path / "images_2", names(2), size=(32, 24))
    with pytest.raises(SettingsError, match="has 37 x 24 px, but the base was trained at 74 x 48 px"):
        Photographs(load_scene(tmp_path), scene.cameras, (0, 0, 0))


def test_an_undistorted_copy_is_judged_in_its_own_field_of_view(tmp_path):
    """Its sides are rounded by itself: what is 77 px wide at full size is 37 px wide at half."""
    write_text_model(tmp_path / "sparse/0", ["a.png"], "SIMPLE_RADIAL", "40 32 24 -0.2")
    write_photographs(tmp_path / "images_2", ["a.png"], size=(32, 24))
    scene = load_scene(tmp_path)
    [camera], [view] = scene.cameras, judged_views(scene, scene.cameras, (0.0, 0.0, 0.0))
    height, width, _ = scene.image(camera, (0, 0, 0)).shape
    assert (view.camera.size, view.camera.fx) == ((2 * height, 2 * width), 40) and camera.size != view.camera.size
    assert view.truth(1 / 2, PROTOCOLS["P3"]).shape == (height, width, 3)


def test_photographs_that_were_turned_are_refused(tmp_path):
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    write_photographs(tmp_path / "images", ["a.png"], size=(48, 64))
    with pytest.raises(SceneError, match=r"a.png: its camera is of 64 x 48 px, but the photograph has 48 x 64 px: it was turned or cropped"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("orientation", "advice"), [(6, "its EXIF says to show it turned, .* turned "), (3, "it was turned or cropped")])
def test_photographs_that_exif_would_turn_are_refused_with_what_to_do(tmp_path, orientation, advice):
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    (tmp_path / "images").mkdir()
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.new("RGB", (48, 64)).save(tmp_path / "images/a.png", exif=exif)
    with pytest.raises(SceneError, match=f"the photograph has 48 x 64 px: {advice}"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("resolution", "size"), [(1, (48, 64)), (2, (24, 32)), (8, (6, 8)), (-1, (48, 64)), (20, (15, 20))])
def test_the_training_size_follows_r_with_photographs_and_without(tmp_path, resolution, size):
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "images", ["000.png"])
    scene = load_scene(tmp_path, {"resolution": resolution, "eval": True})
    assert [camera.size for camera in scene.cameras] == [size, size]
    assert scene.image(scene.cameras[0], (0, 0, 0)).shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("option", "model", "params", "size"),
    [("n_offsets", "SIMPLE_RADIAL", "70 32 24 0.1", (48, 64)), ("kplanes_config", "OPENCV", "70 70 32 24 0.1 0 0 0", (48, 64)),
     ("n_offsets", "OPENCV", "70 70 32 24 0.1 0 0 0", (45, 61)), ("kernel_size", "SIMPLE_RADIAL", "70 32 24 0.1", (45, 61))],
)  # fmt: skip
def test_some_projects_train_on_photographs_as_they_are(tmp_path, option, model, params, size):
    """scene/dataset_readers.py of Scaffold-GS, Octree-GS and 4DGaussians; elsewhere only photographs that were undistorted before are trained on."""
    write_text_model(tmp_path / "sparse/0", names(2), model, params)
    write_photographs(tmp_path / "images", names(1))
    as_it_is = size == (48, 64)
    for scene in (load_scene(tmp_path, {option: 10, "resolution": 1}), load_photographs(tmp_path, {option: 10, "resolution": 8})):
        assert {camera.size for camera in scene.cameras} == {size}
        assert bool(scene.lenses) != as_it_is and any("for pinholes" in note for note in scene.notes) == as_it_is


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "model"])
def test_every_folder_from_the_models_upwards_finds_the_photographs(tmp_path, place):
    write_text_model(tmp_path / place, names(1))
    write_photographs(tmp_path / "images", names(1))
    folders = [tmp_path / place, *(tmp_path / place).relative_to(tmp_path).parents][:-1]
    assert [len(load_scene(tmp_path / folder).images) for folder in folders] == [1] * len(folders)


def test_photographs_that_are_nowhere_are_missed_beside_the_model(tmp_path):
    write_text_model(tmp_path / "scene/sparse/0", names(1))
    write_photographs(tmp_path / "images", names(1))  # of another scene
    for folder in ("scene", "scene/sparse", "scene/sparse/0"):
        assert f"absent from {tmp_path / 'scene/images'}," in " ".join(load_scene(tmp_path / folder).notes)


def test_the_folder_that_convert_py_undistorts_is_named_where_its_outcome_is_absent(tmp_path):
    """convert.py of 3DGS undistorts `input` to `images`, to which the model in `sparse` belongs."""
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "input", names(2))
    [warning] = load_scene(tmp_path).warnings()
    assert "input is what convert.py of 3DGS undistorts: run it again, or rename it to images" in warning
    write_photographs(tmp_path / "images", names(2))
    assert not load_scene(tmp_path).warnings()


def test_masks_beside_photographs_are_told_of_for_they_are_not_read(tmp_path):
    """Brush reads them (crates/brush-dataset/src/formats/mod.rs, find_mask_path)."""
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "images", names(2))
    (tmp_path / "masks").mkdir()
    masked = f"photographs may be masked ({tmp_path / 'masks'}); masks are not read, so that what they hide counts like all else"
    assert load_scene(tmp_path).warnings() == [masked]


def test_a_real_capture_of_which_most_photographs_are_absent(shared_data):
    scene = load_scene(shared_data / "colmap/llff_small")
    assert (len(scene.cameras), len(scene.images), len(scene.split("test"))) == (184, 31, 23)
    assert "153 of 184 photographs" in " ".join(scene.notes)
    assert {camera.size for camera in scene.cameras} == {(960, 544)}
    first = scene.cameras[0]
    assert first in scene.images and scene.image(first, (0, 0, 0)).shape == (960, 544, 3)
    assert scene.points.shape == (6271, 3)
    seen = scene.points @ first.viewmat[:3, :3].T + first.viewmat[:3, 3]
    across = first.fx * seen[:, 0] / seen[:, 2] + first.cx
    assert ((seen[:, 2] > 0) & (across > 0) & (across < first.width)).float().mean() > 0.5  # a capture that looks at one place


@pytest.mark.parametrize(("folder", "taken"), [("rgb", "rgb"), ("images_4", "images"), ("absent", "images")])
def test_photographs_of_a_folder_of_another_name_are_those_of_the_training(tmp_path, folder, taken):
    """Option -i of 3DGS; copies are for training, and the whole photographs for judging."""
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    for place in {taken, "images"}:
        write_photographs(tmp_path / place, ["a.png"])
    scene = load_photographs(tmp_path, {"images": folder, "resolution": 2, "eval": True})
    assert [(file.parent.name, camera.size) for camera, file in scene.images.items()] == [(taken, (48, 64))]


@pytest.mark.parametrize(
    ("size", "told"),
    [((64, 46), True), ((31, 24), False), ((32, 23), False), ((62, 48), True), ((514, 381), False), ((512, 360), True)],
)
def test_photographs_that_were_cropped_a_little_are_told_of_and_rounded_copies_are_not(tmp_path, size, told):
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "images", names(2), size=size)
    told_of = f"cameras are stretched to the shape of 2 photographs, as in 3DGS (000.png has {size[0]} x {size[1]} px, its camera 64 x 48 px)"
    assert [note.partition(";")[0] for note in load_scene(tmp_path).warnings()] == [told_of] * told


def test_photographs_may_have_another_suffix_than_colmap_saw(tmp_path):
    """.JPG and .jpg are the same to Windows, and some are converted."""
    write_text_model(tmp_path / "sparse/0", ["a.JPG", "sub/b.jpg", "c.png"])
    write_photographs(tmp_path / "images", ["a.jpg", "sub/b.png", "c.png"])
    assert [file.name for file in load_scene(tmp_path).images.values()] == ["a.jpg", "c.png", "b.png"]
