"""The screen filter of Gaussian Blending: each splat is integrated over the window through which its pixel still sees.

A pixel's window begins as its own square. Behind a splat the light that is left is no longer spread evenly over it, and the window
becomes the even spread of the same mean and variance (Koo et al. 2026), so that an edge hides what lies behind it and not a share of
everything. With g the splat's Gaussian along one of its axes, an offset t = u + s px from its center, and a window of width a at u:

    (p, m, q) = (1/a) ∫ (1, s, s²)·g(u + s) ds over |s| <= a/2;   alpha = opacity · p_long · p_short
    mean of what is left along the long axis:       -opacity · p_short · m_long / (1 - alpha)
    mean square, before the square of the mean:     (a²/12 - opacity · p_short · q_long) / (1 - alpha)

Windows lie along x and y; a splat takes the one of its axes that is nearer to x for x. Two things differ from the published code: a
window keeps near its pixel, so that what a splat can touch is known beforehand; and where a splat is wide, the integrals are sums
over points instead of differences that cancel, so that no size needs another formula.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.effects import MAX_ALPHA
from mipmap_plugin.splatting.pixel_integral import PixelIntegral

# px²: the least variance of a window along x or y.
LEAST_VARIANCE = 1e-3
NARROWEST = math.sqrt(12 * LEAST_VARIANCE)  # px, the width of such a window

# A window of up to so many standard deviations is summed over points (five of Gauss and Legendre: right to 4e-8).
WIDE = 1.5
POINTS = (-0.9061798459386640, -0.5384693101056831, 0.0, 0.5384693101056831, 0.9061798459386640)
WEIGHTS = (0.1184634425280945, 0.2393143352496832, 0.2844444444444444, 0.2393143352496832, 0.1184634425280945)

# px: how far along x and y a window may reach from its pixel's center, twice as far as the pixel. Where splats hide the middle of a
# pixel, light is left on both sides, and the even spread of that variance is wider than the pixel.
FARTHEST = 1.0

# px: how far it reaches along x and y when it is turned by up to 45 degrees about its own center.
REACH = FARTHEST * (1 + math.sqrt(0.5))


class Windows(NamedTuple):
    """[B, P] px: where the window of each pixel lies, from the pixel's center, and how wide it is."""

    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor


