"""Screen filters: what is added to a projected splat so that a pixel grid can carry it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.effects import DILATION, USUAL, RenderSettings
from mipmap_plugin.splatting import culls
from mipmap_plugin.splatting.pixel_integral import PixelIntegral, integral_of
from mipmap_plugin.splatting.projection import Projected
from mipmap_plugin.splatting.window import WindowIntegral

# The least share of its opacity that a compensating filter leaves to a splat. Below it the gradient is cut off, and light is too bright.
# "antialiased" (dr_aa, gsplat 1.6): so much that flat and needle-shaped splats, whose projected area is almost zero, can still be seen.
# "mip" (Mip-Splatting): its 1e-6 under the root, which no splat is visible with. It also adds 1e-6 to det_blur, and drops a splat
# whose det is below 1e-6 px⁴ at once, which here fades.
LEAST_LIGHT = {"classic": 1.0, "antialiased": 0.005, "mip": 0.001}

# px², what each filter dilates by where nobody says otherwise. Those that integrate over the pixel need none of their own.
USUAL_EPS2D = {"classic": DILATION, "antialiased": DILATION, "mip": 0.1, "analytic": 0.0, "window": 0.0}

# What integrates instead of looking at the center of the pixel.
INTEGRALS = {"analytic": PixelIntegral, "window": WindowIntegral}

SCREEN_FILTERS = frozenset(USUAL_EPS2D)


# px², the variance of a square of one pixel.
SQUARE_VARIANCE = 1 / 12


def widening(screen_filter: str, eps2d: float) -> float:
    """px²: the variance that a filter adds to a splat, along every direction."""
    return eps2d + SQUARE_VARIANCE if screen_filter in INTEGRALS else eps2d


def keeps_light(screen_filter: str) -> bool:
    """Whether a filter that widens a splat dims it too, so that its light stays what it was."""
    return screen_filter != "classic"


@dataclass(frozen=True, eq=False)
class Footprint:
    """A splat as the pixels see it: alpha = opacity · w with w = exp(-q/2) and q = dy²/yy + (dx - shear·dy)²/across.

    One that fades has alpha = opacity · (w - w_end) / (1 - w_end) instead.

    The two squares are the Cholesky factor of the conic; a sum of squares keeps its accuracy for needles, where the usual
    a·dx² + 2b·dx·dy + c·dy² cancels.
    """

    yy: Tensor  # [N] px², variance along y
    shear: Tensor  # [N] px/px, how far the ridge moves in x per px in y
    across: Tensor  # [N] px², variance along x at a given y
    xx: Tensor  # [N] px², variance along x
    opacities: Tensor  # [N]
    w_end: float = 0.0  # the weight at which a splat is gone
    gate: Tensor | None = None  # [N], 1 or, of a splat that is culled, 0 (`culls`)

    def packed(self) -> Tensor:
        """[N, 4]: what `alpha` needs of each splat; [N, 5] with the gate."""
        gate = [] if self.gate is None else [self.gate]
        return torch.stack([self.yy, self.shear, self.across, self.opacities, *gate], -1)

    def alpha(self, packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha, not clamped, of splats [..., 4 or 5] at pixels dx, dy px from their centers; of a culled one what it would be."""
        yy, shear, across, opacity = packed.unbind(-1)[:4]
        weight = torch.exp(-(dy.square() / yy + (dx - shear * dy).square() / across) / 2)
        return opacity * ((weight - self.w_end) / (1 - self.w_end) if self.w_end else weight)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """[N] bool: finite, and bright enough to reach `min_alpha` [N] somewhere."""
        finite = torch.isfinite(torch.stack([self.yy, self.shear, self.across, self.xx, self.opacities])).all(0)
        return finite & (self.opacities >= min_alpha) & (self.across > 0)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """[N, 2] px, without gradient: the half-sizes of the box around each ellipse alpha >= `min_alpha` [N]."""
        share = min_alpha / self.opacities
        reach = (-2 * (self.w_end + (1 - self.w_end) * share).log()).clamp_min(0)
        return (reach[:, None] * torch.stack([self.xx, self.yy], -1)).sqrt().detach()


def footprint(
    projected: Projected,
    opacities: Tensor,
    screen_filter: str,
    eps2d: float,
    settings: RenderSettings = USUAL,
    max_variance: float = math.inf,
) -> Footprint | PixelIntegral:
    """What the screen filter, and a viewer's settings, make of splats.

    "classic" dilates by `eps2d` px²; "antialiased" and "mip" also scale the opacity so that the splat's light stays what it
    was; "analytic" and "window" dilate, and integrate the splat over each pixel or what is seen through it.
    `max_variance`: px², that of `settings` in a picture of this size.
    """
    xx, yy = projected.xx + eps2d, projected.yy + eps2d
    det = projected.det + eps2d * (projected.xx + projected.yy) + eps2d**2  # = xx·yy - xy² without its cancellation
    shape = xx, projected.xy, yy, det
    if screen_filter in INTEGRALS:
        return integral_of(INTEGRALS[screen_filter], shape, opacities)
    gate = culls.gate(shape, opacities, settings) if settings.culls else None
    if keeps_light(screen_filter):
        opacities = opacities * (projected.det / det).clamp_min(LEAST_LIGHT[screen_filter] ** 2).sqrt()
    if settings.least_spread and gate is not None:
        shape = culls.stretched(shape, gate > 0.5, settings.least_spread)
    if max_variance < math.inf:
        shape = culls.limited(shape, max_variance, settings.boxed)
    xx, xy, yy, det = shape
    return Footprint(yy, xy / yy, det / yy, xx, opacities, w_end(settings), gate)


def w_end(settings: RenderSettings) -> float:
    """The weight at which a splat is gone: 0 where none fades."""
    return math.exp(-(settings.radius**2) / 2) if settings.fades and settings.radius is not None else 0.0
