"""Camera: a pinhole view. Pixel centers lie at +0.5, axes are OpenCV's (x right, y down, z forward)."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from operator import index
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError, ShapeError
from mipmap_plugin.limits import check_scale

Item = TypeVar("Item")

# Hexadecimal digits of a hash that tells one set of cameras or photographs from another.
DIGITS = 16

# How far a pose may be from a rotation. One of three decimals is off by 1e-2, and a scene may be moved by another such transform; the usual
# slips (one axis flipped, one stretched, intrinsics multiplied in) are off by far more.
POSE_TOLERANCE = 3e-2

# OpenGL's camera looks along -z with y up, OpenCV's along +z with y down.
OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64, device="cpu"))


@dataclass(frozen=True, eq=False)
class Camera:
    """One view of a pinhole camera, with the axes of OpenCV: x right, y down, z forward. The centers of pixels lie at +0.5.

    Compared and hashed by identity, so that a cache keyed by a camera is exact. Raises SettingsError or ShapeError for numbers that are no camera.

    Attributes:
        width: Of the image, px.
        height: Of the image, px.
        fx: Focal length in x, px.
        fy: Focal length in y, px.
        cx: Principal point, px from the left edge of the image, which is 0.
        cy: Principal point, px from the upper edge.
        viewmat: [4, 4] float64 on the CPU, from the world to the camera: a rotation and a translation. Given as a tensor or an array of any type,
            which is copied; a scale that all axes share is divided out, which changes no image.
        name: Of the view, as in messages and files: that of its photograph, for example.
        split: Whether the base was trained on it; views of "test" are for judging.
        time: 0..1, for moving scenes; None: the scene does not move.
        zoom: Focal length in px ÷ that of training, wherever the camera is; models with levels of detail choose their level by it.
        index: Number of the view in training, for models with one appearance embedding per view.
        base_zoom: `zoom` of the same view at the base's scale, which is not 1 through another lens than that of training.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    viewmat: Tensor
    name: str = ""
    split: Literal["train", "test"] = "train"
    time: float | None = None
    zoom: float = 1.0
    index: int | None = None
    base_zoom: float = 1.0

    def __post_init__(self) -> None:
        self._check_view()
        self._check_intrinsics()
        object.__setattr__(self, "viewmat", self._pose())

    @classmethod
    def of_matrices(cls, viewmat: Any, K: Any, width: int, height: int, **others: Any) -> Camera:
        """A camera of gsplat's matrices: `viewmat` [4, 4] from the world to the camera, and the intrinsics `K` [3, 3], in px.

        `others`: further attributes, such as `name`. Raises SettingsError, ShapeError.
        """
        (fx, skew, cx), (zero, fy, cy), last = _matrix("K", K, (3, 3)).tolist()
        if last != [0, 0, 1]:
            raise SettingsError(f"K: the last row must be 0 0 1, got {' '.join(f'{number:g}' for number in last)}; it may have to be transposed")
        if skew or zero:
            raise SettingsError(f"K: a pinhole has no skew, got {skew or zero:g} beside the focal lengths; leave it out")
        return cls(width, height, fx, fy, cx, cy, viewmat, **others)

    @classmethod
    def of_opengl(cls, c2w: Any, K: Any, width: int, height: int, **others: Any) -> Camera:
        """A camera of NeRF's and nerfstudio's poses: `c2w` [4, 4] or [3, 4] from the camera to the world, with y up and z backward.

        `K` and `others` as in `of_matrices`. Raises SettingsError, ShapeError.
        """
        rows = 3 if getattr(c2w, "ndim", 2) and hasattr(c2w, "__len__") and len(c2w) == 3 else 4
        pose = torch.eye(4, dtype=torch.float64, device="cpu")
        pose[:rows] = _matrix("c2w", c2w, (rows, 4))
        if not pose.isfinite().all() or torch.linalg.det(pose) == 0:
            raise SettingsError("c2w: the pose contains NaN or infinity, or cannot be inverted")
        return cls.of_matrices(OPENGL_TO_OPENCV @ torch.linalg.inv(pose), K, width, height, **others)

    def _check_view(self) -> None:
        """Check name, split, time, zoom and index, and convert them to types of Python. Raises SettingsError."""
        if not isinstance(self.name, (str, Path)):
            raise SettingsError(f"camera: name must be a text, got {self.name!r}")
        object.__setattr__(self, "name", str(self.name))
        if not isinstance(self.split, str) or self.split not in ("train", "test"):
            raise SettingsError(f"camera {self.name!r}: split must be 'train' or 'test', got {self.split!r}")
        kinds: dict[str, Callable[[Any], Any]] = {"time": float, "zoom": float, "base_zoom": float, "index": index}
        for name, kind in kinds.items():
            if getattr(self, name) is not None or name.endswith("zoom"):
                object.__setattr__(self, name, self._number(name, kind))
        if not math.isfinite(self.time or 0) or not all(0 < zoom < math.inf for zoom in (self.zoom, self.base_zoom)):
            raise SettingsError(f"camera {self.name!r}: time must be finite, zooms above 0, got {self.time}, {self.zoom} and {self.base_zoom}")

    def _check_intrinsics(self) -> None:
        """Check the intrinsics and the size, and convert them to types of Python. Raises SettingsError."""
        for name in ("width", "height"):
            object.__setattr__(self, name, self._number(name, index))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, self._number(name, float))
        valid = min(self.fx, self.fy) > 0 and all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy)))
        if min(self.width, self.height) < 1 or not valid:
            got = f"{self.width}x{self.height} px, fx {self.fx}, fy {self.fy}, cx {self.cx}, cy {self.cy}"
            raise SettingsError(f"camera {self.name!r}: image size and focal lengths must be positive and finite, got {got}")

    def _with(self, **changes: Any) -> Camera:
        """A copy with other intrinsics. The pose is not checked again, because a run makes thousands of such copies."""
        camera = copy.copy(self)
        for name, value in changes.items():
            object.__setattr__(camera, name, value)
        camera._check_intrinsics()
        return camera

    def _number(self, name: str, kind: Callable[[Any], Any]) -> Any:
        """An attribute as a number of Python, also from one of NumPy or torch. Raises SettingsError."""
        value = getattr(self, name)
        try:
            return kind(None if isinstance(value, str) else value)
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            what = "a whole number" if kind is index else "a number"
            raise SettingsError(f"camera {self.name!r}: {name} must be {what}, got {value!r}") from error

    def _pose(self) -> Tensor:
        """A copy of `viewmat`, so that the caller's tensor can change without changing the camera. Raises ShapeError, SettingsError."""
        pose = _matrix("viewmat", self.viewmat, (4, 4))
        *rows, last = pose.tolist()  # numbers of Python: operations on tensors so small take several times as long
        if not all(map(math.isfinite, (number for row in (*rows, last) for number in row))):
            raise SettingsError(f"camera {self.name!r}: the pose contains NaN or infinity")
        if not all(math.isclose(number, right, rel_tol=1e-5, abs_tol=1e-8) for number, right in zip(last, (0, 0, 0, 1), strict=True)):
            raise SettingsError(f"camera {self.name!r}: the last row of viewmat must be 0 0 0 1; it may have to be transposed, as that of 3DGS has")
        scale = self._rigid([row[:3] for row in rows])
        if abs(scale - 1) > POSE_TOLERANCE:  # the near plane and depths are measured in units of the world
            pose[:3] /= scale
        return pose

    def _rigid(self, axes: list[list[float]]) -> float:
        """The scale that the pose's axes [3, 3] share. Raises SettingsError for a pose that mirrors, stretches or shears."""
        (a, b, c), (d, e, f), (g, h, i) = axes
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if determinant == 0:
            raise SettingsError(f"camera {self.name!r}: viewmat cannot be inverted")
        if determinant < 0:
            slip = "as when one axis alone is flipped between OpenGL and OpenCV; flip y and z together"
            raise SettingsError(f"camera {self.name!r}: viewmat mirrors the scene (determinant {determinant:.3g}), {slip}")
        scale: float = determinant ** (1 / 3)
        off = max(abs(sum(x * y for x, y in zip(*pair, strict=True)) / scale**2 - (pair[0] is pair[1])) for pair in product(axes, axes))
        if not off <= POSE_TOLERANCE:
            advice = "give a rotation and a translation, and the intrinsics as fx, fy, cx and cy"
            wrong = f"the axes of viewmat are not at right angles or not of one length (off by {off:.2g})"
            raise SettingsError(f"camera {self.name!r}: {wrong}; {advice}")
        return scale

    @cached_property
    def center(self) -> Tensor:
        """The camera's position in the world, [3] float64."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        center: Tensor = -torch.linalg.solve(rotation, translation)
        return center

    def to_camera(self, points: Tensor) -> Tensor:
        """Transform world points [N, 3] to camera space [N, 3]: x right, y down, z forward.

        The camera's position is subtracted before the rotation: far from the world's origin, the rounding error of
        rotation · point + translation exceeds a pixel.
        """
        return (points - self.center.to(points)) @ self.viewmat[:3, :3].to(points).T

    def in_picture(self, points: Tensor, near: float = 0.0) -> Tensor:
        """Which points [N, 3] in camera space lie inside the picture, and farther than `near` (world units): [N] bool."""
        x, y, z = points.unbind(-1)
        u, v = self.fx * x / z + self.cx, self.fy * y / z + self.cy
        inside: Tensor = (z > near) & (u > 0) & (u < self.width) & (v > 0) & (v < self.height)
        return inside

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), as images are indexed."""
        return self.height, self.width

    def zoomed(self, factor: float) -> Camera:
        """The same view sampled `factor` times more densely per axis.

        Width and height are rounded, and each focal length is scaled by its axis' actual ratio, which keeps the field of
        view exactly. Raises SettingsError if `factor` is out of range.
        """
        factor = check_scale(factor)
        return self._sampled(max(1, round(self.width * factor)), max(1, round(self.height * factor)), self.zoom * factor)

    def resized(self, width: int, height: int) -> Camera:
        """The same field of view at `width` x `height` px. `zoom`, and so the model's level of detail, does not change."""
        return self._sampled(width, height, self.zoom)

    def _sampled(self, width: int, height: int, zoom: float) -> Camera:
        """`resized`, with another `zoom`."""
        x, y = width / self.width, height / self.height
        return self._with(width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, zoom=zoom)

    def window(self, width: int, height: int) -> Camera:
        """The view's central crop of at most `width` x `height` px."""
        width, height = min(width, self.width), min(height, self.height)
        left, top = (self.width - width) // 2, (self.height - height) // 2
        return self._with(width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def moved(self, similarity: Tensor) -> Camera:
        """The same view after the whole scene, this camera included, was transformed by `similarity` [4, 4] (rotation, scale, translation)."""
        linear = similarity[:3, :3].to("cpu", torch.float64)
        rotation = linear / torch.linalg.det(linear).abs().pow(1 / 3)
        center = linear @ self.center + similarity[:3, 3].to("cpu", torch.float64)
        return replace(self, viewmat=viewmat_of(rotation @ self.viewmat[:3, :3].T, center))

    def looking_from(self, viewmat: Tensor, name: str) -> Camera:
        """The same intrinsics at another pose."""
        return replace(self, viewmat=viewmat, name=name)


def _matrix(name: str, given: Any, shape: tuple[int, int]) -> Tensor:
    """A copy of a tensor or an array as float64 on the CPU. Raises ShapeError."""
    given = given.detach() if isinstance(given, Tensor) else given
    try:
        matrix = torch.as_tensor(given, dtype=torch.float64, device="cpu").to_dense().clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(f"{name}: expected a tensor or an array of shape {list(shape)}, got {type(given).__name__}") from error
    if tuple(matrix.shape) != shape:
        several = "; make a camera of each" if matrix.dim() > 2 else ""
        raise ShapeError(f"{name}: expected shape {list(shape)}, got {list(matrix.shape)}{several}")
    return matrix


# A camera of one pixel, for what does not depend on it.
ONE_PIXEL = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(4, device="cpu"))


