"""The screen filter of Gaussian Blending: each splat is integrated over the part of the pixel that is still visible, its window.

A pixel's window is at first its own square. Behind a splat, transmittance varies over the window; the next window is the rectangle on
which a uniform distribution has the same mean and variance (Koo et al. 2026). So an edge occludes the splats behind it, instead of
attenuating all of them alike. Let g be the splat's Gaussian along one of its axes, t = u + s px the offset from its center, and a the
width of a window centered at u:

    (p, m, q) = (1/a) ∫ (1, s, s²)·g(u + s) ds over |s| <= a/2;   alpha = opacity · p_long · p_short
    mean of the transmittance along the long axis:  -opacity · p_short · m_long / (1 - alpha)
    its mean square, not centered:                  (a²/12 - opacity · p_short · q_long) / (1 - alpha)

Windows are aligned with x and y; the splat's axis that is closer to x is matched with x. Two things differ from the published code: a
window stays near its pixel, so that the pixels that a splat can reach are known in advance; and where a splat is wide, the integrals
are quadratures instead of differences that cancel.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.render_settings import MAX_ALPHA
from mipmap_plugin.splatting.pixel_integral import PixelIntegral

# px²: the least variance of a window along x or y.
LEAST_VARIANCE = 1e-3
NARROWEST = math.sqrt(12 * LEAST_VARIANCE)  # px, the width of such a window

# Windows of up to WIDE standard deviations are integrated by five-point Gauss-Legendre quadrature, to within 4e-8.
WIDE = 1.5
POINTS = (-0.9061798459386640, -0.5384693101056831, 0.0, 0.5384693101056831, 0.9061798459386640)
WEIGHTS = (0.1184634425280945, 0.2393143352496832, 0.2844444444444444, 0.2393143352496832, 0.1184634425280945)

# px: how far a window may reach from its pixel's center along x and y, twice as far as the pixel. Where splats occlude the middle of a
# pixel, both sides stay visible, and the uniform distribution of that variance is wider than the pixel.
FARTHEST = 1.0

# px: how far it reaches along x and y after a rotation by up to 45 degrees about its own center.
REACH = FARTHEST * (1 + math.sqrt(0.5))


class Windows(NamedTuple):
    """Each pixel's window, [B, P] px: its center relative to the pixel's center, and its size."""

    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor


class WindowIntegral(PixelIntegral):
    """N splats integrated over windows. Has the methods of `filters.Footprint`."""

    MEMORY_FACTOR: ClassVar = 8  # tensors that are alive at once, relative to a plain Gaussian

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha of splats [..., 5] that are in front, at pixels dx, dy px from their centers; not clamped."""
        long, short, cos, sin, opacity = packed.unbind(-1)
        one = torch.ones_like(dx)
        return opacity * moments(cos * dx + sin * dy, one, long)[0] * moments(cos * dy - sin * dx, one, short)[0]

    @staticmethod
    def alphas(packed: Tensor, dx: Tensor, dy: Tensor, least: Tensor) -> Tensor:
        """Alpha [B, K, P], 0 below `least` [B, K, 1], of splats [B, K, 1, 5] in depth order at pixels dx, dy px from their centers."""
        zero, one = torch.zeros_like(dx[:, 0]), torch.ones_like(dx[:, 0])
        windows, alphas = Windows(zero, zero, one, one), []
        for k in range(dx.shape[1]):
            alpha, after = occlude(packed[:, k], dx[:, k], dy[:, k], windows)
            drawn = alpha >= least[:, k]
            windows = Windows(*(torch.where(drawn, new, old) for new, old in zip(after, windows, strict=True)))
            alphas.append(torch.where(drawn, alpha, 0.0))
        return torch.stack(alphas, 1)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """Which splats are finite and reach `min_alpha` [N] in the narrowest window, [N] bool.

        The bound is the integral over the whole splat, which excludes splats too thin to have a gradient in float32.
        """
        shares = [(math.sqrt(2 * math.pi) * width / NARROWEST).clamp_max(1) for width in (self.long, self.short)]
        return self.is_finite() & (self.opacities * shares[0] * shares[1] >= min_alpha) & (self.short > 0)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """Half-sizes of a box around all pixels with alpha >= `min_alpha` [N] in any window, [N, 2] px, without gradient."""
        reach = (2 * (self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1).sqrt() + REACH).detach()


