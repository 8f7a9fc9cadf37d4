"""Culls: splats that a viewer does not draw, with a gradient that lets them come back, and splats that it draws in another shape.

A viewer compares a measure of a splat (its variance, its contribution) with a threshold. With x the smallest quotient of measure and
threshold, a splat's alpha is multiplied by a gate: in the image 1 where x >= 1 and else 0, exactly as the viewer does it; for the
gradient the smooth step x⁴ / (1 + x⁴), which is the logistic function of 4·ln(x). A culled splat is thus felt where it would lie: if the
loss fell with it, its measure grows. The power makes the step narrow: of a splat four times above the threshold its slope is 0.004,
while a splat is still felt that lies as far below it as dilation alone lets any.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.effects import RenderSettings

STEEPNESS = 4.0


def gate(shape: tuple[Tensor, Tensor, Tensor, Tensor], opacities: Tensor, settings: RenderSettings) -> Tensor:
    """[N]: 1 where a splat is drawn and 0 where it is culled, with the gradient of the smooth step.

    `shape`: (xx, xy, yy, det) [N] of the dilated covariances, px² and px⁴. `opacities` [N]: before any compensation.
    """
    xx, _, yy, det = shape
    quotients = []
    if settings.min_variance:
        larger = torch.maximum(xx, yy) if settings.boxed else (xx + yy) / 2 + spread(shape)
        quotients.append(larger / settings.min_variance)
    if settings.min_contribution:
        quotients.append(opacities * det.sqrt() / settings.min_contribution)
    if settings.least_spread:
        quotients.append((xx + yy) / 2 / settings.least_spread)
    least = torch.stack(quotients).amin(0)
    # `where` before the logarithm: a splat of opacity 0 has none, and no gradient.
    smooth = torch.sigmoid(STEEPNESS * torch.where(least > 0, least, 1.0).log())
    return (least >= 1).to(smooth) + smooth - smooth.detach()


def spread(shape: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    """[N] px²: how far the variances along a splat's axes lie from their mean."""
    squared = ((shape[0] - shape[2]) / 2).square() + shape[1].square()
    # `where` before the root as well as after it: the root's gradient at 0 is infinite, and infinity times zero is NaN.
    return torch.where(squared > 0, torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)


def stretched(shape: tuple[Tensor, Tensor, Tensor, Tensor], drawn: Tensor, least: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The shapes of splats whose variances are put `least` px² from their mean where they lie nearer, of those that are `drawn` [N].

    As GaussianSplats3D does it (SplatMaterial3D): the direction of the longer axis is (xy, mean + least - xx), which is an eigenvector
    only where the variances are left as they are. A round splat becomes an upright one.
    """
    xx, xy, yy, _ = shape
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    changed = drawn & (spread(shape) < least)
    up = torch.where(changed, least - half, 1.0)
    squared = xy.square() + up.square()
    cos, sin = least * (xy.square() - up.square()) / squared, least * 2 * xy * up / squared
    stretch = mean + cos, sin, mean - cos, mean.square() - least**2
    return tuple(torch.where(changed, new, old) for new, old in zip(stretch, shape, strict=True))  # type: ignore[return-value]


def limited(shape: tuple[Tensor, Tensor, Tensor, Tensor], most: float, whole: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The shapes [N] of splats whose variances along their axes are at most `most` px²; `whole`: all of a splat shrinks, until those along
    x and y are.

    What becomes of the eigenvalues of a matrix M while its eigenvectors stay is a·M + b·1 (Cayley and Hamilton). With variances
    long > most > short that is a = (most - short) / (long - short) and b = short · (long - most) / (long - short), sums without cancellation.
    """
    xx, xy, yy, det = shape
    if whole:
        a, b = most / torch.maximum(xx, yy).clamp_min(most), torch.zeros_like(xx)
    else:
        long = (xx + yy) / 2 + spread(shape)
        short = det / torch.where(long > 0, long, 1.0)
        one, both = (long > most) & (short < most), (long > most) & (short >= most)
        apart = torch.where(one, long - short, 1.0)
        a = torch.where(one, (most - short) / apart, torch.where(both, 0.0, 1.0))
        b = torch.where(one, short * (long - most) / apart, torch.where(both, most, 0.0))
    new = a * xx + b, a * xy, a * yy + b, a.square() * det + a * b * (xx + yy) + b.square()
    changed = (a < 1) | (b > 0)
    return tuple(torch.where(changed, limit, old) for limit, old in zip(new, shape, strict=True))  # type: ignore[return-value]