def viewmat_of(rotation: Tensor, center: Tensor) -> Tensor:
    """World to camera [4, 4] float64 from a camera-to-world rotation [3, 3] and the eye [3]."""
    viewmat = torch.eye(4, dtype=torch.float64, device="cpu")
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ center
    return viewmat


def evenly(views: Sequence[Item], most: int | None) -> list[Item]:
    """At most `most` views, evenly spaced in their order; all of them if `most` is None."""
    return [views[i * len(views) // most] for i in range(most)] if most is not None and len(views) > most else list(views)


def every_nth(views: Sequence[Item], most: int) -> Sequence[Item]:
    """Every n-th view, starting with the first, for the smallest n that gives at most `most` views."""
    return views[:: -(-len(views) // most)]


def checked(cameras: Any, *, some: bool = False) -> list[Camera]:
    """Cameras as a list, of at least one if there have to be `some`. Raises SettingsError for anything else."""
    found = list(cameras) if isinstance(cameras, Iterable) and getattr(cameras, "ndim", True) and not isinstance(cameras, (str, bytes)) else [cameras]
    if wrong := [each for each in found if not isinstance(each, Camera)]:
        of_a_file = isinstance(wrong[0], (str, Path))
        advice = "those of a file are load_scene(path).cameras" if of_a_file else "Camera.of_matrices and Camera.of_opengl make them of arrays"
        raise SettingsError(f"cameras must be of the type mipmap_plugin.Camera, got {type(wrong[0]).__name__}; {advice}")
    if some and not found:
        raise SettingsError("cameras: there are none in what was given; leave it out for those of the checkpoint or, without any, an orbit")
    return found


def of_base_scale(cameras: Any, *, some: bool = False) -> list[Camera]:
    """The cameras that a base is given. Raises as `checked`.

    Those that an adapted model is seen by are `zoomed`: if it is a base itself, they are of the base scale.
    """
    return [camera if camera.zoom == camera.base_zoom else replace(camera, zoom=camera.base_zoom) for camera in checked(cameras, some=some)]


def digest_of(cameras: Sequence[Camera]) -> str:
    """A hash of everything that images depend on, hexadecimal; names are left out."""
    digest = hashlib.sha256()
    for view in cameras:
        facts = (view.width, view.height, view.fx, view.fy, view.cx, view.cy, view.split, view.time, view.zoom, view.base_zoom, view.index)
        digest.update(repr(facts).encode() + view.viewmat.numpy().tobytes())
    return digest.hexdigest()[:DIGITS]
