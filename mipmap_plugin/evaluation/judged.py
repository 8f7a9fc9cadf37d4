"""The photographs of a scene that are compared with: which of its views are judged, and how each becomes a truth by a protocol."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from mipmap_plugin.adaptation.target.photographs import at_density_of
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError, plural, some_of
from mipmap_plugin.evaluation.measure import views_seen
from mipmap_plugin.evaluation.photographs import kept_photographs
from mipmap_plugin.evaluation.protocols import Protocol
from mipmap_plugin.formats.images import averaged_straight, has_alpha, image_size, read_image, read_straight
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import Scene
from mipmap_plugin.wrap import Wrapped

# COLMAP scenes include smaller copies of their photographs: images_2, images_4, images_8 beside images.
READY_MADE = re.compile(r"images(_\d+)?$")

# px: a copy of an eighth of the size is rounded by up to half a pixel, which is four of the original. A copy whose size differs by at most
# this is resized.
ROUNDING = 4

# Base pixels by which a view may be larger than its photograph shows. A training rounds the size of its pictures, by half a pixel, and a view of
# another field has its density from one of these (`at_density_of`): up to a whole pixel for twice the size, and half of one for its own rounding.
# Mip-NeRF 360's bicycle of 4946 x 3286 px, trained at an eighth, is 618 x 411 px, of which x8 makes 4944 x 3288.
ROUNDED_UP = 1.5


@dataclass(eq=False)
class JudgedView:
    """A photograph that is compared with, and its camera at the base scale."""

    camera: Camera
    source: Tensor | Callable[[], Tensor]  # the photograph, or what returns it
    file: Path
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distorted: bool = False  # the file had to be undistorted
    transparent: bool = False  # the file has an alpha channel

    @property
    def photograph(self) -> Tensor:
        """[H, W, 3], full resolution; unpacked or read anew at each call."""
        return self.source() if callable(self.source) else self.source

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale. Raises SettingsError if the photograph is smaller."""
        size = self.camera.zoomed(scale).size
        if protocol.resize is None and self.distorted:
            raise SettingsError(f"P4 reads ready-made copies, but those of {self.file.name} have lens distortion; evaluate by P3")
        if protocol.resize is None:
            return protocol.shrunk(read_image(ready_made(self.file, size), self.background), size)
        photograph = self.photograph
        if any(side - shown / scale > ROUNDED_UP for side, shown in zip(self.camera.size, photograph.shape, strict=False)):
            original = f"{photograph.shape[1]} x {photograph.shape[0]}"
            raise SettingsError(f"x{scale:g} needs {size[1]} x {size[0]} px, but the photographs have only {original}; evaluate a smaller scale")
        if protocol.resize == "box" and any(pixels % new for pixels, new in zip(photograph.shape, size, strict=False)):
            blocks = f"{photograph.shape[1]} x {photograph.shape[0]} px is not a whole multiple of {size[1]} x {size[0]} px"
            raise SettingsError(f"{protocol.name} takes means of whole blocks of pixels, and {blocks}; evaluate by P3, or another scale")
        if protocol.straight and self.transparent and not self.distorted and (rgba := read_straight(self.file)) is not None:
            return averaged_straight(rgba, size, self.background)
        return protocol.shrunk(photograph, size)


def ready_made(photograph: Path, size: tuple[int, int]) -> Path:
    """The copy of a COLMAP scene's photograph of `size` (height, width), up to rounding: from images, images_2, images_4, ...

    Raises SettingsError if there is none.
    """
    folder = next((parent for parent in photograph.parents if READY_MADE.match(parent.name)), None)
    folders = [] if folder is None else sorted(path for path in folder.parent.iterdir() if READY_MADE.match(path.name))
    copies = [path / photograph.relative_to(folder) for path in folders if folder]
    sizes = {copy: image_size(copy) for copy in copies if copy.is_file()}
    for copy, (width, height) in sizes.items():
        if max(abs(height - size[0]), abs(width - size[1])) <= ROUNDING:
            return copy
    available = ", ".join(f"{width} x {height}" for width, height in sizes.values()) or "none"
    required = f"{photograph.name} at {size[1]} x {size[0]} px in a folder images_2, images_4, ... of its scene"
    raise SettingsError(f"P4 needs {required}, but there is {available}; evaluate a scale that has one, or by P3")


