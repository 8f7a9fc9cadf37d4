"""Camera: zooms keep the field of view, and a known point lands on a known pixel."""

import math
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from mipmap_plugin.camera import Camera, digest_of, of_base_scale
from mipmap_plugin.errors import SettingsError, ShapeError

# Evaluated by hand in float64: quaternion (0.9, 0.1, -0.2, 0.3) normalized, translation (0.5, -0.25, 4).
VIEWMAT = torch.tensor(
    [
        [0.726315789, -0.610526316, -0.315789474, 0.5],
        [0.526315789, 0.789473684, -0.315789474, -0.25],
        [0.442105263, 0.063157895, 0.894736842, 4.0],
        [0.0, 0.0, 0.0, 1.0],
    ],
    dtype=torch.float64,
)


@pytest.fixture
def camera() -> Camera:
    return Camera(64, 48, 70.0, 72.0, 32.0, 24.0, VIEWMAT, "view", "test", 0.5)


def project(camera: Camera, point: tuple[float, float, float]) -> tuple[float, float]:
    x, y, z, _ = (camera.viewmat @ torch.tensor([*point, 1.0], dtype=torch.float64)).tolist()
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_center_of_the_test_vector(camera):
    assert camera.center.tolist() == pytest.approx([-2.0, 0.25, -3.5], abs=1e-7)


@pytest.mark.parametrize("factor", [1 / 64, 1 / 8, 0.37, 1.0, 4.0])
def test_zoom_scales_every_pixel_position(camera, factor):
    zoomed = camera.zoomed(factor)
    x, y = project(camera, (0.1, 0.2, 0.3))
    assert project(zoomed, (0.1, 0.2, 0.3)) == pytest.approx((x * zoomed.width / 64, y * zoomed.height / 48))


def test_zoom_rounds_the_size_and_follows_it_per_axis():
    zoomed = Camera(5025, 3312, 4328.6, 4285.5, 2512.5, 1656.0, VIEWMAT).zoomed(1 / 8)
    assert (zoomed.size, zoomed.fx, zoomed.fy) == ((414, 628), pytest.approx(4328.6 * 628 / 5025), pytest.approx(4285.5 / 8))


def test_zoom_never_goes_below_one_pixel(camera):
    assert camera.zoomed(1e-6).size == (1, 1)


@pytest.mark.parametrize("size", [(0, 3), (2.5, 3)])
def test_other_sizes_of_a_view_are_checked(camera, size):
    with pytest.raises(SettingsError, match="must be"):
        camera.resized(*size)


def test_cameras_of_a_base_are_of_its_scale_whatever_they_were_before(camera):
    [plain, zoomed] = of_base_scale([camera, camera.zoomed(0.5)])
    assert plain is camera
    assert (zoomed.zoom, zoomed.size, zoomed.fx) == (1.0, camera.zoomed(0.5).size, camera.zoomed(0.5).fx)


def test_zoom_keeps_name_split_and_time(camera):
    zoomed = camera.zoomed(0.5)
    assert (zoomed.name, zoomed.split, zoomed.time) == ("view", "test", 0.5)


def test_equal_cameras_are_different_keys(camera):
    assert len({camera: 0, camera.zoomed(1.0): 1}) == 2


def test_a_pose_is_copied_so_that_its_owner_cannot_move_the_camera():
    pose = torch.eye(4, dtype=torch.float64)
    view = Camera(8, 6, 9.0, 9.0, 4.0, 3.0, pose)
    pose[0, 3] = 1
    assert view.viewmat[0, 3] == 0


def test_numbers_of_other_libraries_become_those_of_python():
    k = torch.tensor([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]])
    view = Camera(np.int64(8), np.int32(6), k[0, 0], np.float32(9), Fraction(4), k[1, 2], np.eye(4))
    assert [type(value) for value in (view.width, view.height, view.fx, view.fy, view.cx, view.cy)] == [int, int, *[float] * 4]
    assert view.viewmat.dtype == torch.float64


def test_what_is_said_of_a_view_becomes_text_and_numbers_of_python(camera):
    view = replace(camera, name=Path("a/b.png"), time=np.float32(0.5), zoom=torch.tensor(2.0), index=np.int64(3))
    assert (view.name, view.time, view.zoom, view.index) == ("a/b.png", 0.5, 2.0, 3)
    assert [type(value) for value in (view.time, view.zoom, view.index)] == [float, float, int]


K = np.array([[70.0, 0, 32], [0, 72, 24], [0, 0, 1]])


def test_cameras_of_matrices_are_those_of_their_numbers(camera):
    view = Camera.of_matrices(VIEWMAT.float(), torch.tensor(K), 64, 48, name="view", split="test", time=0.5)
    assert replace(view, viewmat=VIEWMAT).viewmat.equal(camera.viewmat) and torch.allclose(view.viewmat, VIEWMAT)
    assert (view.fx, view.fy, view.cx, view.cy, view.size, view.name, view.time) == (70, 72, 32, 24, (48, 64), "view", 0.5)


@pytest.mark.parametrize("rows", [3, 4])
def test_poses_of_opengl_look_at_the_same(camera, rows):
    """A camera of NeRF at the eye, whose y is up and whose z is backward, shows a point where the camera itself does."""
    c2w = torch.linalg.inv(VIEWMAT)
    c2w[:3, 1:3] *= -1
    view = Camera.of_opengl(c2w[:rows].tolist(), K, 64, 48)
    assert project(view, (0.2, -0.3, 0.5)) == pytest.approx(project(camera, (0.2, -0.3, 0.5)))


