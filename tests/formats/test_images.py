"""Images: read exactly, on the background that is asked for, refused in a sentence, and written whole or not at all."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from png_files import GRAY_16, RGB, write_png

from mipmap_plugin.errors import OutputExists, SceneError, ShapeError
from mipmap_plugin.formats.images import composite, image_size, read_image, read_rgba, write_image

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def blank(folder, mode, size=(8, 6)):
    Image.new(mode, size).save(folder / "a.png")
    return folder / "a.png"


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_opaque_and_transparent_pixels_are_exact(background):
    values = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    for alpha, expected in ((255, values), (0, np.full_like(values, 255 * background[0]))):
        rgba = np.concatenate([values, np.full_like(values[..., :1], alpha)], axis=2)
        assert (composite(rgba, background) == expected).all()


def test_half_transparent_pixels_are_cut_off():
    assert composite(np.array([[[100, 0, 255, 128]]], dtype=np.uint8), WHITE).tolist() == [[[177, 127, 255]]]  # 177.2, 127.0, 255


def test_transparency_shows_the_background(tmp_path):
    image = read_image(blank(tmp_path, "RGBA"), (1.0, 0.0, 1.0))
    assert image[0, 0].tolist() == [1, 0, 1]


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "1"])
def test_any_color_mode_is_read(tmp_path, mode):
    assert read_image(blank(tmp_path, mode), BLACK).tolist() == torch.zeros(6, 8, 3).tolist()


@pytest.mark.parametrize(("least", "size"), [(None, (40, 56)), (41, (40, 56)), (10, (10, 14)), (11, (20, 28))])
def test_a_large_jpeg_is_read_smaller_where_few_pixels_do(tmp_path, least, size):
    Image.new("RGB", (56, 40), (200, 100, 50)).save(tmp_path / "a.jpg", quality=95)
    image = read_image(tmp_path / "a.jpg", WHITE, least)
    assert tuple(image.shape[:2]) == size
    torch.testing.assert_close(image[4, 4] * 255, torch.tensor([200.0, 100.0, 50.0]), atol=2, rtol=0)


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_pixels_are_read_as_they_are_stored(tmp_path, mode):
    pixels = np.random.default_rng(0).integers(0, 255, (3, 5, len(mode)), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.webp", lossless=True, exact=True)
    read = read_rgba(tmp_path / "a.webp")
    assert np.array_equal(read[..., : len(mode)], pixels) and (mode == "RGBA" or (read[..., 3] == 255).all())


def test_16_bit_gray_keeps_its_precision(tmp_path):
    values = np.array([[0, 1, 257], [30000, 65534, 65535]], dtype=np.uint16)
    image = read_image(write_png(tmp_path / "a.png", (3, 2), GRAY_16, values.astype(">u2").tobytes()), WHITE)
    torch.testing.assert_close(image[..., 1], torch.from_numpy(values.astype(np.float32)) / 65535)


def test_the_size_is_read_from_the_header_alone(tmp_path):
    path = blank(tmp_path, "RGB", (800, 600))
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


@pytest.mark.parametrize(("image", "error"), [(torch.zeros(3, 4, 4), ShapeError), (torch.full((2, 2, 3), math.nan), SceneError)])
def test_what_is_no_image_is_not_written(tmp_path, image, error):
    with pytest.raises(error, match="image"):
        write_image(tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()


# What is refused


def program(path):
    """In PostScript, which Pillow would have run."""
    Image.new("RGB", (4, 4)).save(path.with_suffix(".eps"))
    path.with_suffix(".eps").rename(path)


def cut_off(path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:3000])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "there is no such image"),
        (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"), "is not an image that Pillow reads"),
        (program, "is not an image that Pillow reads"),
        (cut_off, "the image is damaged"),
        (lambda path: write_png(path, (20_000, 10_000), RGB, b""), "has over 178,956,970 px, more than a camera takes; give it smaller"),
        (lambda path: Image.fromarray(np.float32([[0.2, 0.9]])).save(path, "TIFF"), "its pixels are floats, .*; save it with 8 or 16 bits"),
    ],
    ids=["absent", "a text", "a program", "cut off", "too large for Pillow", "floats, which would be black"],
)
def test_what_is_no_image_is_refused(tmp_path, make, said):
    make(tmp_path / "a.png")
    with pytest.raises(SceneError, match=rf"a\.png: {said}"):
        read_image(tmp_path / "a.png", BLACK)


def test_a_picture_beyond_the_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.limits.memory", lambda _: 1000.0)
    with pytest.raises(SceneError, match=r"a\.png: an image of 20 x 20 px needs .* and this machine has"):
        read_image(write_png(tmp_path / "a.png", (20, 20), RGB, bytes(1200)), BLACK)


def test_compositing_in_parts_is_compositing(monkeypatch):
    rgba = np.random.default_rng(0).integers(0, 256, (37, 11, 4), dtype=np.uint8)
    whole = composite(rgba, (0.2, 0.5, 1.0))
    color, alpha = rgba[..., :3] / 255.0, rgba[..., 3:] / 255.0
    assert np.array_equal(whole, ((color * alpha + np.array([0.2, 0.5, 1.0]) * (1 - alpha)) * 255.0).astype(np.uint8))
    monkeypatch.setattr("mipmap_plugin.formats.images.TOGETHER", 50)
    assert np.array_equal(composite(rgba, (0.2, 0.5, 1.0)), whole)