def photographed_views(model: Wrapped, scene: Scene) -> list[JudgedView]:
    """`judged_views` of a placed scene (`Wrapped.place`). Raises SettingsError, too, if the model has no cameras."""
    if not model.cameras:
        raise SettingsError("the checkpoint has no cameras, so its base scale is not known; give its model folder, or its cameras (--cameras)")
    return judged_views(scene, model.cameras, model.background)


def judged_views(scene: Scene, base: Sequence[Camera], background: tuple[float, float, float]) -> list[JudgedView]:
    """The photographs of a scene that are marked as test, with their cameras at the pixel density of the cameras of the base.

    If none is, those that the base holds out, by their poses, and else all (`not_held_out` says so). Raises SettingsError without photographs,
    SceneError for a damaged one.
    """
    cameras = _judged(scene, base)
    if not cameras:
        raise SettingsError(f"{scene.source}: there are no photographs to compare with")
    dense = at_density_of([*map(scene.as_photographed, cameras)], base)
    views = zip(dense, kept_photographs(scene, cameras, background), (scene.images[c] for c in cameras), strict=True)
    return [JudgedView(camera, photograph, file, background, file in scene.lenses, has_alpha(file)) for camera, photograph, file in views]


def not_held_out(model: Wrapped, scene: Scene) -> list[str]:
    """A note, if a placed scene (`Wrapped.place`) marks no photograph as test, or the base was trained on those that are."""
    views, judged, options = len(_photographed(scene)), _judged(scene, model.cameras), read_options(model.model.folder)[0]
    seen = len(views_seen(judged, _split(model.cameras, "train")))
    if not _split(judged, "test"):
        unmarked = f"{scene.source.name}: no photograph is marked as for testing, so of {plural(views, 'photograph')}"
        if len(judged) < views:
            return [f"{unmarked} those are taken that the checkpoint holds out: {len(judged)}"]
        trained = f"all are taken: {seen} {'has a pose' if seen == 1 else 'have poses'} that the checkpoint counts as its training's"
        return [f"{unmarked} {trained}, and the dB of every row, the base's included, are higher than on other views"] if seen else []
    of_them = some_of(seen, len(judged), "photographed test view")
    if seen and options.get("eval") and options.get("train_test_exp"):
        return [f"cfg_args says --train_test_exp: the checkpoint was trained on half of each of {of_them}"]
    if seen and options.get("eval") is False:
        trained = f"the checkpoint was trained on {of_them}"
        return [f"cfg_args says no --eval: {trained}, so that no row, the base's included, is held out from its training"]
    if seen and options.get("eval") and not options.get("lod"):  # whose test views are others
        return [f"the checkpoint was trained on {of_them} of {scene.source.name}, whose test views are not its own"]
    return []


def _judged(scene: Scene, base: Sequence[Camera]) -> list[Camera]:
    """The cameras of the photographs that are judged (`judged_views`)."""
    cameras = _photographed(scene)
    return _split(cameras, "test") or views_seen(cameras, _split(base, "test")) or cameras


def _photographed(scene: Scene) -> list[Camera]:
    return [camera for camera in scene.cameras if camera in scene.images]


def _split(cameras: Sequence[Camera], split: str) -> list[Camera]:
    return [camera for camera in cameras if camera.split == split]


def not_exposed(model: SplatModel) -> list[str]:
    """A note, if photographs have exposures that the model knows of, that these are not applied in the evaluation."""
    exposures = model.traits.exposures
    return [f"{exposures.summary()}, which is not applied here: part of every difference from a photograph is exposure"] if exposures.changed else []