@pytest.mark.parametrize(("make", "sentence"), [
    (lambda: Camera.of_matrices(VIEWMAT[None], K, 64, 48), r"viewmat: expected shape \[4, 4\], got \[1, 4, 4\]; make a camera of each"),
    (lambda: Camera.of_matrices(VIEWMAT, np.eye(4), 64, 48), r"K: expected shape \[3, 3\], got \[4, 4\]"),
    (lambda: Camera.of_matrices(VIEWMAT, K + np.eye(3, k=1), 64, 48), "K: a pinhole has no skew, got 1"),
    (lambda: Camera.of_matrices(VIEWMAT, K.T, 64, 48), "K: the last row must be 0 0 1, got .*; it may have to be transposed"),
    (lambda: Camera.of_opengl(None, K, 64, 48), "c2w: expected a tensor or an array"),
    (lambda: Camera.of_opengl(torch.tensor(3.0), K, 64, 48), r"c2w: expected shape \[4, 4\], got \[\]"),
    (lambda: Camera.of_opengl(np.zeros((4, 4)), K, 64, 48), "c2w: the pose .* cannot be inverted"),
])  # fmt: skip
def test_matrices_of_no_camera_are_named(make, sentence):
    with pytest.raises((SettingsError, ShapeError), match=sentence):
        make()


@pytest.mark.parametrize(("change", "sentence"), [
    (dict(time="x"), "time must be a number, got 'x'"),
    (dict(time=math.nan), "time must be finite"),
    (dict(zoom=None), "zoom must be a number, got None"),
    (dict(zoom=0), "zooms above 0, got .*, 0.0 and 1.0"),
    (dict(base_zoom=0), "zooms above 0, got .*, 1.0 and 0.0"),
    (dict(index=0.5), "index must be a whole number, got 0.5"),
    (dict(split="val"), "split must be 'train' or 'test', got 'val'"),
    (dict(name=3), "name must be a text, got 3"),
    (dict(width=8.5), "width must be a whole number, got 8.5"),
    (dict(fx="9"), "fx must be a number, got '9'"),
    (dict(cy=None), "cy must be a number"),
    (dict(width=0), "image size and focal lengths must be positive and finite, got"),
    (dict(fx=0.0), "image size and focal lengths must be positive and finite, got"),
    (dict(fy=-1.0), "image size and focal lengths must be positive and finite, got"),
    (dict(viewmat=torch.eye(4)[:3]), r"expected shape \[4, 4\], got \[3, 4\]"),
    (dict(viewmat="eye"), "expected a tensor or an array of shape"),
    (dict(viewmat=torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 5, 1]])), "the last row of viewmat must be 0 0 0 1"),
    (dict(viewmat=torch.diag(torch.tensor([1.0, 1, 0, 1]))), "viewmat cannot be inverted"),
    (dict(viewmat=torch.diag(torch.tensor([1.0, -1, 1, 1])) @ VIEWMAT.float()), r"mirrors the scene \(determinant -1\).*flip y and z together"),
    (dict(viewmat=torch.diag(torch.tensor([1.0, 1.5, 1, 1]))), "the axes of viewmat are not at right angles or not of one length"),
    (dict(viewmat=torch.tensor([[1.0, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])), "not at right angles"),
    (dict(viewmat=torch.tensor([[70.0, 0, 32, 0], [0, 72, 24, 0], [0, 0, 1, 4], [0, 0, 0, 1]])), "the intrinsics as fx, fy, cx and cy"),
])  # fmt: skip
def test_what_is_no_camera_is_named(camera, change, sentence):
    with pytest.raises((SettingsError, ShapeError), match=sentence):
        replace(camera, **change)


def test_a_scene_that_is_mirrored_with_its_cameras_is_refused(camera):
    with pytest.raises(SettingsError, match="mirrors the scene"):
        camera.moved(torch.diag(torch.tensor([1.0, 1, -1, 1])))


def test_a_pose_of_few_digits_is_taken_as_it_is(camera):
    few = (VIEWMAT * 1e3).round() / 1e3
    assert torch.equal(replace(camera, viewmat=few).viewmat, few)
    assert torch.equal(replace(camera, viewmat=VIEWMAT.half()).viewmat, VIEWMAT.half().double())


@pytest.mark.parametrize("scale", [1e-3, 0.9, 250.0])
def test_a_scale_of_the_whole_pose_is_divided_out(camera, scale):
    scaled = VIEWMAT * torch.tensor([scale, scale, scale, 1.0], dtype=torch.float64)[:, None]
    torch.testing.assert_close(replace(camera, viewmat=scaled).viewmat, VIEWMAT, rtol=0, atol=1e-8)


def test_a_digest_follows_all_that_images_depend_on(camera):
    changes = {"width": 9, "height": 9, "fx": 9.0, "fy": 9.0, "cx": 9.0, "cy": 9.0, "viewmat": torch.eye(4), "split": "train", "time": 0.25}
    changes |= {"zoom": 9.0, "base_zoom": 9.0, "index": 9}
    same = {name for name, value in changes.items() if digest_of([replace(camera, **{name: value})]) == digest_of([camera])}
    assert {field.name for field in fields(camera)} == {"name", *changes}
    assert same == set()
