"""Photographs of the frames of a dolly (benchmarks/levels.py)."""

from __future__ import annotations

import math

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.judged import JudgedView
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.images import in_8_bits


def photograph(shot: JudgedView, frame: Camera) -> Tensor:
    """[h, w, 3]: what a photograph shows in a frame of any zoom of its view, shrunk by Pillow's bicubic on 8 bits, as in protocol P3.

    A frame has a whole number of pixels, so that it is up to a pixel wider than the photograph on each side. There the photograph's edge goes on.
    """
    whole, zoom = shot.photograph, frame.fx / shot.camera.fx
    beyond = [(pixels / (zoom * side) - 1) / 2 * length for pixels, side, length in zip(frame.size, shot.camera.size, whole.shape, strict=False)]
    rims = [max(0, math.ceil(each)) for each in beyond]  # px of the photograph, above and below, left and right
    wide = np.pad(in_8_bits(whole), [*((rim, rim) for rim in rims), (0, 0)], mode="edge")
    top, left = (rim - each for rim, each in zip(rims, beyond, strict=True))
    box = (left, top, wide.shape[1] - left, wide.shape[0] - top)
    small = Image.fromarray(wide).resize((frame.width, frame.height), Image.Resampling.BICUBIC, box=box)
    return torch.from_numpy(np.asarray(small).astype(np.float32)) / 255


def against(image: Tensor, truth: Tensor, view: Camera, zoom: float) -> float:
    """PSNR (dB) of a frame of a view at a zoom over the pixels that lie wholly within the photograph."""
    rims = [math.ceil((pixels - zoom * side) / 2 - 1e-6) for pixels, side in zip(image.shape[:2], view.size, strict=True)]
    inside = tuple(slice(rim, pixels - rim) for rim, pixels in zip(rims, image.shape[:2], strict=True))
    return psnr(image[inside], truth[inside])
