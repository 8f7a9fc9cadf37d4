"""The start that needs no optimization: what a screen filter of fixed size in pixels does wrong at another scale, solved for.

A checkpoint trained with a filter of e px² shows Σ + e·ρ², where ρ is the size of a base pixel at the splat's distance, in
world units. At scale s a pixel measures ρ/s, and the filter of the adapted file, of e' px², adds e'·(ρ/s)² instead. So the splat
itself has to become

    Σ' = Σ + e·ρ² - e'·(ρ/s)².

Zoom-out (s < 1) narrows, and an axis cannot become narrower than nothing: what is left too wide is paid for in opacity. A target that
compensates pays for width by itself, and takes from a thin splat nearly all of its opacity: there an axis becomes narrower by no more than
the opacity can rise for, so that the splat adds as much to an image as before. One that leaves small splats out gets none so small.

Zoom-in (s > 1) widens, but less than that: the pictures that a base was trained on are averages over pixels, which is p = 1/12 px² of
variance, and so should be those that it is to show. The world is what Σ + e·ρ² is the average of, so that e and e' are each less by p, and
opacity rises by the area that is lost (+0.3 dB after the default steps on photographs of lego and chair at x2 and x4). How much of e is
such an average, and how much is a splat's own extent, no image of the base's size tells: anything from p = 1/12 to p = e shows it the same picture,
nearly. More is crisper: with p = e splats keep their size, and opacity alone makes up for what a zoom takes off them (`Form.crispness`).

A file that is drawn by the base's own filter needs nothing where that filter compensates: it does what a pixel does, view by view. Wider
splats would cost a base of Mip-Splatting 10 dB against the truth at x4.

The distance is that of the closest view, which saw the finest detail that training could hold (as the 3D filter of Mip-Splatting
argues); the mean distance costs 0.3 to 0.7 dB at zoom-in on lego and the demo scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.surfel_form import lay_out, least_sizes, shown_area
from mipmap_plugin.camera import Camera, every_nth
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.filters import INTEGRALS, SQUARE_VARIANCE, compensates, footprint, widening
from mipmap_plugin.splatting.projection import Projected, project

# Target pixels: how thin an axis may become. It is 1/50 of the classic dilation's width, so nobody sees it, and its log is finite.
THINNEST = 0.01

# How much faster than its area a splat's opacity falls where blend weights are not matched afterwards (`matching`). One splat alone asks
# for 1, but the tails of many overlap and cover more together than each adds: best between 1.15 and 1.3 on lego and chair at x1/2 to x1/8.
AREA_POWER = 1.25

# How far above the size at which a viewer leaves splats out the closed form keeps them: foreshortened, they are smaller.
CLEAR_OF_CULLS = 2.0

# Views that the distance and the area of a splat are taken from; more change a result of this accuracy by nothing.
ENOUGH_VIEWS = 12


@dataclass(frozen=True)
class Form:
    """What the base's images leave open."""

    area_power: float = AREA_POWER  # how much faster than its area an opacity falls at zoom-out
    crispness: float = 0.0  # 0..1, zoom-in: 0, pictures are averages over a pixel; 1, over all that the base's filter adds


def closed_form(
    gaussians: Gaussians, views: Sequence[Camera], scale: float, base: Effects, target: Effects, form: Form = Form()
) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and opacities [N] that look right at `scale`.

    `views` are cameras of the base scale, `base` is how the base was trained, `target` how the result is rendered.
    """
    if needs_nothing(scale, base, target):
        return gaussians.scales, gaussians.opacities
    views = every_nth(views, ENOUGH_VIEWS)
    base_pixel = pixel_size(gaussians.means, views)
    if target.screen_filter == SURFEL:
        return _of_surfels(gaussians, views, scale, (base, target), base_pixel, form)
    target_pixel = base_pixel / scale
    averaged = _averaged(base, form.crispness) if scale > 1 else 0.0
    wide = gaussians.scales.square() + ((_width(base) - averaged) * base_pixel**2)[:, None]
    narrow = (wide - ((_width(target) - averaged) * target_pixel**2)[:, None]).clamp_min(0)
    if compensates(target.screen_filter):  # an area may become smaller by as much as the opacity can rise
        narrow = narrow.maximum(gaussians.opacities[:, None] * wide)
    thinnest = torch.full_like(narrow, THINNEST**2).scatter(1, wide.topk(2, dim=1).indices, max(THINNEST**2, _least_variance(target)))
    scales = narrow.maximum(thinnest * target_pixel[:, None].square()).sqrt()
    new = replace(gaussians, scales=scales)
    opacities = gaussians.opacities * _light(gaussians, views, base)
    # A splat of no size of its own rises most; a view from afar, in which every splat has none, must not raise it further.
    most = _width(base) / (_width(base) - averaged + averaged / scale**2) if averaged else torch.inf if compensates(target.screen_filter) else 1.0
    areas = _area_ratio(gaussians, new, views, scale, (base, target), most)
    opacities = opacities * areas ** (form.area_power if scale <= 1 and not compensates(target.screen_filter) else 1.0)
    # What the target's renderer takes off by itself is added before.
    return scales, (opacities / _light(new, [view.zoomed(scale) for view in views], target)).clamp_max(1)


def needs_nothing(scale: float, base: Effects, target: Effects) -> bool:
    """Whether the target's own filter does what the scale asks for: it is the base's, and keeps each splat's light."""
    same = (base.screen_filter, base.eps2d) == (target.screen_filter, target.eps2d)
    if target.screen_filter == SURFEL or (not same and target.screen_filter not in INTEGRALS):
        return False
    return compensates(target.screen_filter) and compensates(base.screen_filter)


