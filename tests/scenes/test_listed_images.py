"""Where the images are that a transforms file lists: as ScanNet++ and DL3DV have them."""

import pytest
from scene_files import frame, save_image, write_json

from mipmap_plugin.errors import SceneError
from mipmap_plugin.scenes import load_scene

SIZED = {"w": 80, "h": 60, "fl_x": 70.0}


@pytest.mark.parametrize(
    ("file", "folder"),
    [("transforms.json", "resized_images"), ("transforms_undistorted.json", "resized_undistorted_images"), ("transforms.json", "images")],
)
def test_images_of_scannetpp_lie_beside_the_folder_of_its_files(tmp_path, file, folder):
    image = save_image(tmp_path / "dslr" / folder / "DSC1.JPG", 80, 60)
    (tmp_path / "dslr/nerfstudio").mkdir()
    data = {**SIZED, "frames": [frame(file_path="DSC1.JPG")], "test_frames": [frame(file_path="DSC2.JPG")]}
    path = write_json(tmp_path / "dslr/nerfstudio" / file, data)
    for given in path, path.parent:
        scene = load_scene(given)
        assert [each.resolve() for each in scene.images.values()] == [image.resolve()]
        assert [camera.split for camera in scene.cameras] == ["train", "test"]


def test_undistorted_cameras_of_scannetpp_do_not_get_the_distorted_images(tmp_path):
    save_image(tmp_path / "resized_images/DSC1.JPG", 80, 60)
    (tmp_path / "nerfstudio").mkdir()
    path = write_json(tmp_path / "nerfstudio/transforms_undistorted.json", {**SIZED, "frames": [frame(file_path="DSC1.JPG")]})
    assert load_scene(path).images == {}


def test_the_largest_copies_are_taken_if_there_is_none_of_the_images(tmp_path):
    """DL3DV is offered with images_4 or images_8 alone. The cameras keep the size that the file states."""
    copy = save_image(tmp_path / "images_4/a.png", 20, 15)
    save_image(tmp_path / "images_8/a.png", 10, 8)
    scene = load_scene(write_json(tmp_path / "transforms.json", {**SIZED, "frames": [frame(file_path="./images/a.png")]}).parent)
    [camera] = scene.cameras
    assert (scene.images[camera], camera.size, camera.fx) == (copy, (60, 80), 70.0)
    assert scene.notes == ["transforms.json: the images that it lists are not there, and the photographs are those of images_4"]
    save_image(tmp_path / "images/a.png", 80, 60)
    assert load_scene(tmp_path).notes == []


def test_copies_do_not_tell_the_size_of_the_images(tmp_path):
    save_image(tmp_path / "images_4/a.png", 20, 15)
    write_json(tmp_path / "transforms.json", {"fl_x": 70.0, "frames": [frame(file_path="images/a.png")]})
    with pytest.raises(SceneError, match="the sizes are unknown; add the images, or w and h to the file"):
        load_scene(tmp_path)


@pytest.mark.parametrize("listed", ["/home/a/desk/images/{}.png", "C:\\Users\\a\\desk\\images\\{}.png", "data/desk/images/{}.png", "{}.png"])
def test_images_listed_by_a_path_of_elsewhere_are_found_beside_the_file(tmp_path, listed):
    """colmap2nerf.py of instant-ngp lists what it was given, on the computer where it ran."""
    images = [save_image(tmp_path / f"images/{name}.png", 80, 60) for name in "ab"]
    write_json(tmp_path / "transforms.json", {"fl_x": 70.0, "frames": [frame(file_path=listed.format(name)) for name in "ab"]})
    scene = load_scene(tmp_path)
    assert ([*scene.images.values()], scene.cameras[0].size) == (images, (60, 80))
    assert scene.notes == [f"transforms.json: the images that it lists are not there, and the photographs are those of {tmp_path / 'images'}"]


@pytest.mark.parametrize("listed", [["undistorted/a.png"], ["/home/a/undistorted/a.png"], ["/left/images/a.png", "/right/images/a.png"]])
def test_images_by_the_same_name_of_another_folder_are_not_taken(tmp_path, listed):
    """They may be distorted ones, or another camera's."""
    save_image(tmp_path / "images/a.png", 80, 60)
    write_json(tmp_path / "transforms.json", {**SIZED, "frames": [frame(file_path=path) for path in listed]})
    assert load_scene(tmp_path).images == {}


def test_of_several_files_without_usual_names_one_has_to_be_given(tmp_path):
    for name in ("transforms_a.json", "transforms_b.json"):
        write_json(tmp_path / name, {**SIZED, "frames": [frame()]})
    with pytest.raises(SceneError, match=r"holds transforms_a\.json, transforms_b\.json; give one of these files"):
        load_scene(tmp_path)
