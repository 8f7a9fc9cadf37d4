"""The closed form: scales and opacities at another scale, corrected for a screen filter of fixed size in pixels, without optimization.

A checkpoint trained with a filter of e px² shows the covariance Σ + e·ρ², where ρ is the size of a base pixel at the splat's distance, in
world units. At scale s a pixel measures ρ/s, and the filter of the adapted file, of e' px², adds e'·(ρ/s)² instead. So the splat's
covariance has to become

    Σ' = Σ + e·ρ² - e'·(ρ/s)².

Zoom-out (s < 1) narrows the splats. A variance cannot become negative: where a splat stays too wide, its opacity is lowered. A target
filter that compensates lowers opacities itself, for a thin splat to almost 0: there an axis becomes narrower only as far as a higher
opacity can make up for, so that the blend weight stays the same. For a viewer that leaves out small splats, no splat becomes that small.

Zoom-in (s > 1) widens the splats, but by less: the images that a base was trained on are averages over pixels, which have a variance of
p = 1/12 px², and the adapted images should be averages over their own, smaller pixels. Σ + e·ρ² includes this average, so that e and e'
are both reduced by p, and the opacity is raised by the area that is lost. Images of the base's size do not show how thin a splat is whose
Σ is nearly 0: training would have made it thinner if it could. All values from p = 1/12 to p = e give nearly the same image. A larger p is
crisper (`FormSettings.crispness`): with p = e splats keep their size, and only opacity makes up for what a zoom takes off them. It cannot
rise above 1, so that a splat becomes narrower only as far as its opacity allows: what covers its pixels is no thin line.

A file that is rendered with the base's own filter needs no change if that filter integrates over the pixel. One that compensates models the
pixel in each view too, but with a variance of its own, and overlapping splats whose opacities it lowers let through more than their means
would: with matched opacities the closed form is better by 2 to 8 dB, but near the base's scale it is not. Without these, and before the steps
of a zoom-out, it is left out.

Opacities from areas are exact for splats that hide nothing; where blend weights are known they are matched afterwards (`matching`).

At zoom-out the distance is that of the closest view, which saw the finest detail that training could resolve (as for the 3D filter of
Mip-Splatting): elsewhere splats then stay too wide, and lower opacities make up for it. At zoom-in they would leave holes in views from
farther away, so they are widened for the mean of the views (`mean_pixel_size`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import in_batches, in_chunks
from mipmap_plugin.adaptation.start.surfel_form import visible_area, widened_for_slant, widened_to_filter
from mipmap_plugin.adaptation.views.pixel_size import enough_views, mean_pixel_size, pixel_size
from mipmap_plugin.backends.cpu import summed_areas
from mipmap_plugin.camera import Camera, every_nth
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.camera_tensors import CameraTensors
from mipmap_plugin.splatting.filters import INTEGRALS, SQUARE_VARIANCE, compensates, footprint, widening
from mipmap_plugin.splatting.projection import Projected, axes_of, project

# Target pixels: the minimum scale of an axis. At 1/50 of the classic dilation's width it is invisible, and its logarithm is finite.
MIN_AXIS = 0.01

# Target pixels: before steps no axis is narrowed further. What is narrowed to a line looks like one from nearer than the views, which their dB do not
# tell: those behind the cameras, for one. Steps make up for what it is too wide; without them captures lose 0.3 dB.
LEAST_AXIS = 0.3

# Opacity falls with this power of the area where blend weights are not matched afterwards (`matching`). For a single splat 1 is exact, but
# the tails of many overlap and their opacities add up: best between 1.15 and 1.3 on lego and chair at x1/2 to x1/8.
AREA_POWER = 1.25

# The closed form keeps variances this many times above the threshold at which a viewer leaves splats out, since foreshortening reduces them.
CULL_MARGIN = 2.0


@dataclass(frozen=True)
class FormSettings:
    """Settings of the closed form that the base's images do not determine."""

    area_power: float = AREA_POWER  # zoom-out: opacity falls with this power of the area
    crispness: float = 0.0  # 0..1, zoom-in: the base's images are averages over a pixel (0), or over the whole filter (1)
    views: int | None = None  # how many are looked at, evenly spread, where it is known how much they show; None: `enough_views`
    pixel: Tensor | None = None  # the size of a base pixel at each splat [N], in world units; None: it is computed
    matched: bool = False  # whether opacities are matched afterwards (`matching`)
    least_axis: float = 0.0  # zoom-out, target pixels: no axis becomes narrower than this, or than it is (`LEAST_AXIS`)


