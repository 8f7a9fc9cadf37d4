"""How a real photograph becomes the truth at another scale. Two good filters differ by 40 dB, so every table names its protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol as TypingProtocol

from torch import Tensor

from mipmap_plugin.adaptation.resize import resize
from mipmap_plugin.adaptation.upsamplers import find_upsampler
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes import Scene


@dataclass(frozen=True)
class Protocol:
    """One way to make the truth, as the papers do it."""

    name: str
    resize: str  # of the photograph, already composited on the background
    truncate: bool  # P1 writes its levels with truncation to 8 bits, the others with rounding

    def quantized(self, image: Tensor) -> Tensor:
        steps = image.clamp(0, 1) * 255
        return (steps.floor() if self.truncate else steps.round()) / 255


PROTOCOLS = {
    "P1": Protocol("P1", "box", truncate=True),
    "P2": Protocol("P2", "pil-bicubic", truncate=False),
    "P3": Protocol("P3", "pil-bicubic", truncate=False),
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

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale."""
        size = self.camera.zoomed(scale).size
        if size[0] > self.photograph.shape[0]:
            has = f"{self.photograph.shape[1]} x {self.photograph.shape[0]}"
            raise SettingsError(f"x{scale:g} asks for {size[1]} x {size[0]} px, but the photographs have only {has}; evaluate a smaller scale")
        return protocol.quantized(resize(self.photograph, size, protocol.resize))


def test_views(scene: Scene, base: Camera, background: tuple[float, float, float]) -> list[TestView]:
    """The scene's test photographs (all, if it names none as test) with their cameras brought to the pixel density of `base`."""
    cameras = [c for c in scene.cameras if c in scene.images]
    cameras = [c for c in cameras if c.split == "test"] or cameras
    if not cameras:
        raise SettingsError(f"{scene.source}: there are no photographs to judge by")
    return [TestView(_as_sampled(camera, base), scene.image(camera, background)) for camera in cameras]


def _as_sampled(camera: Camera, base: Camera) -> Camera:
    """`camera` at the pixel density of `base`: where zooming starts from, and not itself a zoom."""
    ratio = base.fx / camera.fx
    return camera.resized(max(1, round(camera.width * ratio)), max(1, round(camera.height * ratio)))


def resized_base(render: Tensor, size: tuple[int, int], upsampler: str = "bicubic") -> Tensor:
    """The base render itself, box-averaged or upsampled to `size`: what zoom costs when no splat is touched."""
    if size[0] < render.shape[0]:
        whole = render.shape[0] % size[0] == 0 and render.shape[1] % size[1] == 0
        return resize(render, size, "box" if whole else "area")
    return find_upsampler(upsampler)(render, size)
