"""One tolerance table by dtype, and comparisons that say where and by how much a backend is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError

# A splat whose alpha is 1/255 but for rounding is drawn in one precision and skipped in another: its pixel moves by up to 1/255.
# A splat that would take T below 1e-4 but for rounding is the last or is not: with T·(1 - alpha) = 1e-4 and alpha <= 0.99, T <= 0.01.
# Both in units of the brightest pixel; the larger of the two, and a little for rounding.
PIXEL_BAND = 0.0101


@dataclass(frozen=True)
class Tolerance:
    """How far from the float64 reference is right. Rows are those of a tensor, one per splat."""

    image: float  # of the brightest pixel; image and alpha
    row: float  # of a row's own gradient, as a vector
    tensor: float  # of the largest entry in a tensor's gradient: what rounding leaves of a row that almost cancels
    pixel_share: float = 0.002  # of the pixels may lie on a cut-off, and then be wrong by PIXEL_BAND
    row_share: float = 0.01  # of the rows may own such a pixel, none in a scene of less than 100 splats
    row_band: float = 0.1  # of the largest entry, by which a row that owns such a pixel may differ
    # Shares forgive rows one by one; the whole gradient as one vector must still point where it should and be as long.
    length: float = 0.005  # |a - e| / |e|
    angle: float = 1.25e-5  # 1 - cosine; length²/2, so that even a gradient of the right length may not turn further


TOLERANCE = {
    # 24 bits, a rounding of 6e-8: some hundred of them lie between a splat and a pixel, and sums over pixels of both signs lose as much
    # again. Reference and cpu need a tenth of these or less; a kernel with fast exponentials or another order of sums needs more.
    torch.float32: Tolerance(image=1e-5, row=1e-3, tensor=5e-5),
    # 53 bits: the same steps, with room for the sums in another order.
    torch.float64: Tolerance(image=1e-10, row=1e-7, tensor=1e-10),
}


def tolerance_for(dtype: torch.dtype) -> Tolerance:
    """Raises SettingsError for a dtype that is not in the table."""
    if dtype not in TOLERANCE:
        raise SettingsError(f"conformance: there are no tolerances for {dtype}; known are {', '.join(map(str, TOLERANCE))}")
    return TOLERANCE[dtype]


@dataclass(frozen=True, eq=False)
class Limits:
    """What `differing` forgives."""

    bound: Tensor  # [M, 1], the most that an entry of the row may differ by
    share: float  # of the rows may differ by more
    band: float  # but never by more than this


def not_finite(what: str, actual: Tensor) -> list[str]:
    """One sentence if `actual` holds NaN or infinities."""
    wrong = (~torch.isfinite(actual)).nonzero()
    return [f"{what}: {len(wrong)} of {actual.numel()} values are not finite, the first at {wrong[0].tolist()}"] if len(wrong) else []


def differing_images(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    """What is wrong with `actual` [H, W, C], in sentences."""
    brightest = max(1.0, float(expected.abs().max()))
    limits = Limits(expected.new_full((1, 1), tolerance.image * brightest), tolerance.pixel_share, PIXEL_BAND * brightest)
    width = expected.shape[1]
    return differing(f"{what}, pixels", actual.flatten(0, 1), expected.flatten(0, 1), limits, lambda i: f"row {i // width}, column {i % width}")


def differing_gradients(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    """What is wrong with the gradient `actual` [N, ...] of the tensor `what`, in sentences."""
    if not expected.numel():
        return []
    actual, expected = actual.reshape(len(actual), -1), expected.reshape(len(expected), -1)
    largest = float(expected.abs().max())
    bound = tolerance.row * expected.norm(dim=1, keepdim=True) + tolerance.tensor * largest
    limits = Limits(bound, tolerance.row_share, tolerance.row_band * largest)
    return differing(f"gradient of {what}, rows", actual, expected, limits, str) + _differing_vectors(what, actual, expected, tolerance)


def differing(what: str, actual: Tensor, expected: Tensor, limits: Limits, place: Callable[[int], str]) -> list[str]:
    """One sentence that names the worst row of `actual` [M, C] when too many or too much differ from `expected`."""
    gap = (actual - expected).abs()
    outside = (gap > limits.bound).any(1)
    if float(outside.double().mean()) <= limits.share and not (gap > limits.band).any():
        return []
    worst = int((gap - limits.bound).amax(1).argmax())
    numbers = f"{_shown(actual[worst])} instead of {_shown(expected[worst])}"
    return [f"{what}: {int(outside.sum())} of {len(outside)} differ, the worst by {gap[worst].max():.2e} at {place(worst)}: {numbers}"]


def _differing_vectors(what: str, actual: Tensor, expected: Tensor, tolerance: Tolerance) -> list[str]:
    norm = float(expected.norm())
    if norm == 0:
        return []
    length = float((actual - expected).norm()) / norm
    angle = 1 - float(torch.cosine_similarity(actual.flatten(), expected.flatten(), dim=0, eps=0))
    wrong = length > tolerance.length or not angle <= tolerance.angle
    return [f"gradient of {what}, as one vector: off by {length:.2%} of its length, 1 - cosine is {angle:.1e}"] if wrong else []


def _shown(values: Tensor) -> str:
    listed = ", ".join(f"{value:.6g}" for value in values[:4].tolist())
    return f"[{listed}{', ...' if len(values) > 4 else ''}]"
