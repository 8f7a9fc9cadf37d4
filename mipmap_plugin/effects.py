"""Effects: what one image calls for, as data. Derived from the model, the camera and the request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians

# px²: the variance that every 3DGS rasterizer adds to a projected splat (diff-gaussian-rasterization, forward.cu).
DILATION = 0.3

# The screen filter of 2D Gaussian Splatting (`splatting.surfels`), and the variance of its low-pass, px²: a deviation of half the root of
# two (diff-surfel-rasterization, auxiliary.h).
SURFEL, LOW_PASS = "surfel", 0.5

# World units: a splat whose center is nearer than this is not drawn (diff-gaussian-rasterization, auxiliary.h).
NEAR_PLANE = 0.2

# What every 3DGS rasterizer leaves out (diff-gaussian-rasterization, forward.cu).
MIN_ALPHA = 1 / 255  # below one 8-bit step a splat cannot change a displayed pixel
MIN_TRANSMITTANCE = 1e-4  # a pixel this opaque is finished

# What every 3DGS rasterizer covers at most (diff-gaussian-rasterization, forward.cu): it keeps 1 - alpha away from 0, where the gradient of
# everything behind the splat vanishes.
MAX_ALPHA = 0.99

# The share of the half field of view by which a center may lie outside the image before the Jacobian is frozen there;
# further out the affine approximation would blow splats up (diff-gaussian-rasterization, forward.cu; gsplat, Utils.cuh).
FRUSTUM_MARGIN = 0.3

TILE = 16  # px

# Screen filters that integrate over the pixel, or over what is seen through it.
INTEGRATED = frozenset({"analytic", "window"})

# Screen filters that dim what they widen.
COMPENSATED = frozenset({"antialiased", "mip"})

# What can be drawn beside the image (`backends.geometry`), and what each costs.
OUTPUTS = {
    "depth": "an image more, whose colors are distances",
    "normals": "an image more, whose colors are directions, and the shortest axis of each splat",
}


@dataclass(frozen=True)
class Packing:
    """How coarsely a viewer keeps splats in memory. None: exactly. What is kept is the nearest multiple of a step."""

    opacity: tuple[float, ...] = (1 / 255,)  # steps, one rounding after the other
    color: float | None = None  # step of the color of SH degree 0, which is kept within 0..1
    downwards: bool = False  # opacities and colors are kept as the next lower multiple
    bands: tuple[float, ...] = ()  # steps of the coefficients of SH degree 1, 2, ..., kept within -1..1
    log_scales: tuple[float, float, float] | None = None  # the least, the most, and the step between, of natural logarithms
    quats: Literal["octahedral", "stereographic"] | None = None  # `splatting.packing`
    half_means: bool = False  # float16, in the world and again relative to the eye


@dataclass(frozen=True)
class RenderSettings:
    """How a splat becomes pixels, and what is left out. `tile` changes nothing but the time. A viewer's own are in `viewers`.

    A splat that is culled (by `min_variance`, `min_contribution` or `least_spread`) is not drawn, but has a gradient (`splatting.culls`).
    """

    min_alpha: float = MIN_ALPHA  # below it a splat is not drawn on a pixel
    min_transmittance: float = MIN_TRANSMITTANCE  # a pixel stops before the splat that would leave it less
    radius: float | None = None  # standard deviations at which a splat ends; None: where `min_alpha` ends it
    tile: int = TILE  # px: pixels that share a list of splats
    max_alpha: float = MAX_ALPHA  # a splat covers no more of a pixel
    fades: bool = False  # a splat falls to 0 at `radius`: (w - w_end) / (1 - w_end) of its weight w, instead of an end where it still has w_end
    max_color: float | None = None  # of a splat, in each channel
    color_steps: tuple[float, float, float] | None = None  # a splat's red, green and blue are the nearest multiples
    radial: bool = False  # nearer is what lies nearer to the eye, instead of what lies less deep
    bucketed: bool = False  # the order is that of PlayCanvas's buckets of depth (`splatting.buckets`)
    min_variance: float = 0.0  # px², after dilation: a splat is culled whose variance along its longer axis is less,
    boxed: bool = False  # or, where this is set, the larger of those along x and y; `max_half_axis` then measures those too
    min_contribution: float = 0.0  # px², after dilation: a splat is culled whose opacity · sqrt(det) is less
    least_spread: float = 0.0  # px², after dilation: variances lie at least so far from their mean; a splat whose smaller one is then 0 is culled
    max_half_axis: float = math.inf  # px, at `radius`: a longer half-axis is made so long; with `boxed` the whole splat is made smaller
    fits_picture: bool = False  # nor is a half-axis longer than the picture's shorter side
    packing: Packing | None = None  # how coarsely splats are kept
    frozen_beyond: float = FRUSTUM_MARGIN  # infinity: the Jacobian is frozen nowhere
    frame: float = math.inf  # halves of the picture from its middle: a splat whose center lies beyond, along x or y, is not drawn
    picture_step: float | None = None  # the picture is rounded to multiples after each splat, back to front; the gradient is of one that is not

    def __post_init__(self) -> None:
        if self.fades and self.radius is None:
            raise SettingsError("a splat that fades needs the radius at which it is gone; give radius, such as 8**0.5")
        if self.radial and self.bucketed:
            raise SettingsError("the order is that of distances or that of buckets of depth; give radial or bucketed, not both")
        if self.radius is None and (self.fits_picture or self.max_half_axis < math.inf):
            raise SettingsError("half-axes that are limited need the radius at which they end; give radius, such as 8**0.5")

    @property
    def culls(self) -> bool:
        return max(self.min_variance, self.min_contribution, self.least_spread) > 0

    def max_variance(self, width: int, height: int) -> float:
        """px²: the most that a splat's variances may be in a picture of this size, after dilation."""
        longest = min(self.max_half_axis, width, height) if self.fits_picture else self.max_half_axis
        return math.inf if self.radius is None else (longest / self.radius) ** 2

    def changed(self) -> list[str]:
        """The names of what is not as usual."""
        return [f.name for f in fields(self) if getattr(self, f.name) != getattr(USUAL, f.name)]

    def of_any_color(self) -> RenderSettings:
        """The same without what is done to colors, for images whose colors are other numbers."""
        packing = None if self.packing is None else replace(self.packing, color=None, bands=())
        return replace(self, max_color=None, color_steps=None, packing=packing, picture_step=None)

    def finer(self, n: int) -> RenderSettings:
        """The same for an image of n times as many pixels each way: areas in px² keep their size in pixels of the coarse one."""
        areas = {name: getattr(self, name) * n**2 for name in ("min_variance", "min_contribution", "least_spread")}
        return replace(self, **areas, max_half_axis=self.max_half_axis * n) if self.culls or self.max_half_axis < math.inf else self


