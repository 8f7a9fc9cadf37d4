"""r(x) for zoom-out: an image made smaller. Which filter is part of every protocol, for two good ones differ by about 40 dB."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from mipmap_plugin.errors import SettingsError


def resize(image: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """[H, W, 3] -> [size[0], size[1], 3], not clamped, differentiable.

    `box`: the mean of whole blocks (P1); `area`: the same for any ratio; `bilinear`: two taps and no prefilter, as the
    paper's cv2.resize; `pil-bicubic` and `lanczos`: antialiased, equal to Pillow's on floats.
    Raises SettingsError when `box` is asked for a ratio that is not whole.
    """
    if tuple(image.shape[:2]) == tuple(size):
        return image
    planes = image.movedim(-1, 0)[None]
    return _METHODS[method](planes, size)[0].movedim(0, -1)


def _box(planes: Tensor, size: tuple[int, int]) -> Tensor:
    ratios = [whole / part for whole, part in zip(planes.shape[2:], size, strict=True)]
    if any(ratio != int(ratio) for ratio in ratios):
        raise SettingsError(f"box: {list(planes.shape[2:])} px is not a whole multiple of {list(size)} px; use area")
    return F.avg_pool2d(planes, [int(ratio) for ratio in ratios])


_METHODS = {
    "box": _box,
    "area": lambda planes, size: F.interpolate(planes, size, mode="area"),
    "bilinear": lambda planes, size: F.interpolate(planes, size, mode="bilinear", align_corners=False),
    "pil-bicubic": lambda planes, size: F.interpolate(planes, size, mode="bicubic", antialias=True),
    "lanczos": lambda planes, size: F.interpolate(planes, size, mode="lanczos", antialias=True),
}


def difference_from(target: Tensor, image: Tensor, method: str) -> Tensor:
    """How far `image` [H, W, 3] is from `target` [h, w, 3], at the target's size: where the truth is the base itself, the base's."""
    return resize(image, (target.shape[0], target.shape[1]), method) - target
