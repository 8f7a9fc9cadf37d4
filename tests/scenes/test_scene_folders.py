"""What a scene is loaded from: folders, files and the images that its cameras name."""

import math
import struct
import zlib

import numpy as np
import pytest
import tiny
import torch
from PIL import Image
from scene_files import entry, frame, save_image, write_json

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import OutputExists, SceneError, SettingsError, ShapeError
from mipmap_plugin.formats.images import composite, image_size, read_image, write_image
from mipmap_plugin.scenes import load_scene, model_cameras, read_transforms
from mipmap_plugin.scenes.base import sizes_of

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def gray_png_16(path, values):
    """A 16-bit gray PNG, written by hand so that the reader's library does not test itself."""
    height, width = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    chunks = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path


# load_scene and Scene


def test_a_cameras_json_alone_says_what_it_lacks(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry()])
    scene = load_scene(path)
    assert (scene.source, scene.images) == (path, {})
    assert "without cfg_args" in scene.notes[0]


@pytest.mark.parametrize("given", ["", "cameras.json"])
def test_cameras_of_a_model_folder_have_the_size_and_the_split_of_its_training(tmp_path, given):
    """They are given with a lone file that was exported from it; the options of the checkpoint itself come first."""
    write_json(tmp_path / "cameras.json", [entry(), entry(id=1, img_name="b")])
    (tmp_path / "cfg_args").write_text("Namespace(resolution=2, eval=True)")
    scene = load_scene(tmp_path / given)
    assert [(camera.size, camera.split) for camera in scene.cameras] == [((24, 32), "test"), ((24, 32), "train")] and scene.notes == []
    assert {camera.size for camera in load_scene(tmp_path / given, {"resolution": 4}).cameras} == {(12, 16)}


def test_damaged_options_beside_cameras_are_named(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry()])
    (tmp_path / "cfg_args").write_text("Namespace(")
    with pytest.raises(SceneError, match=r"cfg_args is not a plain .* mend it, or take it away"):
        load_scene(path)


def test_a_checkpoint_may_come_with_cameras_or_without(tmp_path):
    assert model_cameras(None) == model_cameras(tmp_path) == []
    write_json(tmp_path / "cameras.json", [entry()])
    assert [camera.size for camera in model_cameras(tmp_path, {"resolution": 2})] == [(24, 32)]


def test_a_transforms_file_may_have_any_name(tmp_path):
    scene = load_scene(write_json(tmp_path / "polycam.json", {"fl_x": 9.0, "w": 8, "h": 8, "frames": [frame()]}))
    assert [camera.size for camera in scene.cameras] == [(8, 8)]
    with pytest.raises(SceneError, match=r"other.json: has no cameras: neither the frames of a transforms.json nor the list of a cameras.json"):
        load_scene(write_json(tmp_path / "other.json", {"fx": 9.0}))


@pytest.mark.parametrize("name", ["cameras.xml", "poses.csv", "bundle.out"])
def test_cameras_in_formats_that_are_not_read_are_refused(tmp_path, name):
    (tmp_path / name).write_text("<document/>")
    with pytest.raises(SceneError, match=rf"{name}: is no file of cameras that is read here .*; export them as one of these"):
        load_scene(tmp_path / name)


def test_a_file_of_splats_is_no_scene(tmp_path):
    with pytest.raises(SceneError, match=r"a.ply: is no file of cameras .*; this PLY has no camera in it: give the cameras of its scene$"):
        load_scene(tiny.ply(tmp_path / "a.ply"))


def test_a_file_of_a_colmap_model_names_its_folder(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(SceneError, match=f"give its folder, {tmp_path}$"):
        load_scene(tmp_path / "images.bin")


def test_cameras_one_level_above_or_below_are_named(tmp_path):
    (tmp_path / "captures/desk/images").mkdir(parents=True)
    write_json(tmp_path / "captures/desk/transforms.json", {})
    for given in (".", "captures", "captures/desk/images"):
        with pytest.raises(SceneError, match=f"holds neither .*, such as {tmp_path / 'captures/desk'}$"):
            load_scene(tmp_path / given)


@pytest.mark.parametrize(("file", "maker"), [("keyframes/cameras/1.json", "Polycam"), ("rgbd/0.jpg", "Record3D"), ("depth/0.exr", "Record3D")])
def test_a_capture_that_no_training_takes_as_it_is_names_what_to_give(tmp_path, file, maker):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).touch()
    with pytest.raises(SceneError, match=f"is a capture as {maker} exports it.*give what the checkpoint was trained on, such as .* ns-process-data"):
        load_scene(tmp_path)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"holds neither cameras\.json nor transforms files"):
        load_scene(tmp_path)


def test_an_absent_path_is_refused(tmp_path):
    with pytest.raises(SceneError, match="there is no such file or folder"):
        load_scene(tmp_path / "gone")


def test_an_unknown_split_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="no split 'val'"):
        load_scene(write_json(tmp_path / "cameras.json", [entry()])).split("val")


def test_a_zoomed_camera_has_no_image(tmp_path):
    save_image(tmp_path / "train/r_0.png")
    scene = read_transforms(write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.8, "frames": [frame()]}))
    assert scene.image(scene.cameras[0], WHITE).shape == (6, 8, 3)
    with pytest.raises(SceneError, match="'r_0' has no image"):
        scene.image(scene.cameras[0].zoomed(0.5), WHITE)


