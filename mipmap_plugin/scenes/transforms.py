"""transforms_{train,test}.json of NeRF-Synthetic, and the transforms.json of instant-ngp and nerfstudio."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import OPENGL_TO_OPENCV, Camera
from mipmap_plugin.errors import SceneError, plural
from mipmap_plugin.formats.images import image_size
from mipmap_plugin.formats.json_file import ROTATION_TOLERANCE, numbers, pixels, positive, present, read_json, rotation
from mipmap_plugin.scenes.base import ABSENT, MASKED, Scene, note_on_shapes, other_shape
from mipmap_plugin.scenes.cameras_json import principal_point
from mipmap_plugin.scenes.intrinsics import DISTORTION, overruled, values_of
from mipmap_plugin.scenes.lenses import INSTALL, Lens, can_undistort, note
from mipmap_plugin.scenes.listed_images import listed_images, place_of, stem_of
from mipmap_plugin.scenes.training_options import FOUR_D, numbers_views, trained_size

PERSPECTIVE_MODELS = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")

# The rotation that ns-process-data applied to COLMAP's world before its files recorded it (data/dataparsers/nerfstudio_dataparser.py).
USUAL_TURN = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]

# Radians: a smaller angle of view is longer than any lens, and its tangent may underflow.
MIN_ANGLE = 1e-9

View = tuple[Camera, Path | None, Lens | None]  # a camera, its image if there is one, and its lens if that has to be undistorted


def read_transforms(path: str | Path, cfg: dict[str, Any] | None = None) -> Scene:
    """The scene of a folder with transforms files, or of one such file.

    `cfg` is the checkpoint's cfg_args, whose `resolution` determines the training size; the principal point is moved to the center, as projects
    with cfg_args do. Without it the size is that of the images.
    `transforms_test.json` is the test split, or `transforms_val.json` if there is none; in a file that lists the frames of training
    (`train_filenames`), as nerfstudio's may, all others are. A frame whose image is missing (`listed_images`) stays a
    view if the file states its size (`w`, `h`), and is left out otherwise; `notes` count both.

    Raises:
        SceneError: no transforms file, no usable frame, a lens that is not perspective, an entry that cannot be read, or an invalid `resolution`.
    """
    path = Path(path)
    views: list[View] = []
    places: list[PurePosixPath] = []
    notes: list[str] = []
    files = transforms_files(path)
    for file, split in files:
        found, listed, said = _read_file(file, split)
        views, places, notes = views + found, places + listed, notes + said
    if not views:
        raise SceneError(f"{path}: none of the listed images is there, and the sizes are unknown; add the images, or w and h to the file")
    if cfg:
        views = _as_trained(views, cfg)
    cameras, distorted = tuple(camera for camera, _, _ in views), [lens for _, _, lens in views if lens]
    images = {camera: image for camera, image, _ in views if image}
    lenses = {image: lens for _, image, lens in views if image and lens}
    notes += [note(distorted) + ("" if can_undistort() else f"; pycolmap does that: {INSTALL}")] if distorted else []
    applied, applied_scale = _applied(files[0][0])
    number_of = {place: number for number, place in enumerate(sorted(places))}
    numbers = tuple(number_of[place] for place in places)
    return Scene(cameras, images, path, notes, applied=applied, applied_scale=applied_scale, lenses=lenses, numbers=numbers)


def transforms_files(path: Path) -> list[tuple[Path, Literal["train", "test"]]]:
    """The transforms files at `path`, each with its split. Raises SceneError if there is none."""
    if path.is_file():
        return [(path, "test" if path.stem.endswith(("_test", "_val")) else "train")]
    train = _first_file(path, "transforms_train.json", "transforms.json")
    test = _first_file(path, "transforms_test.json", "transforms_val.json")
    others = [] if train or test else sorted(path.glob("transforms*.json"))  # such as transforms_undistorted.json of ScanNet++
    if len(others) > 1:
        raise SceneError(f"{path}: holds {', '.join(file.name for file in others)}; give one of these files")
    if not train and not test and not others:
        raise SceneError(f"{path}: holds no transforms_train.json, transforms_test.json or transforms.json; give the folder that does")
    return [*((file, "train") for file in train + others), *((file, "test") for file in test)]


def viewmat_from_opengl(camera_to_world: Tensor) -> Tensor:
    """World to camera [4, 4], OpenCV axes, from a camera-to-world pose [4, 4] with OpenGL axes.

    In graphdeco-inria before commit 0f125cb, and in its descendants, the x of the translation has the opposite sign. That is
    the same camera only if this x is 0, as in all of NeRF-Synthetic; this is the exact inverse.
    """
    world_to_camera: Tensor = torch.linalg.inv(camera_to_world @ OPENGL_TO_OPENCV)
    return world_to_camera


def _first_file(folder: Path, *names: str) -> list[Path]:
    return [folder / name for name in names if (folder / name).is_file()][:1]


def _as_trained(views: list[View], cfg: dict[str, Any]) -> list[View]:
    """The views as projects with cfg_args take them: at their training size, with the principal point in the middle.

    4DGaussians takes no notice of `resolution`, and divides all times by the last one.
    """
    is_4dgs = FOUR_D in cfg
    last = (max((camera.time or 0.0 for camera, _, _ in views)) if is_4dgs else 0.0) or 1.0
    trained, numbers = list[View](), count()
    for camera, image, lens in views:
        size = trained_size(camera.width, camera.height, {"resolution": 1 if is_4dgs else cfg.get("resolution", 1)})
        time = None if camera.time is None else camera.time / last
        index = next(numbers) if numbers_views(cfg, camera.split) else None
        trained.append((replace(camera.resized(*size), cx=size[0] / 2, cy=size[1] / 2, time=time, index=index), image, lens))
    return trained


def _are(count: int, noun: str) -> str:
    return f"{plural(count, noun)} {'is' if count == 1 else 'are'}"


def _read_file(file: Path, split: Literal["train", "test"]) -> tuple[list[View], list[PurePosixPath], list[str]]:
    """The usable views, the listed place of each one's image, and notes on images that are missing and intrinsics that do not count."""
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        lacks = "has no list of 'frames'" if frames != [] else "lists no frames"
        raise SceneError(f"{file}: {lacks}; give a NeRF-Synthetic, instant-ngp or nerfstudio transforms file")
    views: list[View] = []
    places: list[PurePosixPath] = []
    shapes: list[str] = []
    absent = passed_over = 0
    names, tests = data.get("train_filenames"), data.get("test_frames")  # of nerfstudio, and of ScanNet++
    trained = {place_of(str(name)) for name in names} if isinstance(names, list) else None
    every = [*frames, *(tests if isinstance(tests, list) else [])]
    images, elsewhere, copies = listed_images(file, [_listed(frame, f"{file}, frame {index}") for index, frame in enumerate(every)])
    for index, (frame, image) in enumerate(zip(every, images, strict=True)):
        where, listed = f"{file}, frame {index}", str(frame["file_path"])
        values = values_of(data, frame)
        passed_over += overruled(data, frame)
        stated = _stated_size(values, where)
        image = None if copies and not stated else image  # a copy does not tell the size that the focal length is of
        absent += image is None
        actual = stated if stated and (copies or not image) else image and image_size(image)  # the image itself may have been shrunk since
        if not actual:
            continue
        name = image.stem if image else stem_of(listed)
        where = f"{where} ({name})"
        if trained is not None or index >= len(frames):
            split = "train" if trained is not None and place_of(listed) in trained else "test"
        if stated and image:
            shapes.append(other_shape(stated, image, where))
        model = _lens_model(values, where)
        camera = _camera(values, stated or actual, name, split, where).resized(*actual)
        lens = _lens(values, model, camera, where)
        views.append((lens.straightened(camera) if lens and can_undistort() else camera, image, lens))
        places.append(place_of(listed))
    unsized = absent - sum(image is None for _, image, _ in views)
    left_out = f"; {_are(unsized, 'camera')} left out because the file has no w and h" if unsized else ""
    notes = [f"{file.name}: {_are(absent, 'listed image')} {ABSENT}{left_out}"] if absent else []
    notes += note_on_shapes(shapes)
    notes += [elsewhere] if elsewhere else []
    if passed_over:
        notes.append(f"{file.name}: the intrinsics of {passed_over} of its frames are passed over for those of the file, as in nerfstudio")
    if masked := sum(bool(frame.get("mask_path")) for frame in every):
        notes.append(f"{file.name}: frames that are {MASKED} (mask_path): {masked}; masks are not read, so that what they hide counts like all else")
    return views, places, notes


