"""How splats are rasterized, as data: what is left out, in which order the rest is drawn, and what is rounded."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from mipmap_plugin.allowed import OF_EVEN_BUCKETS, OF_PACKING, OF_SETTINGS, check
from mipmap_plugin.errors import SettingsError

# Thresholds of every 3DGS rasterizer (diff-gaussian-rasterization, forward.cu).
MIN_ALPHA = 1 / 255  # below one 8-bit step a splat cannot change a displayed pixel
MIN_TRANSMITTANCE = 1e-4  # a pixel with less is finished

# The largest alpha in every 3DGS rasterizer (diff-gaussian-rasterization, forward.cu): it keeps 1 - alpha away from 0, where the gradient of
# everything behind the splat vanishes.
MAX_ALPHA = 0.99

# The fraction of the half field of view by which a center may lie outside the image before the Jacobian is frozen there; farther out,
# the affine approximation would make splats far too large (diff-gaussian-rasterization, forward.cu; gsplat, Utils.cuh).
FRUSTUM_MARGIN = 0.3

# Kernels divide by what a splat lets through and by what is left behind all splats. These keep both away from 0, and change no picture by 1e-6.
MOST_OPAQUE, LEAST_LEFT = 1 - 2**-20, 1e-30

# Rounding errors of a quotient that is meant to be whole.
STEP_TOLERANCE = 1e-6

TILE = 16  # px


@dataclass(frozen=True)
class Packing:
    """Quantization of splats in a viewer's memory: values are rounded to the nearest multiple of a step. None: not rounded.

    Attributes:
        opacity: Steps of successive roundings.
        color: Step of the color of SH degree 0, which is clamped to 0..1.
        downwards: Opacities and colors are rounded down.
        bands: Steps of the coefficients of SH degree 1, 2, ..., clamped to -1..1.
        log_scales: Minimum, maximum and step of the natural logarithms.
        quats: How rotations are stored (`splatting.packing`).
        half_means: Means are float16, in the world and again relative to the eye.
    """

    opacity: tuple[float, ...] = (1 / 255,)
    color: float | None = None
    downwards: bool = False
    bands: tuple[float, ...] = ()
    log_scales: tuple[float, float, float] | None = None
    quats: Literal["octahedral", "stereographic"] | None = None
    half_means: bool = False

    def __post_init__(self) -> None:
        check("packing", self, OF_PACKING, optional=frozenset({"color", "log_scales", "quats"}))


@dataclass(frozen=True)
class EvenBuckets:
    """An order of splats by buckets of depth that are all equally long (`splatting.buckets`).

    Attributes:
        steps: Buckets from the nearest center to the farthest, less one; None: a number that grows with that of the splats.
        sphere_from: World units; the buckets divide a sphere around all splats instead, from this depth on.
        later_in_front: Whether of two splats in a bucket the later row is in front.
        largest_first: Rows are first sorted by volume times opacity, the largest first.
    """

    steps: int | None = None
    sphere_from: float | None = None
    later_in_front: bool = False
    largest_first: bool = False

    def __post_init__(self) -> None:
        check("even buckets", self, OF_EVEN_BUCKETS, optional=frozenset({"steps", "sphere_from"}))


@dataclass(frozen=True)
class RenderSettings:
    """How splats are rasterized, and which are left out. `tile` affects only the time. Viewers' own settings are in `splatting.viewers`.

    A splat that is culled (by `min_variance`, `min_contribution` or `least_spread`) is not rendered, but has a gradient (`splatting.culls`).

    Attributes:
        min_alpha: A splat of lower alpha is skipped in a pixel.
        min_transmittance: A pixel ends before the splat that would leave less.
        radius: Standard deviations at which a splat ends; None: where its alpha falls below `min_alpha`.
        tile: px: pixels that share a list of splats.
        max_alpha: Alpha of a splat in a pixel is clamped to this.
        fades: A splat falls to 0 at `radius`: its weight w becomes (w - w_end) / (1 - w_end), where w_end is the weight at `radius`.
        max_color: Limit of a splat's color, in each channel.
        color_steps: A splat's red, green and blue are rounded to multiples of these, which divide `max_color`.
        radial: Splats are sorted by their distance to the eye instead of by depth.
        bucketed: Splats are sorted by PlayCanvas's buckets of depth (`splatting.buckets`).
        even_buckets: Splats are sorted by buckets that are all of one length.
        min_variance: px², after dilation: splats whose variance along their longer axis is less are culled.
        boxed: `min_variance` is compared with the larger variance along x and y instead; `max_half_axis` then limits those too.
        min_contribution: px², after dilation: splats whose opacity · sqrt(det) is less are culled.
        rooted: `min_contribution` is compared with sqrt(opacity · det) instead.
        least_spread: px², after dilation: minimum distance of variances from their mean; splats whose smaller one becomes 0 are culled.
        level_below: px²: those whose |xy| is less are stretched along (√10 · least_spread, up) instead of (xy, up) (`splatting.culls`).
        max_half_axis: px, at `radius`: longer half-axes are shortened to this; with `boxed` the whole splat shrinks before.
        fits_picture: Half-axes are also limited to the picture's shorter side.
        packing: Quantization of splats in memory.
        frozen_beyond: The Jacobian is frozen so far outside the picture, in halves of its width and height; infinity: nowhere.
        frozen_by_width: It is frozen 1 + `frozen_beyond` half widths from the axis of view instead, along y too.
        frame: In halves of the picture from its middle: splats whose center lies farther out along x or y are not rendered.
        linear_light: Splats are blended in linear light: colors to this power; the picture is sRGB of what comes out.
        picture_step: The picture is rounded to multiples after each splat, back to front; the gradient ignores the rounding.
    """

    min_alpha: float = MIN_ALPHA
    min_transmittance: float = MIN_TRANSMITTANCE
    radius: float | None = None
    tile: int = TILE
    max_alpha: float = MAX_ALPHA
    fades: bool = False
    max_color: float | None = None
    color_steps: tuple[float, float, float] | None = None
    radial: bool = False
    bucketed: bool = False
    even_buckets: EvenBuckets | None = None
    min_variance: float = 0.0
    boxed: bool = False
    min_contribution: float = 0.0
    rooted: bool = False
    least_spread: float = 0.0
    level_below: float = 0.0
    max_half_axis: float = math.inf
    fits_picture: bool = False
    packing: Packing | None = None
    frozen_beyond: float = FRUSTUM_MARGIN
    frozen_by_width: bool = False
    frame: float = math.inf
    linear_light: float | None = None
    picture_step: float | None = None

    def __post_init__(self) -> None:
        check("render settings", self, OF_SETTINGS, optional=frozenset({"radius", "max_color", "color_steps", "picture_step", "linear_light"}))
        if not isinstance(self.packing, Packing | None):
            raise SettingsError(f"render settings: packing must be a Packing, or None, got {type(self.packing).__name__}")
        if not isinstance(self.even_buckets, EvenBuckets | None):
            raise SettingsError(f"render settings: even_buckets must be EvenBuckets, or None, got {type(self.even_buckets).__name__}")
        if self.fades and self.radius is None:
            raise SettingsError("`fades` needs the radius at which a splat falls to 0; give radius, such as 8**0.5")
        if self.radial + self.bucketed + (self.even_buckets is not None) > 1:
            raise SettingsError("`radial`, `bucketed` and `even_buckets` are different orders of splats; give only one of them")
        if self.linear_light is not None and not all(value is None for value in (self.max_color, self.color_steps, self.picture_step, self.packing)):
            raise SettingsError("`linear_light` goes with no packing, and with no limit or rounding of colors or of the picture; leave those out")
        largest = self.max_color or 0.0
        for step in self.color_steps or ():
            if abs(largest / step - round(largest / step)) > STEP_TOLERANCE:
                raise SettingsError(f"max_color must be a multiple of each of color_steps, or colors pass it, got {largest} and {step}")
        if self.radius is None and (self.fits_picture or self.max_half_axis < math.inf):
            raise SettingsError("`max_half_axis` and `fits_picture` need the radius at which a splat ends; give radius, such as 8**0.5")

    @property
    def culls(self) -> bool:
        """Whether any splats are culled."""
        return max(self.min_variance, self.min_contribution, self.least_spread) > 0

    @property
    def divisible(self) -> tuple[float, float]:
        """`max_alpha` and `min_transmittance` as kernels use them, which divide by what is left of a pixel."""
        return min(self.max_alpha, MOST_OPAQUE), max(self.min_transmittance, LEAST_LEFT)

    def max_variance(self, width: int, height: int) -> float:
        """The largest variance (px², after dilation) of a splat in a picture of this size."""
        longest = min(self.max_half_axis, width, height) if self.fits_picture else self.max_half_axis
        return math.inf if self.radius is None else (longest / self.radius) ** 2

    @property
    def by_view(self) -> bool:
        """Whether the splats are made ready for each view: such views are drawn one by one, and no backend moves the splats itself."""
        return self.packing is not None or self.linear_light is not None

    def changed(self) -> list[str]:
        """The names of the settings that differ from the defaults."""
        if self == USUAL:  # a quick answer, as this is asked for every image
            return []
        return [f.name for f in fields(self) if getattr(self, f.name) != getattr(USUAL, f.name)]

    def without_color_rounding(self) -> RenderSettings:
        """These settings without limits, rounding and light of colors, for images whose colors are other quantities."""
        packing = None if self.packing is None else replace(self.packing, color=None, bands=())
        return replace(self, max_color=None, color_steps=None, packing=packing, linear_light=None, picture_step=None)

    def finer(self, n: float) -> RenderSettings:
        """These settings for an image with n times as many pixels along each axis: areas in px² are scaled by n²."""
        areas = {name: getattr(self, name) * n**2 for name in ("min_variance", "min_contribution", "least_spread", "level_below")}
        return replace(self, **areas, max_half_axis=self.max_half_axis * n) if self.culls or self.max_half_axis < math.inf else self


USUAL = RenderSettings()