def closed_form(
    gaussians: Gaussians, views: Sequence[Camera], scale: float, base: Effects, target: Effects, form: FormSettings = FormSettings()
) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and opacities [N] that look right at `scale`.

    `views`: cameras of the base scale. `base`: how the base was rendered in training. `target`: how the result is rendered.
    """
    if filter_suffices(base, target) or (draws_alike(base, target) and not form.matched):
        return gaussians.scales, gaussians.opacities
    count = form.views or enough_views(gaussians.means, views)
    size = pixel_size if scale <= 1 else mean_pixel_size
    change = _Change(every_nth(views, count), scale, base, target, form)
    pixels = size(gaussians.means, views, count) if form.pixel is None else form.pixel
    formed = in_chunks(lambda chunk: change.of(gaussians[chunk], pixels[chunk]), gaussians.means)
    scales, opacities = zip(*formed, strict=True)
    return torch.cat(scales), torch.cat(opacities)


@dataclass(frozen=True)
class _Change:
    """From what the base looks like to what the result does, by some views."""

    views: Sequence[Camera]  # of the base scale
    scale: float
    base: Effects
    target: Effects
    form: FormSettings

    @cached_property
    def zoomed(self) -> list[Camera]:
        return [view.zoomed(self.scale) for view in self.views]

    def of(self, gaussians: Gaussians, base_pixel: Tensor) -> tuple[Tensor, Tensor]:
        """`closed_form` of some of the splats; `base_pixel` [N]: in world units."""
        base, target, scale = self.base, self.target, self.scale
        if target.screen_filter == SURFEL:
            return self._of_surfels(gaussians, base_pixel)
        own, base_area, target_area = gaussians.scales.square(), base_pixel.square()[:, None], (base_pixel / scale).square()[:, None]
        least, most = _averaging_variances(base, self.form.crispness) if scale > 1 else (0.0, 0.0)
        averaging = least + (most - least) * _unknown(own, base_area, base)
        wide = own + (filter_variance(base) - averaging) * base_area
        narrow = (wide - (filter_variance(target) - averaging) * target_area).clamp_min(0)
        if scale <= 1:
            narrow = narrow.maximum(own.minimum(self.form.least_axis**2 * target_area))
        # An area shrinks only by the factor by which the opacity can rise.
        narrow = narrow.maximum(gaussians.opacities[:, None] * (own + _dilation(base) * base_area) - _dilation(target) * target_area)
        thinnest = torch.full_like(narrow, MIN_AXIS**2).scatter(1, wide.topk(2, dim=1).indices, max(MIN_AXIS**2, min_variance(target)))
        scales = narrow.maximum(thinnest * target_area).sqrt()
        new = replace(gaussians, scales=scales)
        opacities = gaussians.opacities * _compensation(gaussians, self.views, base)
        areas = self._area_ratio(gaussians, new, self._max_area_ratio(most))
        opacities = opacities * areas ** (self.form.area_power if scale <= 1 and not compensates(target.screen_filter) else 1.0)
        # The compensation of the target's renderer is divided out beforehand.
        return scales, (opacities / _compensation(new, self.zoomed, target)).clamp_max(1)

    def _max_area_ratio(self, averaging: float) -> float:
        """The largest factor of an opacity. It is exact for a splat of no size of its own; in a distant view all splats look like that."""
        if averaging:
            return filter_variance(self.base) / (filter_variance(self.base) - averaging + averaging / self.scale**2)
        return torch.inf if compensates(self.target.screen_filter) else 1.0

    def _area_ratio(self, old: Gaussians, new: Gaussians, limit: float) -> Tensor:
        """[N], at most `limit`: the area of an old splat in the base over that of the new one in the target.

        Both are sums over the views, as blend weights are: the mean of the views' ratios would follow the many distant views of a walk, and take a
        splat away from the close one.
        """
        variances = filter_variance(self.base) * self.scale**2, filter_variance(self.target)
        axes = [axes_of(each.quats, each.scales) for each in (old, new)]

        def areas(_: CameraTensors, projected: Projected) -> Tensor:
            new_projected = projected.with_axes(axes[1]) if new.covariances is None else projected
            return torch.stack([projected.dilated_det(variances[0]), new_projected.dilated_det(variances[1])]).sqrt()

        near, plain = self.base.near_plane, old.covariances is None
        known = summed_areas(old.means, zip(axes, variances, strict=True), self.zoomed, near) if plain else None
        before, after = _mean_in_front(old, self.zoomed, near, areas) if known is None else known
        ratio = (before / after).to(old.opacities)
        return torch.where(ratio.isfinite(), ratio, 1.0).clamp_max(limit)  # areas beyond the type's range: the splat keeps its opacity

    def _of_surfels(self, gaussians: Gaussians, base_pixel: Tensor) -> tuple[Tensor, Tensor]:
        """Scales [N, 3] and opacities [N] of surfels (`surfel_form`); `base_pixel` [N]: in world units."""
        base, target, crispness = self.base, self.target, self.form.crispness

        def area_ratio(scales: Tensor) -> Tensor:
            """[N]: the visible area of splats of these scales in the target over their visible area in the base."""
            new = replace(gaussians, scales=scales)

            def ratio(camera: CameraTensors, projected: Projected) -> Tensor:
                base_area = visible_area(projected, base.eps2d * self.scale**2)
                return visible_area(project(new, camera, target.near_plane), target.eps2d) / base_area

            return _mean_in_front(gaussians, self.zoomed, base.near_plane, ratio)

        if self.scale <= 1:
            return gaussians.scales, gaussians.opacities / area_ratio(gaussians.scales) ** AREA_POWER
        wide = widened_to_filter(gaussians.scales, base_pixel, base.eps2d)
        wide = widened_for_slant(gaussians.scales, wide, 1 / area_ratio(wide))
        if crispness == 0:
            return wide, gaussians.opacities
        shown, crisp = gaussians.opacities * area_ratio(wide), wide.square().lerp(gaussians.scales.square(), crispness).sqrt()
        crisp = (crisp * (shown / area_ratio(crisp)).clamp_min(1)[:, None]).minimum(wide)  # as far as the opacity can rise
        return crisp, (shown / area_ratio(crisp)).clamp_max(1)


def filter_suffices(base: Effects, target: Effects) -> bool:
    """Whether the target's own filter adapts the splats to any scale: it integrates over the pixel, and that of the base compensates."""
    return target.screen_filter in INTEGRALS and compensates(base.screen_filter) and base.screen_filter != SURFEL


