"""The table of tolerances by dtype, and comparisons that say where and by how much a backend is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError

# A splat whose alpha is within rounding of 1/255 is drawn in one precision and skipped in another: the pixel changes by up to 1/255.
# Likewise, whether a splat that takes the transmittance T to 1e-4 is drawn depends on rounding: T·(1 - alpha) = 1e-4 and alpha <= 0.99,
# so T <= 0.01. In units of the brightest pixel: the larger of the two, and a little for rounding.
PIXEL_BAND = 0.0101


@dataclass(frozen=True)
class Tolerance:
    """Allowed differences from the float64 reference. A row of a gradient belongs to one splat."""

    image: float  # relative to the brightest pixel; for image and alpha
    row: float  # relative to the norm of the row's own gradient
    tensor: float  # relative to the largest entry of a tensor's gradient: rounding in rows that almost cancel
    pixel_share: float = 0.002  # fraction of pixels that may lie on a cut-off, and then differ by PIXEL_BAND
    row_share: float = 0.01  # fraction of rows that may have such a pixel; none in a scene of fewer than 100 splats
    row_band: float = 0.1  # by which such a row may differ, relative to the largest entry
    # The fractions apply row by row; in addition, direction and norm of the whole gradient, as one vector, must be right.
    length: float = 0.005  # |a - e| / |e|
    angle: float = 1.25e-5  # 1 - cosine: length²/2, so that a gradient of the right norm may not be rotated further either


TOLERANCE = {
    # 24 bits, a rounding of 6e-8: about a hundred roundings lie between a splat and a pixel, and sums over pixels of both signs lose as
    # much again. Reference and cpu need a tenth of this or less; kernels with fast exponentials or another order of summation need more.
    torch.float32: Tolerance(image=1e-5, row=1e-3, tensor=5e-5),
    # 53 bits: the same operations, with a margin for another order of summation.
    torch.float64: Tolerance(image=1e-10, row=1e-7, tensor=1e-10),
}


def tolerance_for(dtype: torch.dtype) -> Tolerance:
    """The tolerances of `dtype`. Raises SettingsError for a dtype that is not in the table."""
    if dtype not in TOLERANCE:
        raise SettingsError(f"conformance: no tolerances for {dtype}; choose one of {', '.join(map(str, TOLERANCE))}")
    return TOLERANCE[dtype]


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of `differing`."""

    bound: Tensor  # [M, 1], by which the entries of a row may differ
    share: float  # fraction of the rows that may differ by more
    band: float  # by which no entry may differ


def not_finite(what: str, actual: Tensor) -> list[str]:
    """One sentence if `actual` holds NaN or infinities."""
    wrong = (~torch.isfinite(actual)).nonzero()
    return [f"{what}: {len(wrong)} of {actual.numel()} values are not finite, the first at {wrong[0].tolist()}"] if len(wrong) else []


def differing_images(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    """The differences of the image `actual` [H, W, C], in sentences."""
    brightest = max(1.0, float(expected.abs().max()))
    limits = Limits(expected.new_full((1, 1), tolerance.image * brightest), tolerance.pixel_share, PIXEL_BAND * brightest)
    width = expected.shape[1]
    return differing(f"{what}, pixels", actual.flatten(0, 1), expected.flatten(0, 1), limits, lambda i: f"row {i // width}, column {i % width}")


def differing_gradients(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    """The differences of the gradient `actual` [N, ...] of the tensor `what`, in sentences."""
    if not expected.numel():
        return []
    actual, expected = actual.reshape(len(actual), -1), expected.reshape(len(expected), -1)
    largest = float(expected.abs().max())
    bound = tolerance.row * expected.norm(dim=1, keepdim=True) + tolerance.tensor * largest
    limits = Limits(bound, tolerance.row_share, tolerance.row_band * largest)
    return differing(f"gradient of {what}, rows", actual, expected, limits, str) + _differing_vectors(what, actual, expected, tolerance)


def differing(what: str, actual: Tensor, expected: Tensor, limits: Limits, place: Callable[[int], str]) -> list[str]:
    """One sentence that names the worst row of `actual` [M, C], if too many rows differ from `expected`, or one by too much."""
    gap = (actual - expected).abs()
    outside = (gap > limits.bound).any(1)
    if float(outside.double().mean()) <= limits.share and not (gap > limits.band).any():
        return []
    worst = int((gap - limits.bound).amax(1).argmax())
    numbers = f"{_listed(actual[worst])} instead of {_listed(expected[worst])}"
    return [f"{what}: {int(outside.sum())} of {len(outside)} differ, the worst by {gap[worst].max():.2e} at {place(worst)}: {numbers}"]


def _differing_vectors(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    norm = float(expected.norm())
    if norm == 0:
        return []
    length = float((actual - expected).norm()) / norm
    angle = 1 - float(torch.cosine_similarity(actual.flatten(), expected.flatten(), dim=0, eps=0))
    wrong = length > tolerance.length or not angle <= tolerance.angle
    return [f"gradient of {what}, as one vector: off by {length:.3g} of its length, 1 - cosine is {angle:.1e}"] if wrong else []


def _listed(values: Tensor) -> str:
    numbers = ", ".join(f"{value:.6g}" for value in values[:4].tolist())
    return f"[{numbers}{', ...' if len(values) > 4 else ''}]"
