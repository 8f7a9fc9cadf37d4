"""r(x) for zoom-out: an image is made smaller. Every protocol names its filter, because the results of two good ones differ by about 40 dB."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from mipmap_plugin.adaptation.target.resampling import resample, resample_back
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.splatting.filters import compensates

# px: a bicubic filter weighs what lies up to a new pixel from the middle of each, which the border of a picture of this width cuts off everywhere.
# What is left counts the middle of the picture too much: adaptation to it lost 3 to 14 dB of the start's at 1 and 2 px, and gains from 3 px on.
TOO_NARROW = 2


def resize(image: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """Resize an image [H, W, 3] to [size[0], size[1], 3]; not clamped, differentiable.

    `box`: the mean of whole blocks (P1); `area`: the same for any ratio; `bilinear`: two taps and no prefilter, as the
    paper's cv2.resize; `pil-bicubic` and `lanczos`: antialiased, equal to Pillow's on floats.
    Raises SettingsError for `box` with a ratio that is not a whole number.
    """
    if tuple(image.shape[:2]) == tuple(size):
        return image
    if method == "box" and any(old % new for old, new in zip(image.shape[:2], size, strict=True)):
        raise SettingsError(f"box: {list(image.shape[:2])} px is not a whole multiple of {list(size)} px; use area")
    return resample(image, size, method)


def gradient_before(gradient: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """The gradient in an image [size[0], size[1], 3] from that in what it was resized to, [h, w, 3]: without the time that autograd takes."""
    return gradient if tuple(gradient.shape[:2]) == tuple(size) else resample_back(gradient, size, method)


def resize_all(images: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """`resize` of images [V, H, W, 3] at once, as channels of one: [V, size[0], size[1], 3], contiguous."""
    channels = resize(images.permute(1, 2, 0, 3).flatten(2), size, method)
    resized: Tensor = channels.unflatten(2, images.shape[::3]).permute(2, 0, 1, 3).contiguous()
    return resized


def fitting(config: AdaptConfig, base: Effects, views: Sequence[Camera], scale: float) -> AdaptConfig:
    """The settings with the filter that fits a base which is rendered with these effects, where they leave the choice of one.

    Where the `views`, which are of the base scale, are narrow at `scale`, that is the mean over the area of a pixel. So it is at a zoom-in from a
    base whose screen filter stands for that area: for one that is sampled at the pixel's center a bicubic filter is better, by up to 0.5 dB
    (docs/recipes_found.md). A zoom-out looks like other pictures of its size, which mostly are made by a bicubic filter.
    """
    if config.resize != "fitting":
        return config
    width = max((min(view.zoomed(min(1.0, scale)).size) for view in views), default=math.inf)
    averages = scale > 1 and compensates(base.screen_filter)
    return config.model_copy(update={"resize": "area" if averages else filter_for(width)})


def filter_for(width: float) -> str:
    """The filter that makes an image smaller, to a picture whose shorter side has so many px."""
    return "area" if width <= TOO_NARROW else "pil-bicubic"


def difference_from(target: Tensor, image: Tensor, method: str) -> Tensor:
    """`image` [H, W, 3], resized to the size of `target` [h, w, 3], minus `target`."""
    return resize(image, (target.shape[0], target.shape[1]), method) - target