def occlude(packed: Tensor, dx: Tensor, dy: Tensor, windows: Windows) -> tuple[Tensor, Windows]:
    """Alpha [B, P] of one splat per tile [B, 1, 5] within windows, and the windows behind it."""
    long, short, cos, sin, opacity = packed.unbind(-1)
    upright = cos.abs() < sin.abs()  # the longer axis is nearer to y
    dx, dy = dx + windows.x, dy + windows.y
    a, b = torch.where(upright, windows.height, windows.width), torch.where(upright, windows.width, windows.height)
    p, m, q = moments(cos * dx + sin * dy, a, long)
    r, n, w = moments(cos * dy - sin * dx, b, short)
    mass = p * r
    opacity = torch.where(opacity * mass > MAX_ALPHA, MAX_ALPHA / mass.clamp_min(MAX_ALPHA / 2), opacity)
    alpha = opacity * mass
    u, a = narrow(a, opacity * r, m, q, alpha)
    v, b = narrow(b, opacity * p, n, w, alpha)
    width, height = (torch.where(upright, *pair).clamp_max(2 * FARTHEST) for pair in ((b, a), (a, b)))
    x, y = windows.x + cos * u - sin * v, windows.y + sin * u + cos * v
    return alpha, Windows(clamp_center(x, width), clamp_center(y, height), width, height)


def narrow(width: Tensor, opacity: Tensor, m: Tensor, q: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """The window behind a splat, along one axis: its center relative to the window in front of the splat, and its width, px."""
    mean = -opacity * m / (1 - alpha)
    variance = (width.square() / 12 - opacity * q) / (1 - alpha) - mean.square()
    return mean, (12 * variance.clamp_min(LEAST_VARIANCE)).sqrt()


def clamp_center(center: Tensor, width: Tensor) -> Tensor:
    """Move a window's center so that the window stays within FARTHEST of its pixel's center."""
    room = FARTHEST - width / 2
    return torch.minimum(torch.maximum(center, -room), room)


def moments(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(p, m, q) of windows `width` px wide and u px from the center of a Gaussian of standard deviation `sigma` px."""
    wide = width <= WIDE * sigma
    limit = width / WIDE
    # The arguments of each formula are clamped to its range: a branch that is not taken must not overflow, or its gradient is NaN.
    pairs = zip(quadrature(u, width, sigma.maximum(limit)), differences(torch.where(wide, 0.0, u), width, sigma.minimum(limit)), strict=True)
    p, m, q = (torch.where(wide, by_quadrature, by_difference) for by_quadrature, by_difference in pairs)
    return p, m, q


def quadrature(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`moments` by Gauss-Legendre quadrature."""
    s = width[..., None] / 2 * u.new_tensor(POINTS)
    g = u.new_tensor(WEIGHTS) * torch.exp(-((u[..., None] + s) / sigma[..., None]).square() / 2)
    return g.sum(-1), (s * g).sum(-1), (s.square() * g).sum(-1)


def differences(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`moments` from the Gaussian and its integral at both ends of the window."""
    first, last = u - width / 2, u + width / 2
    g_first, g_last = (torch.exp(-(t / sigma).square() / 2) for t in (first, last))
    # Not abs(t), whose gradient is 0 where an end of the window passes through the center.
    tails = [torch.special.erfc(torch.where(t < 0, -t, t) / sigma * math.sqrt(0.5)) for t in (first, last)]
    mass = torch.where((first < 0) & (last >= 0), 2 - tails[0] - tails[1], (tails[0] - tails[1]).abs())
    p = math.sqrt(math.pi / 2) * sigma * mass / width
    m = -sigma.square() * (g_last - g_first) / width - u * p
    return p, m, sigma.square() * (p - (last * g_last - first * g_first) / width) - u * (2 * m + u * p)
