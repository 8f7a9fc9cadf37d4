"""How a real photograph becomes the truth at another scale. Two good filters differ by 40 dB, so every table names its protocol.

P1, of Mip-Splatting on NeRF-Synthetic: 2 x 2 means in float, cut off to 8 bits. P3, of Mipmap-GS and of Mip-Splatting on mip-NeRF 360: put
on the background and cut off to 8 bits as INRIA's reader does, then Pillow's bicubic on those bytes. P4: the files of images_2, images_4, ...
There is no P2: Mip-Splatting's protocol on mip-NeRF 360 makes the same truth of a JPEG as P3 does, byte for byte.

Under each of them the images that are judged are rounded to 8 bits: the authors' render.py writes PNG files by torchvision's `save_image`, which
rounds, and their metrics.py reads those.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol as TypingProtocol

from torch import Tensor

from mipmap_plugin.adaptation.target.photographs import at_density_of
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.images import image_size, pillow_bicubic, read_image
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.scenes import Scene

# COLMAP scenes come with their photographs made smaller beforehand: images_2, images_4, images_8 beside images.
READY_MADE = re.compile(r"images(_\d+)?$")

# px: the half that is rounded off an eighth is four of the whole. A copy that differs by as much is resized.
ROUNDING = 4


@dataclass(frozen=True)
class Protocol:
    """One way to make the truth and to judge by it, as the papers do it."""

    name: str
    resize: str | None  # of the photograph, already composited on the background; None: files of the wanted size are read
    truncate: bool = False  # P1 writes its levels with truncation to 8 bits, the others with rounding
    eight_bit: bool = True  # images are judged as the PNG files that they would be saved as

    @property
    def shrink_by(self) -> str:
        """The filter that makes the truth. Of P4 it is ImageMagick's, which shrinks opaque images by Lanczos unless told otherwise."""
        return self.resize or "lanczos"

    def shrunk(self, photograph: Tensor, size: tuple[int, int]) -> Tensor:
        """The truth [*size, 3] of a photograph [H, W, 3] on 8 bits."""
        if self.resize is None or self.resize == "pil-bicubic":
            return pillow_bicubic(photograph, size)
        return self.quantized(resize(photograph, size, self.resize))

    def quantized(self, image: Tensor) -> Tensor:
        """An image of the truth on 8 bits."""
        steps = image.clamp(0, 1) * 255
        return (steps.floor() if self.truncate else steps.round()) / 255

    def judged(self, image: Tensor) -> Tensor:
        """An image [h, w, 3] as it is compared with the truth."""
        return (image.clamp(0, 1) * 255).round() / 255 if self.eight_bit else image


PROTOCOLS: dict[str, Protocol] = {
    "P1": Protocol("P1", "box", truncate=True),
    "P3": Protocol("P3", "pil-bicubic"),
    "P4": Protocol("P4", None),
}


class Judged(TypingProtocol):
    """A view with a truth to be judged by."""

    camera: Camera  # of the base scale

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale."""


@dataclass(eq=False)
class TestView:
    """One photograph to be judged by, and its camera at the base scale."""

    camera: Camera
    photograph: Tensor  # [H, W, 3], full resolution
    file: Path
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bent: bool = False  # the file had to be undistorted

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale. Raises SettingsError where there is no photograph as large."""
        size = self.camera.zoomed(scale).size
        if protocol.resize is None and self.bent:
            raise SettingsError(f"P4 wants ready-made copies, but those of {self.file.name} were taken through a lens that bends; evaluate by P3")
        if protocol.resize is None:
            return protocol.shrunk(read_image(ready_made(self.file, size), self.background), size)
        if size[0] > self.photograph.shape[0]:
            has = f"{self.photograph.shape[1]} x {self.photograph.shape[0]}"
            raise SettingsError(f"x{scale:g} asks for {size[1]} x {size[0]} px, but the photographs have only {has}; evaluate a smaller scale")
        return protocol.shrunk(self.photograph, size)


def ready_made(photograph: Path, size: tuple[int, int]) -> Path:
    """The copy of a COLMAP scene's photograph that has `size` (height, width), but for rounding: of images, images_2, images_4, ...

    Raises SettingsError when there is none.
    """
    folder = next((parent for parent in photograph.parents if READY_MADE.match(parent.name)), None)
    others = [] if folder is None else sorted(each for each in folder.parent.iterdir() if READY_MADE.match(each.name))
    copies = [other / photograph.relative_to(folder) for other in others if folder]
    sizes = {copy: image_size(copy) for copy in copies if copy.is_file()}
    for copy, (width, height) in sizes.items():
        if max(abs(height - size[0]), abs(width - size[1])) <= ROUNDING:
            return copy
    there = ", ".join(f"{width} x {height}" for width, height in sizes.values()) or "none"
    wanted = f"{photograph.name} at {size[1]} x {size[0]} px in a folder images_2, images_4, ... of its scene"
    raise SettingsError(f"P4 wants {wanted}, but there is {there}; evaluate a scale that has one, or by P3")


def test_views(scene: Scene, base: Camera, background: tuple[float, float, float]) -> list[TestView]:
    """The scene's test photographs (all, if it names none as test) with their cameras brought to the pixel density of `base`."""
    cameras = [c for c in scene.cameras if c in scene.images]
    cameras = [c for c in cameras if c.split == "test"] or cameras
    if not cameras:
        raise SettingsError(f"{scene.source}: there are no photographs to judge by")
    files = [scene.images[camera] for camera in cameras]
    held = [(at_density_of(camera, base), scene.image(camera, background)) for camera in cameras]
    return [TestView(*each, file, background, file in scene.lenses) for each, file in zip(held, files, strict=True)]


def not_exposed(model: SplatModel) -> list[str]:
    """That photographs have exposures of their own, in a sentence, where the model knows of them; none is applied in judging."""
    exposures = model.traits.exposures
    return [f"{exposures.summary()}, which is not applied here: part of every difference from a photograph is exposure"] if exposures.changed else []
