"""Lens distortion: the pinhole camera of an undistorted image, and undistortion, both by pycolmap."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError, brief, install

if TYPE_CHECKING:
    import pycolmap

INSTALL = install("colmap")


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model with its parameters, for an image of this size in px."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def at(self, size: tuple[int, int]) -> Lens:
        """The same lens for an image of another `size` (width, height) px."""
        camera = self._camera()
        camera.rescale(*size)
        return replace(self, width=camera.width, height=camera.height, params=tuple(camera.params))

    def straightened(self, camera: Camera) -> Camera:
        """`camera` with the intrinsics and the size of the undistorted image. Raises SceneError if the lens cannot be undistorted."""
        import pycolmap

        try:
            flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), self._camera())
        except Exception as error:  # what pycolmap's C++ raises
            raise SceneError(f"camera {camera.name!r}: its lens ({self.model}) cannot be undistorted ({brief(error)}); leave it out") from error
        fx, fy, cx, cy = map(float, flat.params)
        return replace(camera, width=flat.width, height=flat.height, fx=fx, fy=fy, cx=cx, cy=cy)

    def undistorted(self, image: Tensor) -> Tensor:
        """Undistort `image` [H, W, 3], float32 of 8-bit values, that was taken through this lens. Raises SceneError without pycolmap."""
        try:
            import pycolmap
        except ImportError as error:
            raise SceneError(f"a photograph was taken through a lens that bends ({self.model}), which pycolmap undistorts; {INSTALL}") from error
        lens = self.at((image.shape[1], image.shape[0]))
        bitmap = pycolmap.Bitmap.from_array((image * 255).round().to(torch.uint8).numpy())
        flat, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, lens._camera())
        return torch.from_numpy(flat.to_array()).float() / 255

    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))


def note(lenses: Collection[Lens]) -> str:
    """A note that the images of cameras with these lenses are undistorted."""
    models = ", ".join(sorted({lens.model for lens in lenses}))
    if len(lenses) == 1:
        return f"1 camera has a lens that bends ({models}): it is taken as a pinhole, and its photograph is undistorted to be looked at"
    bent = f"{len(lenses)} cameras have lenses that bend ({models})"
    return f"{bent}: they are taken as pinholes, and their photographs are undistorted to be looked at"


def can_undistort() -> bool:
    """Whether pycolmap is installed."""
    try:
        import pycolmap  # noqa: F401
    except ImportError:
        return False
    return True
