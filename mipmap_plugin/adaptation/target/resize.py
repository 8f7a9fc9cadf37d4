"""r(x) for zoom-out: an image made smaller. Which filter is part of every protocol, for two good ones differ by about 40 dB."""

from __future__ import annotations

from torch import Tensor

from mipmap_plugin.adaptation.target.resampling import resample
from mipmap_plugin.errors import SettingsError


def resize(image: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """[H, W, 3] -> [size[0], size[1], 3], not clamped, differentiable.

    `box`: the mean of whole blocks (P1); `area`: the same for any ratio; `bilinear`: two taps and no prefilter, as the
    paper's cv2.resize; `pil-bicubic` and `lanczos`: antialiased, equal to Pillow's on floats.
    Raises SettingsError when `box` is asked for a ratio that is not whole.
    """
    if tuple(image.shape[:2]) == tuple(size):
        return image
    if method == "box":
        _check_box(image, size)
    return resample(image, size, method)


def _check_box(image: Tensor, size: tuple[int, int]) -> None:
    whole = list(image.shape[:2])
    if any(pixels % wanted for pixels, wanted in zip(whole, size, strict=True)):
        raise SettingsError(f"box: {whole} px is not a whole multiple of {list(size)} px; use area")


def difference_from(target: Tensor, image: Tensor, method: str) -> Tensor:
    """How far `image` [H, W, 3] is from `target` [h, w, 3], at the target's size: where the truth is the base itself, the base's."""
    return resize(image, (target.shape[0], target.shape[1]), method) - target
