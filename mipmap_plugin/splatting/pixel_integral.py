"""The screen filter of Analytic-Splatting: a splat's integral over each pixel's square, instead of a dilation.

    alpha = opacity · 2π · I(u, σ_long) · I(v, σ_short),   I(u, σ) = σ · (S((u + 1/2) / σ) - S((u - 1/2) / σ))

where (u, v) is the pixel's offset along the axes of the projected splat, and S(x) = 1/2 + tanh((1.6·x + 0.07·x³) / 2) / 2
approximates the normal distribution function (Liang et al. 2024). The pixel's square is rotated to align with those axes.

The published code divides by σ_short, which may be 0, and normalizes an eigenvector that is 0 where the covariance is axis-aligned
or round. Here the axes come from their angle, which is undefined for round splats only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# S(x) = 1 / (1 + exp(-x·(LINEAR + CUBIC·x²))), within 4e-4 of the normal distribution.
LINEAR, CUBIC = 1.6, 0.07

# Splats whose variances differ by less than this fraction count as round: their axes would be rounding noise, with unbounded gradients.
ROUND = 1e-6

# S' exceeds the normal density by at most this factor (at x = 2.34), so a Gaussian with BOUND² times the opacity bounds the integral.
BOUND = 1.0083

# Exponents are clamped here, because exp overflows float32 a little above; the integral is then 0 to within 1e-34.
MAX_POWER = 80.0


@dataclass(frozen=True, eq=False)
class PixelIntegral:
    """N splats integrated over the squares of pixels. Has the methods of `filters.Footprint`."""

    long: Tensor  # [N] px, standard deviation along the longer axis
    short: Tensor  # [N] px
    cos: Tensor  # [N], the direction of the longer axis
    sin: Tensor  # [N]
    opacities: Tensor  # [N]
    xx: Tensor  # [N] px², variance along x
    yy: Tensor  # [N] px², variance along y

    def packed(self) -> Tensor:
        """The parameters of `alpha`, [N, 5]."""
        return torch.stack([self.long, self.short, self.cos, self.sin, self.opacities], -1)

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha of splats [..., 5] at pixels dx, dy px from their centers, not clamped."""
        long, short, cos, sin, opacity = packed.unbind(-1)
        return opacity * 2 * math.pi * integral(cos * dx + sin * dy, long) * integral(cos * dy - sin * dx, short)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """Which splats are finite and reach `min_alpha` [N] somewhere, [N] bool. A splat of zero width has zero alpha."""
        zero = torch.zeros_like(self.long)
        return self.is_finite() & (self.alpha(self.packed(), zero, zero) >= min_alpha)

    def is_finite(self) -> Tensor:
        """Which splats are finite, [N] bool."""
        return torch.isfinite(torch.cat([self.packed(), self.xx[:, None], self.yy[:, None]], 1)).all(1)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """Half-sizes of a box around all pixels with alpha >= `min_alpha` [N], half a rotated pixel included; [N, 2] px, without gradient."""
        reach = (2 * (BOUND**2 * self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        pixel = (self.cos.abs() + self.sin.abs()) / 2
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1).sqrt() + pixel[:, None]).detach()


def integral_of(kind: type[PixelIntegral], covariance: tuple[Tensor, Tensor, Tensor, Tensor], opacities: Tensor) -> PixelIntegral:
    """The integrals, of class `kind`, of splats with covariances (xx, xy, yy, det). Round splats get the axes x and y, without gradient."""
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

    With x± = (u ± 1/2) / σ, g(x) = LINEAR·x + CUBIC·x³, P = exp(g(x-)) and Q = exp(-g(x+)), S(x+) - S(x-) is
    (1 - PQ) / ((1 + P)·(1 + Q)). Unlike the difference, 1 - PQ does not cancel where a splat is much wider than a pixel.
    """
    t, h = u / sigma, 0.5 / sigma
    before, after = (x * (LINEAR + CUBIC * x.square()) for x in (t - h, t + h))
    log_pq = -2 * h * (LINEAR + CUBIC * (3 * t.square() + h.square()))
    p, q = before.clamp_max(MAX_POWER).exp(), (-after).clamp_max(MAX_POWER).exp()
    return sigma * -torch.expm1(log_pq) / ((1 + p) * (1 + q))
