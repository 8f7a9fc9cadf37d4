"""r(x) for zoom-in: an image made larger, by name. A registry, so that a super-resolution network is one more name."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.resize import resize
from mipmap_plugin.registry import Registry

UPSAMPLERS = Registry(
    "mipmap_plugin.upsamplers",
    {name: f"mipmap_plugin.adaptation.upsamplers:{name}" for name in ("bicubic", "lanczos")},
)


def register_upsampler(name: str, target: Any, *, replace: bool = False) -> None:
    """Add a function `(image [H, W, 3], size) -> [size[0], size[1], 3]` under `name`, or `"package.module:function"`."""
    UPSAMPLERS.add(name, target, replace=replace)


def bicubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Keys' cubic, a = -0.5, as Pillow's."""
    return resize(image, size, "pil-bicubic")


def lanczos(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Three lobes, as Pillow's."""
    return resize(image, size, "lanczos")
