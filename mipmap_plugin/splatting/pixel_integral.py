"""The screen filter of Analytic-Splatting: a splat's integral over each pixel's square, instead of a dilation.

    alpha = opacity · 2π · I(u, σ_long) · I(v, σ_short),   I(u, σ) = σ · (S((u + 1/2) / σ) - S((u - 1/2) / σ))

with (u, v) the pixel's offset along the axes of the projected splat, and S(x) = 1/2 + tanh((1.6·x + 0.07·x³) / 2) / 2 in place of
the normal distribution (Liang et al. 2024). The pixel's square is turned into those axes.

The published code divides by σ_short, which may be 0, and normalizes an eigenvector that is 0 where the covariance is axis-aligned
or round. Here the axes come from their angle, which only a round splat lacks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# S(x) = 1 / (1 + exp(-x·(LINEAR + CUBIC·x²))), within 4e-4 of the normal distribution.
LINEAR, CUBIC = 1.6, 0.07

# A splat whose variances differ by less than this share is round: rounding alone would choose its axes, and their gradient has no end.
ROUND = 1e-6

# S' exceeds the normal density by at most this factor (at x = 2.34), so that a Gaussian of BOUND² the opacity bounds the integral.
BOUND = 1.0083

# exp of more overflows float32; where it would, the integral is 0 to within 1e-34.
MAX_POWER = 80.0


@dataclass(frozen=True, eq=False)
class PixelIntegral:
    """A splat as the squares of pixels see it. Of the same use as `filters.Footprint`."""

    long: Tensor  # [N] px, standard deviation along the longer axis
    short: Tensor  # [N] px
    cos: Tensor  # [N], the direction of the longer axis
    sin: Tensor  # [N]
    opacities: Tensor  # [N]
    xx: Tensor  # [N] px², variance along x
    yy: Tensor  # [N] px², variance along y

    def packed(self) -> Tensor:
        """[N, 5]: what `alpha` needs of each splat."""
        return torch.stack([self.long, self.short, self.cos, self.sin, self.opacities], -1)

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha, not clamped, of splats [..., 5] at pixels dx, dy px from their centers."""
        long, short, cos, sin, opacity = packed.unbind(-1)
        return opacity * 2 * math.pi * integral(cos * dx + sin * dy, long) * integral(cos * dy - sin * dx, short)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """[N] bool: finite, and bright enough to reach `min_alpha` [N] somewhere. A splat without any width sends no light."""
        zero = torch.zeros_like(self.long)
        return torch.isfinite(torch.cat([self.packed(), self.xx[:, None], self.yy[:, None]], 1)).all(1) & (
            self.alpha(self.packed(), zero, zero) >= min_alpha
        )

    def extents(self, min_alpha: Tensor) -> Tensor:
        """[N, 2] px, without gradient: half-sizes of a box around all pixels with alpha >= `min_alpha` [N], half a turned pixel included."""
        reach = (2 * (BOUND**2 * self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        pixel = (self.cos.abs() + self.sin.abs()) / 2
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1).sqrt() + pixel[:, None]).detach()


def integral_of(kind: type[PixelIntegral], covariance: tuple[Tensor, Tensor, Tensor, Tensor], opacities: Tensor) -> PixelIntegral:
    """`kind` with the axes of every splat, from (xx, xy, yy, det). Round ones lie along x and y, and have no gradient of their direction."""
    xx, xy, yy, det = covariance
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    is_round = half.square() + xy.square() <= (ROUND * mean).square()
    # `where` before the root and the angle as well as after: their gradients at 0 are infinite, and infinity times zero is NaN.
    half, xy = torch.where(is_round, 1.0, half), torch.where(is_round, 0.0, xy)
    spread = torch.where(is_round, 0.0, (half.square() + xy.square()).sqrt())
    angle = torch.atan2(xy, half) / 2
    longer = mean + spread
    return kind(longer.sqrt(), (det / longer).sqrt(), angle.cos(), angle.sin(), opacities, covariance[0], yy)


def integral(u: Tensor, sigma: Tensor) -> Tensor:
    """I(u, σ) in px.

    With x± = (u ± 1/2) / σ, g(x) = LINEAR·x + CUBIC·x³, P = exp(g(x-)) and Q = exp(-g(x+)) the difference of the two S is
    (1 - PQ) / ((1 + P)·(1 + Q)): where a splat is much wider than a pixel, 1 - PQ is known without the cancellation.
    """
    t, h = u / sigma, 0.5 / sigma
    before, after = (x * (LINEAR + CUBIC * x.square()) for x in (t - h, t + h))
    log_pq = -2 * h * (LINEAR + CUBIC * (3 * t.square() + h.square()))
    p, q = before.clamp_max(MAX_POWER).exp(), (-after).clamp_max(MAX_POWER).exp()
    return sigma * -torch.expm1(log_pq) / ((1 + p) * (1 + q))
