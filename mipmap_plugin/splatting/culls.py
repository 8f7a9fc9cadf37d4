"""Culling by viewers, with a gradient that lets culled splats return; and splats that viewers draw in another shape.

A viewer compares a measure of a splat (its variance, its contribution) with a threshold. Let x be the smallest ratio of measure to
threshold. The splat's alpha is multiplied by a gate: in the image 1 where x >= 1, else 0, exactly as in the viewer; in the backward
pass the smooth step x⁴ / (1 + x⁴), the logistic function of 4·ln(x). So a culled splat has a gradient: if drawing it would lower the
loss, its measure grows. The exponent makes the step narrow (slope 0.004 at four times the threshold), yet wide enough to reach the
smallest splats, whose size dilation alone determines.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.render_settings import RenderSettings

# xx, xy, yy and det, [N] each, px² and px⁴: the covariances of splats on the image.
Shape = tuple[Tensor, Tensor, Tensor, Tensor]

STEEPNESS = 4.0

# What stands in place of a level splat's xy, over the least spread: 1 px² over the root of 0.1 px⁴ in vk_gaussian_splatting. As a ratio it holds for
# pictures with more or fewer pixels too (`RenderSettings.finer`).
ASIDE = 10**0.5


def gate(shape: Shape, opacities: Tensor, settings: RenderSettings) -> Tensor:
    """1 where a splat is drawn and 0 where it is culled, [N], with the gradient of the smooth step.

    `shape`: dilated. `opacities` [N]: before any compensation.
    """
    xx, _, yy, det = shape
    ratios = []
    if settings.min_variance:
        larger = torch.maximum(xx, yy) if settings.boxed else (xx + yy) / 2 + spread(shape)
        ratios.append(larger / settings.min_variance)
    if settings.min_contribution:
        # `where` before the root: the root's gradient at 0 is infinite.
        weights = torch.where(opacities > 0, opacities, 1.0).sqrt() * (opacities > 0) if settings.rooted else opacities
        ratios.append(weights * det.sqrt() / settings.min_contribution)
    if settings.least_spread:
        ratios.append((xx + yy) / 2 / settings.least_spread)
    least = torch.stack(ratios).amin(0)
    # `where` before the logarithm: at opacity 0 it is infinite, and the gradient has to be 0.
    smooth = torch.sigmoid(STEEPNESS * torch.where(least > 0, least, 1.0).log())
    return (least >= 1).to(smooth) + smooth - smooth.detach()


def spread(shape: Shape) -> Tensor:
    """Half the difference of the variances along a splat's two axes, [N] px²."""
    half, xy = (shape[0] - shape[2]) / 2, shape[1]
    is_round = (half == 0) & (xy == 0)
    # `hypot`, for squares could overflow; `where` before it as well as after, for its gradient at 0 is NaN.
    return torch.where(is_round, 0.0, torch.hypot(torch.where(is_round, 1.0, half), xy))


def stretched(shape: Shape, drawn: Tensor, least: float, level: float = 0.0) -> Shape:
    """Stretch the `drawn` [N] splats whose `spread` is below `least` px² until it is `least`.

    As in GaussianSplats3D (SplatMaterial3D): the direction of the longer axis is (xy, mean + least - xx), which is an eigenvector
    only where the variances do not change. A round splat becomes elongated along y. vk_gaussian_splatting (threedgs) has `ASIDE` · `least` in
    place of an xy between ±`level`.
    """
    xx, xy, yy, _ = shape
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    changed = drawn & (spread(shape) < least)
    # `where` before the squares as well as after: those of the others may overflow, and infinity times zero is NaN.
    up, xy = torch.where(changed, least - half, 1.0), torch.where(changed, torch.where(xy.abs() < level, ASIDE * least, xy), 0.0)
    squared = xy.square() + up.square()
    cos, sin = least * (xy.square() - up.square()) / squared, least * 2 * xy * up / squared
    stretch = mean + cos, sin, mean - cos, mean.square() - least**2
    return tuple(torch.where(changed, new, old) for new, old in zip(stretch, shape, strict=True))  # type: ignore[return-value]


def limited(shape: Shape, most: float, whole: bool) -> Shape:
    """Clamp the variances along each splat's axes to `most` px². `whole`: shrink the splat before, until its variances along x and y fit.

    A change of a matrix M's eigenvalues that keeps its eigenvectors is a·M + b·1 (Cayley and Hamilton). For variances
    long > most > short: a = (most - short) / (long - short), b = short · (long - most) / (long - short), sums without cancellation.
    """
    xx, xy, yy, det = shape = _shrunk(shape, most) if whole else shape
    long = (xx + yy) / 2 + spread(shape)
    short = det / torch.where(long > 0, long, 1.0)
    one, both = (long > most) & (short < most), (long > most) & (short >= most)
    apart = torch.where(one, long - short, 1.0)
    a = torch.where(one, (most - short) / apart, torch.where(both, 0.0, 1.0))
    b = torch.where(one, short * (long - most) / apart, torch.where(both, most, 0.0))
    new = a * xx + b, a * xy, a * yy + b, a.square() * det + a * b * (xx + yy) + b.square()
    changed = (a < 1) | (b > 0)
    return tuple(torch.where(changed, limit, old) for limit, old in zip(new, shape, strict=True))  # type: ignore[return-value]


def _shrunk(shape: Shape, most: float) -> Shape:
    """The shapes, shrunk until the variances along x and y are at most `most` px²; one that lies askew may still be longer along its axis."""
    xx, xy, yy, det = shape
    factor = most / torch.maximum(xx, yy).clamp_min(most)
    return factor * xx, factor * xy, factor * yy, factor.square() * det
