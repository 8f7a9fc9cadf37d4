"""The mathematics of screen filters (`screen_filters`): how a projected splat is widened, so that a grid of pixels can sample it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.screen_filters import SCREEN_FILTERS
from mipmap_plugin.splatting import culls
from mipmap_plugin.splatting.pixel_integral import PixelIntegral, integral_of
from mipmap_plugin.splatting.projection import Projected
from mipmap_plugin.splatting.window import WindowIntegral

LEAST_COMPENSATION = {name: screen_filter.min_compensation for name, screen_filter in SCREEN_FILTERS.items()}

# Filters that integrate over the pixel instead of sampling its center.
INTEGRALS = {"analytic": PixelIntegral, "window": WindowIntegral}

# px²: splats of less variance across are not drawn; they hit no pixel's center, and their gradients would overflow float32.
THINNEST = 1e-30

# px², the variance of a square of one pixel.
SQUARE_VARIANCE = 1 / 12


def widening(screen_filter: str, eps2d: float) -> float:
    """The variance that a filter adds to a splat in every direction, px²."""
    return eps2d + SQUARE_VARIANCE if screen_filter in INTEGRALS else eps2d


def compensates(screen_filter: str) -> bool:
    """Whether a filter that widens a splat lowers its opacity too, which keeps opacity times area constant."""
    return screen_filter != "classic"


@dataclass(frozen=True, eq=False)
class Footprint:
    """N splats on the image: alpha = opacity · w with w = exp(-q/2) and q = dy²/yy + (dx - shear·dy)²/across.

    A splat that fades has alpha = opacity · (w - w_end) / (1 - w_end) instead.

    The two squares follow from the Cholesky factor of the conic; a sum of squares stays accurate for needle-shaped splats, where the
    usual a·dx² + 2b·dx·dy + c·dy² cancels.
    """

    yy: Tensor  # [N] px², variance along y
    shear: Tensor  # [N] px/px, shift in x of the maximum along a row of pixels, per px in y
    across: Tensor  # [N] px², variance along x at a given y
    xx: Tensor  # [N] px², variance along x
    opacities: Tensor  # [N]
    w_end: float = 0.0  # the weight at which a splat ends
    gate: Tensor | None = None  # [N], 1, or 0 for a culled splat (`culls.gate`)

    def packed(self) -> Tensor:
        """The parameters of `alpha`, [N, 4]; [N, 5] with the gate."""
        gate = [] if self.gate is None else [self.gate]
        return torch.stack([self.yy, self.shear, self.across, self.opacities, *gate], -1)

    def alpha(self, packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha of splats [..., 4 or 5] at pixels dx, dy px from their centers, not clamped, and regardless of the gate."""
        yy, shear, across, opacity = packed.unbind(-1)[:4]
        # Divided before they are squared: the gradient of x² / v is x² / v², which overflows for splats far thinner than a pixel.
        weight = torch.exp(-((dy / yy.sqrt()).square() + ((dx - shear * dy) / across.sqrt()).square()) / 2)
        return opacity * ((weight - self.w_end) / (1 - self.w_end) if self.w_end else weight)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """Which splats are finite and reach `min_alpha` [N] somewhere, [N] bool."""
        finite = torch.isfinite(torch.stack([self.yy, self.shear, self.across, self.xx, self.opacities])).all(0)
        return finite & (self.opacities >= min_alpha) & (self.across > THINNEST)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """Half-sizes of the box around each ellipse alpha >= `min_alpha` [N], [N, 2] px, without gradient."""
        share = min_alpha / self.opacities
        reach = (-2 * (self.w_end + (1 - self.w_end) * share).log()).clamp_min(0)
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1)).sqrt().detach()


def footprint(
    projected: Projected, opacities: Tensor, screen_filter: str, eps2d: float, settings: RenderSettings = USUAL, max_variance: float = math.inf
) -> Footprint | PixelIntegral:
    """Footprints of splats under a screen filter and a viewer's settings.

    "classic" dilates by `eps2d` px²; "antialiased" and "mip" also compensate, which keeps opacity times area constant;
    "analytic" dilates and integrates over each pixel, "window" over the part of the pixel that is still visible.
    `max_variance` px²: `settings.max_variance` for the size of the image.
    """
    det = projected.dilated_det(eps2d)
    shape = projected.xx + eps2d, projected.xy, projected.yy + eps2d, det
    if screen_filter in INTEGRALS:
        return integral_of(INTEGRALS[screen_filter], shape, opacities)
    gate = culls.gate(shape, opacities, settings) if settings.culls else None
    if compensates(screen_filter):
        opacities = opacities * (projected.det / det).clamp_min(LEAST_COMPENSATION[screen_filter] ** 2).sqrt()
    if settings.least_spread and gate is not None:
        shape = culls.stretched(shape, gate > 0.5, settings.least_spread, settings.level_below)
    if max_variance < math.inf:
        shape = culls.limited(shape, max_variance, settings.boxed)
    xx, xy, yy, det = shape
    return Footprint(yy, xy / yy, det / yy, xx, opacities, w_end(settings), gate)


def w_end(settings: RenderSettings) -> float:
    """The weight at which a splat that fades ends; 0 if splats do not fade."""
    return math.exp(-(settings.radius**2) / 2) if settings.fades and settings.radius is not None else 0.0