def _of_surfels(
    gaussians: Gaussians, views: Sequence[Camera], scale: float, effects: tuple[Effects, Effects], base_pixel: Tensor, form: Form
) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and opacities [N] of surfels (`surfel_form`); `effects` of base and target, `base_pixel` [N] world units."""
    base, target = effects
    zoomed = [view.zoomed(scale) for view in views]

    def drawn(scales: Tensor) -> Tensor:
        """[N] the area that the target will draw over the area that the base shows."""
        new = replace(gaussians, scales=scales)

        def ratio(camera: Camera, shown: Projected) -> Tensor:
            return shown_area(project(new, camera, target.near_plane), target.eps2d) / shown_area(shown, base.eps2d * scale**2)

        return _mean_in_front(gaussians, zoomed, base.near_plane, ratio)

    if scale <= 1:
        return gaussians.scales, gaussians.opacities / drawn(gaussians.scales) ** AREA_POWER
    wide = least_sizes(gaussians.scales, base_pixel, base.eps2d)
    wide = lay_out(gaussians.scales, wide, 1 / drawn(wide))
    if form.crispness == 0:
        return wide, gaussians.opacities
    crisp = wide.square().lerp(gaussians.scales.square(), form.crispness).sqrt()
    return crisp, (gaussians.opacities * drawn(wide) / drawn(crisp)).clamp_max(1)


def pixel_size(means: Tensor, views: Sequence[Camera]) -> Tensor:
    """[N] world units: the size of a pixel at each center in the closest view that sees it (of all views, if none does).

    Of many views some are asked, evenly spread.
    """
    views = every_nth(views, ENOUGH_VIEWS)
    finest, anywhere = (torch.full_like(means[:, 0], torch.inf) for _ in range(2))
    for view in views:
        x, y, z = view.to_camera(means).unbind(-1)
        size = z.abs() / (view.fx * view.fy) ** 0.5
        u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        inside = (z > 0) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
        finest = torch.where(inside, torch.minimum(finest, size), finest)
        anywhere = torch.minimum(anywhere, size)
    return torch.where(finest.isfinite(), finest, anywhere)


def _least_variance(effects: Effects) -> float:
    """Target px²: what the two longer axes of a splat must not fall below, so that a viewer does not leave it out for its size."""
    return CLEAR_OF_CULLS * max(0.0, effects.settings.min_variance - _width(effects), effects.settings.least_spread)


def _width(effects: Effects) -> float:
    """px²: the variance that the screen filter adds."""
    return widening(effects.screen_filter, effects.eps2d)


def _averaged(base: Effects, crispness: float) -> float:
    """px²: the variance of what the base's pictures are averages over, from a pixel's own to all that the base's filter adds."""
    pixel = min(SQUARE_VARIANCE, _width(base))
    return pixel + crispness * (_width(base) - pixel)


def _light(gaussians: Gaussians, views: Sequence[Camera], effects: Effects) -> Tensor | float:
    """[N], at most 1: the share of its opacity that the screen filter leaves to a splat."""
    if not compensates(effects.screen_filter):
        return 1.0
    # An integral over the pixel dims as a Gaussian of the pixel's variance does.
    name = "mip" if effects.screen_filter in INTEGRALS else effects.screen_filter
    ones = torch.ones_like(gaussians.opacities)
    return _mean_in_front(gaussians, views, effects.near_plane, lambda _, shown: footprint(shown, ones, name, _width(effects)).opacities)


def _area_ratio(old: Gaussians, new: Gaussians, views: Sequence[Camera], scale: float, effects: tuple[Effects, Effects], most: float) -> Tensor:
    """[N], at most `most`: the area that the base shows of a splat over the area that the target will draw; `effects` of both."""
    base, target = effects

    def ratio(camera: Camera, shown: Projected) -> Tensor:
        drawn = project(new, camera, target.near_plane)
        return (_det(shown, _width(base) * scale**2) / _det(drawn, _width(target))).sqrt().clamp_max(most)

    return _mean_in_front(old, [view.zoomed(scale) for view in views], base.near_plane, ratio)


def _mean_in_front(gaussians: Gaussians, views: Sequence[Camera], near: float, of: Callable[[Camera, Projected], Tensor]) -> Tensor:
    """[N]: the mean of `of(view, its projection)` over the views in front of which a splat lies; 1 where there is none."""
    total, seen = (torch.zeros_like(gaussians.opacities) for _ in range(2))
    for view in views:
        projected = project(gaussians, view, near)
        in_front = projected.depths > near
        total, seen = total + torch.where(in_front, of(view, projected), 0.0), seen + in_front
    return torch.where(seen > 0, total / seen.clamp_min(1), 1.0)


def _det(projected: Projected, eps2d: float) -> Tensor:
    return projected.det + eps2d * (projected.xx + projected.yy) + eps2d**2
