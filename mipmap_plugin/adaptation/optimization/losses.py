"""The losses of an image, by their gradients: all that a step needs, and far less work for autograd than their values."""

from __future__ import annotations

import torch
from torch import Tensor

# The square of half a step of an 8-bit image: smaller mean square differences are invisible on a display, and hardly count.
INVISIBLE_ERROR = (0.5 / 255) ** 2


@torch.no_grad()
def gradient_of(difference: Tensor, loss: str) -> tuple[Tensor, Tensor]:
    """The gradient of a loss (`AdaptConfig.loss`) in the difference from the target, [..., h, w, 3], and the mean square error, [...].

    `psnr` is the logarithm of the mean square error, so that a view that is far off does not outweigh the others.
    """
    flat = difference.flatten(-3)
    count = flat.shape[-1]
    square_error: Tensor = torch.linalg.vecdot(flat, flat) / count
    if loss == "l1":
        return difference.sign() / count, square_error
    if loss == "l2":
        return difference * (2 / count), square_error
    divisor = (square_error + INVISIBLE_ERROR) * (count / 2)
    return difference / divisor.view(*divisor.shape, 1, 1, 1), square_error
