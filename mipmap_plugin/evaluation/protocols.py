"""Protocols: how a photograph becomes the truth at another scale. Two good filters differ by 40 dB, so every table names its protocol.

P1, of Mip-Splatting on NeRF-Synthetic: 2 x 2 means in float, truncated to 8 bits. Where the photograph has transparency, these are means of its
colors as stored and of alpha, each by itself; the result is composited on the background afterwards, and truncated again
(convert_blender_data.py, then readMultiScale of scene/dataset_readers.py). P3, of Mipmap-GS, and of Mip-Splatting on mip-NeRF 360:
composited on the background and truncated to 8 bits as INRIA's reader does, then Pillow's bicubic on those bytes. P4: the files of
images_2, images_4, ... There is no P2: Mip-Splatting's protocol on mip-NeRF 360 makes the same truth of a JPEG as P3, byte for byte.

In all of them the evaluated images are rounded to 8 bits: the authors' render.py writes PNG files with torchvision's `save_image`, which
rounds, and their metrics.py reads those files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol as TypingProtocol

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.formats.images import pillow_bicubic


@dataclass(frozen=True)
class Protocol:
    """One way to make the truth and to compare with it, as in the papers."""

    name: str
    resize: str | None  # filter for the photograph, composited on the background before unless `straight`; None: files of the required size are read
    truncate: bool = False  # P1 truncates its levels to 8 bits, the others round
    straight: bool = False  # transparent photographs are composited after they are resized, not before
    eight_bit: bool = True  # evaluated images are rounded as in PNG files

    @property
    def shrink_by(self) -> str:
        """The filter that makes the truth. For P4 it is ImageMagick's default for opaque images, Lanczos."""
        return self.resize or "lanczos"

    def shrunk(self, photograph: Tensor, size: tuple[int, int]) -> Tensor:
        """The truth [*size, 3] of a photograph [H, W, 3], at 8 bits."""
        if self.resize is None or self.resize == "pil-bicubic":
            return pillow_bicubic(photograph, size)
        return self.quantized(resize(photograph, size, self.resize))

    def quantized(self, image: Tensor) -> Tensor:
        """An image of the truth at 8 bits."""
        steps = image.clamp(0, 1) * 255
        return (steps.floor() if self.truncate else steps.round()) / 255

    def as_saved(self, image: Tensor) -> Tensor:
        """An image [h, w, 3] as it would be saved and compared with the truth."""
        return (image.clamp(0, 1) * 255).round() / 255 if self.eight_bit else image


PROTOCOLS: dict[str, Protocol] = {
    "P1": Protocol("P1", "box", truncate=True, straight=True),
    "P3": Protocol("P3", "pil-bicubic"),
    "P4": Protocol("P4", None),
}


class TruthView(TypingProtocol):
    """A view with a truth to compare with."""

    camera: Camera  # at the base scale

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale."""