def _listed(frame: Any, where: str) -> str:
    """The listed place of a frame's image. Raises SceneError for what is no frame."""
    if not isinstance(frame, dict):
        raise SceneError(f"{where}: is not a camera; export the file again")
    return str(present(frame, "file_path", where))


def _applied(file: Path) -> tuple[Tensor | None, float]:
    """nerfstudio's `applied_transform` [4, 4] and its scale, which were applied to COLMAP's world already; old files record no transform."""
    data, transform = read_json(file), None
    if "applied_transform" in data:
        transform = _pose(data["applied_transform"], f"{file}, applied_transform")
    elif file.name == "transforms.json" and (file.parent / "colmap/sparse/0").exists():
        transform = _pose(USUAL_TURN, str(file))
    return transform, positive(data.get("applied_scale", 1.0), f"{file}, applied_scale")


def _stated_size(values: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    if not {"w", "h"} <= values.keys():
        return None
    return pixels(values["w"], f"{where}, w"), pixels(values["h"], f"{where}, h")


def _camera(values: Mapping[str, Any], size: tuple[int, int], name: str, split: Literal["train", "test"], where: str) -> Camera:
    """The camera at `size` (width, height) px, to which the intrinsics refer."""
    width, height = size
    fx = _focal(values, "x", width, where)
    if fx is None:
        raise SceneError(f"{where}: has neither 'fl_x' nor 'camera_angle_x'; add one to the file")
    fy = _focal(values, "y", height, where) or fx
    cx, cy = principal_point(values, size, where)
    time = numbers(values["time"], (), f"{where}, time").item() if values.get("time") is not None else None
    pose = _pose(present(values, "transform_matrix", where), f"{where}, transform_matrix", of_camera=True)
    return Camera(width, height, fx, fy, cx, cy, viewmat_from_opengl(pose), name, split, time)


def _pose(value: Any, where: str, *, of_camera: bool = False) -> Tensor:
    """A rotation and a translation as [4, 4] float64. Raises SceneError, beginning with `where`.

    `of_camera`: a scale of its axes is left out. In a modeling program a camera has a size, which no picture shows.
    """
    upper = numbers(value[:3] if isinstance(value, list) else value, (3, 4), where)  # the last row is 0 0 0 1, and some files leave it out
    determinant = torch.linalg.det(upper[:, :3]).item()
    if of_camera and determinant > 0 and abs(determinant - 1) > ROTATION_TOLERANCE:
        upper[:, :3] /= determinant ** (1 / 3)
    rotation(upper[:, :3].tolist(), where)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = upper
    return pose


def _focal(values: Mapping[str, Any], axis: str, size: int, where: str) -> float | None:
    """The focal length in px from `fl_x` or `camera_angle_x` (radians), or those of y; None if neither is given."""
    if f"fl_{axis}" in values:
        return positive(values[f"fl_{axis}"], f"{where}, fl_{axis}")
    if f"camera_angle_{axis}" not in values:
        return None
    angle = positive(values[f"camera_angle_{axis}"], f"{where}, camera_angle_{axis}")
    if not MIN_ANGLE < angle < math.pi:
        raise SceneError(f"{where}, camera_angle_{axis}: is {angle:g} but must be above 0 and below pi; give it in radians")
    return size / (2 * math.tan(angle / 2))


def _lens_model(values: Mapping[str, Any], where: str) -> str:
    """The name of the lens model. Raises SceneError if it is not perspective; such files state no focal length either."""
    model = str(values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")).upper()
    if model not in (*PERSPECTIVE_MODELS, "OPENCV_FISHEYE"):
        raise SceneError(f"{where}: has a lens that is not perspective ({model}); resample its images to a pinhole first")
    return model


def _lens(values: Mapping[str, Any], model: str, camera: Camera, where: str) -> Lens | None:
    """The lens of a `camera` with distortion, with OpenCV's parameters; None for a pinhole."""
    if listed := values.get("distortion_params"):  # nerfstudio's, which prefers them
        values = dict(zip(DISTORTION, numbers(listed, (len(DISTORTION),), f"{where}, distortion_params").tolist(), strict=True))
    k1, k2, k3, k4, p1, p2 = (numbers(values.get(key) or 0.0, (), f"{where}, {key}").item() for key in DISTORTION)
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    if model == "OPENCV_FISHEYE":
        return Lens(model, camera.width, camera.height, (*pinhole, k1, k2, k3, k4))
    if not any((k1, k2, k3, p1, p2)):
        return None
    # nerfstudio and instant-ngp take a fourth radial term for fisheyes only.
    params = (*pinhole, k1, k2, p1, p2, *((k3, 0.0, 0.0, 0.0) if k3 else ()))
    return Lens("FULL_OPENCV" if k3 else "OPENCV", camera.width, camera.height, params)