class WindowIntegral(PixelIntegral):
    """Splats as windows see them."""

    ROOM: ClassVar = 8  # so many times the tensors of a Gaussian live at once

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha of splats [..., 5] that are the first of their pixels, dx, dy px from their centers. Not clamped."""
        long, short, cos, sin, opacity = packed.unbind(-1)
        one = torch.ones_like(dx)
        return opacity * moments(cos * dx + sin * dy, one, long)[0] * moments(cos * dy - sin * dx, one, short)[0]

    @staticmethod
    def alphas(packed: Tensor, dx: Tensor, dy: Tensor, least: Tensor) -> Tensor:
        """Alpha [B, K, P], 0 below `least` [B, K, 1], of splats [B, K, 1, 5] one behind the other at pixels dx, dy px from their centers."""
        zero, one = torch.zeros_like(dx[:, 0]), torch.ones_like(dx[:, 0])
        windows, seen = Windows(zero, zero, one, one), []
        for k in range(dx.shape[1]):
            alpha, after = look(packed[:, k], dx[:, k], dy[:, k], windows)
            drawn = alpha >= least[:, k]
            windows = Windows(*(torch.where(drawn, new, old) for new, old in zip(after, windows, strict=True)))
            seen.append(torch.where(drawn, alpha, 0.0))
        return torch.stack(seen, 1)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """[N] bool: finite, and bright enough to reach `min_alpha` [N] through the narrowest window.

        No more of a splat is in a window than all of it, which leaves out what is too thin to have a gradient in float32.
        """
        finite = torch.isfinite(torch.cat([self.packed(), self.xx[:, None], self.yy[:, None]], 1)).all(1)
        shares = [(math.sqrt(2 * math.pi) * width / NARROWEST).clamp_max(1) for width in (self.long, self.short)]
        return finite & (self.opacities * shares[0] * shares[1] >= min_alpha) & (self.short > 0)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """[N, 2] px, without gradient: half-sizes of a box around all pixels with alpha >= `min_alpha` [N] in any window."""
        reach = (2 * (self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1).sqrt() + REACH).detach()


def look(packed: Tensor, dx: Tensor, dy: Tensor, windows: Windows) -> tuple[Tensor, Windows]:
    """Alpha [B, P] of one splat a tile [B, 1, 5] through windows, and the windows behind it."""
    long, short, cos, sin, opacity = packed.unbind(-1)
    upright = cos.abs() < sin.abs()  # the longer axis is nearer to y
    dx, dy = dx + windows.x, dy + windows.y
    a, b = torch.where(upright, windows.height, windows.width), torch.where(upright, windows.width, windows.height)
    p, m, q = moments(cos * dx + sin * dy, a, long)
    r, n, w = moments(cos * dy - sin * dx, b, short)
    light = p * r
    opacity = torch.where(opacity * light > MAX_ALPHA, MAX_ALPHA / light.clamp_min(MAX_ALPHA / 2), opacity)
    alpha = opacity * light
    u, a = left(a, opacity * r, m, q, alpha)
    v, b = left(b, opacity * p, n, w, alpha)
    width, height = (torch.where(upright, *pair).clamp_max(2 * FARTHEST) for pair in ((b, a), (a, b)))
    x, y = windows.x + cos * u - sin * v, windows.y + sin * u + cos * v
    return alpha, Windows(near(x, width), near(y, height), width, height)


def left(width: Tensor, opacity: Tensor, m: Tensor, q: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Along one axis, where the window behind a splat lies from the one in front of it, and its width, px."""
    mean = -opacity * m / (1 - alpha)
    variance = (width.square() / 12 - opacity * q) / (1 - alpha) - mean.square()
    return mean, (12 * variance.clamp_min(LEAST_VARIANCE)).sqrt()


def near(center: Tensor, width: Tensor) -> Tensor:
    """A window's center so moved that the window reaches no further than it may."""
    room = FARTHEST - width / 2
    return torch.minimum(torch.maximum(center, -room), room)


def moments(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(p, m, q) of windows `width` px wide and u px from the center of a Gaussian of standard deviation `sigma` px."""
    wide = width <= WIDE * sigma
    limit = width / WIDE
    # Each way keeps to the sizes that it is for: what is not taken must not overflow, or its gradient is NaN.
    pairs = zip(sums(u, width, sigma.maximum(limit)), differences(torch.where(wide, 0.0, u), width, sigma.minimum(limit)), strict=True)
    p, m, q = (torch.where(wide, summed, subtracted) for summed, subtracted in pairs)
    return p, m, q


def sums(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`moments`, summed over points."""
    s = width[..., None] / 2 * u.new_tensor(POINTS)
    g = u.new_tensor(WEIGHTS) * torch.exp(-((u[..., None] + s) / sigma[..., None]).square() / 2)
    return g.sum(-1), (s * g).sum(-1), (s.square() * g).sum(-1)


def differences(u: Tensor, width: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`moments` from the Gaussian and its integral at both ends."""
    first, last = u - width / 2, u + width / 2
    g_first, g_last = (torch.exp(-(t / sigma).square() / 2) for t in (first, last))
    tails = [torch.special.erfc((t / sigma).abs() * math.sqrt(0.5)) for t in (first, last)]
    mass = torch.where((first < 0) & (last > 0), 2 - tails[0] - tails[1], (tails[0] - tails[1]).abs())
    p = math.sqrt(math.pi / 2) * sigma * mass / width
    m = -sigma.square() * (g_last - g_first) / width - u * p
    return p, m, sigma.square() * (p - (last * g_last - first * g_first) / width) - u * (2 * m + u * p)