def test_lego_is_read_on_white_at_full_size(shared_data):
    scene = load_scene(shared_data / "images/lego")
    image = scene.image(scene.split("test")[0], WHITE)
    assert (image.shape, image.dtype) == ((800, 800, 3), torch.float32)
    assert image[0, 0].tolist() == [1, 1, 1]


# images


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_opaque_and_transparent_pixels_are_exact(background):
    values = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    for alpha, expected in ((255, values), (0, np.full_like(values, 255 * background[0]))):
        rgba = np.concatenate([values, np.full_like(values[..., :1], alpha)], axis=2)
        assert (composite(rgba, background) == expected).all()


def test_half_transparent_pixels_are_cut_off():
    assert composite(np.array([[[100, 0, 255, 128]]], dtype=np.uint8), WHITE).tolist() == [[[177, 127, 255]]]  # 177.2, 127.0, 255


def test_transparency_shows_the_background(tmp_path):
    image = read_image(save_image(tmp_path / "a.png", mode="RGBA"), (1.0, 0.0, 1.0))
    assert image[0, 0].tolist() == [1, 0, 1]


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "1"])
def test_any_color_mode_is_read(tmp_path, mode):
    assert read_image(save_image(tmp_path / "a.png", mode=mode), BLACK).tolist() == torch.zeros(6, 8, 3).tolist()


def test_jpeg_is_read(tmp_path):
    Image.new("RGB", (8, 8), (200, 100, 50)).save(tmp_path / "a.jpg", quality=95)
    torch.testing.assert_close(read_image(tmp_path / "a.jpg", WHITE)[4, 4] * 255, torch.tensor([200.0, 100.0, 50.0]), atol=2, rtol=0)


def test_16_bit_gray_keeps_its_precision(tmp_path):
    values = np.array([[0, 1, 257], [30000, 65534, 65535]], dtype=np.uint16)
    image = read_image(gray_png_16(tmp_path / "a.png", values), WHITE)
    torch.testing.assert_close(image[..., 1], torch.from_numpy(values.astype(np.float32)) / 65535)


def test_an_image_of_floats_is_refused_instead_of_black(tmp_path):
    Image.fromarray(np.float32([[0.2, 0.9]])).save(tmp_path / "a.tif")
    with pytest.raises(SceneError, match=r"a.tif: its pixels are floats, .*; save it with 8 or 16 bits"):
        read_image(tmp_path / "a.tif", (0, 0, 0))


def test_the_size_is_read_from_the_header_alone(tmp_path):
    path = save_image(tmp_path / "a.png", 800, 600)
    path.write_bytes(path.read_bytes()[:50])  # the pixels start at byte 41
    assert image_size(path) == (800, 600)


def test_what_is_written_is_read_back(tmp_path):
    values = torch.tensor([-0.5, 0.0, 0.3, 1.0, 1.5, 0.5 / 255]).reshape(1, 2, 3)
    image = read_image(write_image(tmp_path / "new/a.png", values), WHITE)
    torch.testing.assert_close(image * 255, torch.tensor([0, 0, 76, 255, 255, 0]).reshape(1, 2, 3).float(), atol=1e-4, rtol=0)


def test_nothing_is_overwritten_unasked(tmp_path):
    path = write_image(tmp_path / "a.png", torch.zeros(2, 2, 3))
    with pytest.raises(OutputExists, match="--overwrite"):
        write_image(path, torch.ones(2, 2, 3))
    assert read_image(write_image(path, torch.ones(2, 2, 3), overwrite=True), WHITE).min() == 1


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = write_image(tmp_path / "a.png", torch.zeros(2, 2, 3))

    def full_disk(self, file, **_):
        file.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_image(path, torch.ones(2, 2, 3), overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    assert read_image(path, WHITE).max() == 0


@pytest.mark.parametrize(("image", "error"), [(torch.zeros(3, 4, 4), ShapeError), (torch.full((2, 2, 3), math.nan), SceneError)])
def test_what_is_no_image_is_not_written(tmp_path, image, error):
    with pytest.raises(error, match="image"):
        write_image(tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()


def test_an_absent_image_is_named(tmp_path):
    with pytest.raises(SceneError, match="there is no such image"):
        read_image(tmp_path / "a.png", WHITE)


def test_a_text_file_is_no_image(tmp_path):
    (tmp_path / "a.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(SceneError, match="is not an image that Pillow reads"):
        read_image(tmp_path / "a.png", WHITE)


def test_a_truncated_image_is_damaged(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(SceneError, match="the image is damaged"):
        read_image(path, WHITE)


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ([(272, 480), (272, 480)], "272 x 480 px"),
        ([(272, 480), (480, 272)], "272 x 480 and 480 x 272 px"),
        ([(816, 1440), (272, 480), (480, 272)], "272 x 480 to 816 x 1440 px"),
    ],
    ids=["one size", "portrait and landscape", "two resolutions too"],
)
def test_sizes_of_cameras_are_told(sizes, said):
    assert sizes_of([Camera(*size, 300.0, 300.0, 100.0, 100.0, torch.eye(4)) for size in sizes]) == said