USUAL = RenderSettings()


@dataclass(frozen=True)
class Effects:
    """How one image is rendered.

    `eps2d` is the variance of the screen filter in px² of the *output* image; supersampling keeps it there.
    """

    sh_degree: int = 3  # bands above it are not evaluated
    screen_filter: str = "classic"  # "classic" dilates; "antialiased", "mip" also keep a splat's light; the rest integrate
    eps2d: float = DILATION  # px²
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear RGB
    supersampling: int = 1  # N: N x N samples per pixel, averaged
    near_plane: float = NEAR_PLANE  # world units
    settings: RenderSettings = USUAL
    outputs: tuple[str, ...] = ()  # of OUTPUTS
    exposure: bool = False  # the colors are those of the view's photograph (`models.exposure`)

    def __post_init__(self) -> None:
        if unknown := [name for name in self.outputs if name not in OUTPUTS]:
            raise SettingsError(f"there is no output {unknown[0]!r}; what can be drawn beside the image is {', '.join(OUTPUTS)}")


@dataclass(frozen=True)
class Effect:
    """One thing that can be simulated, whether it is called for here, and why."""

    name: str
    on: bool
    reason: str
    cost: str  # counted: what it takes where it is on, and what is saved where it is off

    def __str__(self) -> str:
        return f"{self.name}: {'on' if self.on else 'off'}, {self.reason} ({'costs' if self.on else 'saves'} {self.cost})"


EXPOSURE = Effect("exposure", False, "the checkpoint has none", "a product with a 3 x 3 matrix a pixel")

# What only some families do; a model that does it says so itself (`models.base.effects_of`).
OF_OTHER_MODELS = (
    Effect("view-dependent geometry", False, "the splats are the same for every camera", "decoding them for each"),
    Effect("levels of detail", False, "every splat is there at every distance", "a distance and a comparison a splat"),
    Effect("time", False, "nothing moves", "a pass through a field for each image"),
    Effect("appearance embedding", False, "all views share one appearance", "more inputs of a color network"),
    EXPOSURE,
    Effect("3D filter", False, "no splat has one", "three roots a splat"),
)


def explain(
    effects: Effects, gaussians: Gaussians, of_model: Sequence[Effect] = (), config: AdaptConfig | None = None, scale: float = 1.0
) -> tuple[Effect, ...]:
    """Every effect that is known here, on or off, with its reason and its cost.

    `of_model`: what the model says of itself; `config` and `scale`: of an adaptation, if it is one that is asked about.
    """
    said = {effect.name: effect for effect in (*OF_OTHER_MODELS, *of_model)}
    if effects.exposure:
        said["exposure"] = replace(said["exposure"], on=True, reason="asked for: exposure.json has this view's")
    own = [said[effect.name] for effect in OF_OTHER_MODELS]
    return (*own, *_of_rendering(effects, gaussians), *_of_adapting(config, scale))


def enlarges(config: AdaptConfig, scale: float) -> bool:
    """Whether the truth of an adaptation is an image made larger."""
    return scale > 1 and config.compare_at == "target"