def draws_alike(base: Effects, target: Effects) -> bool:
    """Whether base and target have the same filter, which compensates."""
    same = (base.screen_filter, base.eps2d) == (target.screen_filter, target.eps2d)
    return same and compensates(target.screen_filter) and target.screen_filter != SURFEL


def min_variance(effects: Effects) -> float:
    """The minimum variance (target px²) of a splat's two longer axes for which the viewer does not leave it out."""
    return CULL_MARGIN * max(0.0, effects.settings.min_variance - filter_variance(effects), effects.settings.least_spread)


def filter_variance(effects: Effects) -> float:
    """The variance that the screen filter adds, in px²."""
    return widening(effects.screen_filter, effects.eps2d)


def _dilation(effects: Effects) -> float:
    """The variance (px²) by which the screen filter makes a splat cover more, without lowering its opacity."""
    return 0.0 if compensates(effects.screen_filter) else filter_variance(effects)


def _averaging_variances(base: Effects, crispness: float) -> tuple[float, float]:
    """The least and the largest variance (px²) over which the base's images are averages: a pixel's, and up to that of the filter (crispness 1)."""
    pixel = min(SQUARE_VARIANCE, filter_variance(base))
    return pixel, pixel + crispness * (filter_variance(base) - pixel)


def _unknown(own: Tensor, base_area: Tensor, base: Effects) -> Tensor:
    """How little the base tells of the width of splats of these variances [N, 3] along each axis, 0..1; `base_area` [N, 1]: of a base pixel.

    Training made a splat that is wider than a pixel as wide as its images wanted. One that is far thinner would be thinner still if it could, nobody
    knows by how much. With a filter that compensates, training cannot narrow an opaque splat at all.
    """
    pixel = SQUARE_VARIANCE * base_area
    return torch.ones_like(own) if compensates(base.screen_filter) else pixel / (pixel + own)


def _compensation(gaussians: Gaussians, views: Sequence[Camera], effects: Effects) -> Tensor | float:
    """[N], at most 1: the screen filter's compensation, by which it multiplies a splat's opacity, averaged over views."""
    if not compensates(effects.screen_filter):
        return 1.0
    # An integral over the pixel compensates as a Gaussian of the pixel's variance does.
    name = "mip" if effects.screen_filter in INTEGRALS else effects.screen_filter
    ones = torch.ones_like(gaussians.opacities)
    variance = filter_variance(effects)
    return _mean_in_front(gaussians, views, effects.near_plane, lambda _, projected: footprint(projected, ones, name, variance).opacities)


def _mean_in_front(gaussians: Gaussians, views: Sequence[Camera], near: float, quantity: Callable[[CameraTensors, Projected], Tensor]) -> Tensor:
    """[..., N]: the mean of `quantity(view, projection)` over the views that a splat lies in front of; 1 where there is none."""
    total, count = torch.zeros_like(gaussians.opacities), torch.zeros_like(gaussians.opacities)
    axes = axes_of(gaussians.quats, gaussians.scales)
    for view in in_batches(views, gaussians.means):
        projected = project(gaussians, view, near, axes=axes)
        in_front = projected.depths > near
        total, count = total + torch.where(in_front, quantity(view, projected), 0.0).sum(-2), count + in_front.sum(0)
    return torch.where(count > 0, total / count.clamp_min(1), 1.0)