def _of_rendering(effects: Effects, gaussians: Gaussians) -> list[Effect]:
    integrates, n, given = effects.screen_filter in INTEGRATED, effects.supersampling, gaussians.covariances is not None
    size = "over the area of a pixel" if integrates else f"{effects.eps2d:g} px²"
    exponentials = "five exponentials more for each splat on each pixel" if integrates else "two sums and a determinant a splat"
    extra = "two products of matrices a splat"
    return [
        _view_dependent_color(effects.sh_degree, gaussians),
        Effect("screen filter", effects.eps2d > 0 or integrates, f"{effects.screen_filter}, {size}", exponentials),
        Effect("compensation", effects.screen_filter in COMPENSATED, f"the screen filter is {effects.screen_filter}", "one root a splat"),
        Effect("supersampling", n > 1, f"{n * n} sample{'s' if n > 1 else ''} a pixel", f"{n * n if n > 1 else 'N x N'} times the pixels"),
        *_of_a_viewer(effects.settings),
        Effect("covariances", given, "the model gives them" if given else "quaternions and scales suffice", extra),
        *(Effect(name, name in effects.outputs, "asked for" if name in effects.outputs else "not asked for", cost) for name, cost in OUTPUTS.items()),
    ]


def _of_a_viewer(settings: RenderSettings) -> list[Effect]:
    """What a viewer does beside its screen filter."""
    size, light, spread = settings.min_variance, settings.min_contribution, settings.least_spread
    ends = f"a splat {'falls to 0' if settings.fades else 'is cut'} at {settings.radius or 0:.3g} standard deviations"
    which = "larger variance along x and y" if settings.boxed else "variance along its longer axis"
    culled = "not drawn is a splat whose"
    stretched = f"variances lie {spread:.3g} px² from their mean at least, and a splat that would end at 0 is not drawn"
    largest = settings.fits_picture or settings.max_half_axis < math.inf
    longest = [f"{settings.max_half_axis:g} px"] * (settings.max_half_axis < math.inf) + ["the picture's shorter side"] * settings.fits_picture
    limited = f"a splat's half-axes are no longer than {' and '.join(longest)}"
    root, limit = "a root and a comparison a splat", settings.max_color
    rounded = settings.packing is not None or settings.color_steps is not None
    parts = [
        ("edge", settings.radius is not None, ends, f"a splat ends where it is below {settings.min_alpha:.2g}", "an exponential a splat"),
        ("size cull", size > 0, f"{culled} {which} is below {size:.3g} px²", "no splat is too small to be drawn", root),
        ("contribution cull", light > 0, f"{culled} opacity · sqrt(det) is below {light:.3g} px²", "no splat gives too little", root),
        ("stretching", spread > 0, stretched, "round splats stay round", "two roots and four quotients a splat"),
        ("size limit", largest, limited, "no splat is too large", "a root and two quotients a splat"),
        ("frame", settings.frame < math.inf, f"not drawn is a splat whose center lies {settings.frame:g} half pictures from the middle",
         "a splat is drawn wherever its center lies", "two comparisons a splat"),
        ("color limit", limit is not None, f"no color is above {limit or 0:g}", "colors have no upper bound", "a comparison a channel and splat"),
        ("order by distance", settings.radial, "the nearest to the eye is in front", "the least deep is in front", "a root a splat"),
        ("coarse order", settings.bucketed, "splats of one bucket of depth lie in any order", "the order is exact", "a sort of all splats"),
        ("rounded picture", settings.picture_step is not None, "8 bits after each splat", "rounded once it is shown", "the image once more"),
        ("packing", rounded, "the viewer keeps splats rounded", "splats are kept exactly", "a rounding for each number of a splat"),
    ]
    return [Effect(name, on, why if on else why_not, cost) for name, on, why, why_not, cost in parts]


def _view_dependent_color(degree: int, gaussians: Gaussians) -> Effect:
    bands, room = (degree + 1) ** 2, gaussians.sh.shape[1]
    reason = f"SH up to degree {degree} of {gaussians.sh_degree}: above it every coefficient is 0"
    on = f"a direction and {bands} of {room} coefficients a splat"
    return Effect("view-dependent color", degree > 0, reason, on if degree > 0 else f"a direction and {room - 1} of {room} coefficients a splat")


def _of_adapting(config: AdaptConfig | None, scale: float) -> list[Effect]:
    enlarges, counts = "an enlarged image for each view", "two sums and a norm a splat, for each view of each step"
    if config is None or not config.steps:
        why = "nothing is optimized"
        return [Effect("upsampler", False, why, enlarges), Effect("densification statistics", False, why, counts)]
    grows = "none is cloned or split" if config.densify_gradient is None else f"splats above {config.densify_gradient:g} are cloned or split"
    return [
        Effect("upsampler", *_upsampler(config, scale), enlarges),
        Effect("densification statistics", config.densify_gradient is not None, grows, counts),
    ]


def _upsampler(config: AdaptConfig, scale: float) -> tuple[bool, str]:
    if enlarges(config, scale):
        return True, f"{config.upsampler} makes the truth from the base's image"
    if scale > 1 and config.compare_at == "both":
        return True, f"{config.upsampler} adds detail that the base's image has not"
    return False, "no image has to become larger" if scale <= 1 else "images are shrunk and compared with the base's own"
