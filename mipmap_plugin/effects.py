"""Effects: what rendering one image has to simulate, as data, derived from the model, the camera and the request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from mipmap_plugin.allowed import OF_EFFECTS, check
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError, unknown
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.screen_filters import COMPENSATED, DILATION, INTEGRATED

# The screen filter of 2D Gaussian Splatting (`splatting.surfels`), and the variance of its low-pass, px²: a deviation of half the root of
# two (diff-surfel-rasterization, auxiliary.h).
SURFEL, LOW_PASS = "surfel", 0.5

# World units: splats whose center is nearer than this are not rendered (diff-gaussian-rasterization, auxiliary.h).
NEAR_PLANE = 0.2

# What can be rendered beside the image (`backends.geometry`), and the cost of each.
OUTPUTS = {
    "depth": "another image, whose colors are distances",
    "normals": "another image, whose colors are directions, and the shortest axis of each splat",
}


@dataclass(frozen=True)
class Effects:
    """How one image is rendered.

    `eps2d` is the variance of the screen filter in px² of the *output* image; supersampling keeps it there.

    Attributes:
        sh_degree: Of the colors; bands above it are not evaluated.
        screen_filter: "classic" dilates; "antialiased" and "mip" also compensate; the others integrate over the pixel.
        eps2d: The variance that the filter adds, px² of the image.
        background: RGB, 0..1.
        supersampling: N, for N x N samples per pixel, averaged.
        near_plane: Depth up to which splats are not drawn, world units.
        outputs: What is rendered besides the image: "depth", "normals".
        settings: Cut-offs, order and rounding.
        exposure: Whether the exposure of the view's photograph is applied (`models.exposure`).
    """

    sh_degree: int = 3
    screen_filter: str = "classic"
    eps2d: float = DILATION
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    supersampling: int = 1
    near_plane: float = NEAR_PLANE
    settings: RenderSettings = USUAL
    outputs: tuple[str, ...] = ()
    exposure: bool = False

    def __post_init__(self) -> None:
        check("effects", self, OF_EFFECTS, optional=frozenset())
        if wrong := [name for name in as_outputs(self.outputs) if not isinstance(name, str) or name not in OUTPUTS]:
            raise SettingsError(unknown("output", str(wrong[0]), [*OUTPUTS]))
        if not isinstance(self.settings, RenderSettings):
            raise SettingsError(f"effects: settings must be RenderSettings, got {type(self.settings).__name__}")


@dataclass(frozen=True)
class Effect:
    """One thing that can be simulated, whether it is on here, and why.

    Attributes:
        cost: In operations: what it costs if it is on, and what is saved if it is off.
    """

    name: str
    on: bool
    reason: str
    cost: str

    def __str__(self) -> str:
        return f"{self.name}: {'on' if self.on else 'off'}, {self.reason} ({'costs' if self.on else 'saves'} {self.cost})"


def colorless(effects: Effects) -> Effects:
    """The same for images whose colors, SH of degree 0, are other quantities: on black, and without limits, rounding and light of colors."""
    return replace(effects, sh_degree=0, background=(0.0, 0.0, 0.0), settings=effects.settings.without_color_rounding())


EXPOSURE = Effect("exposure", False, "the checkpoint has none", "a product with a 3 x 3 matrix per pixel")

# Effects of some families only; a model reports those that it has (`models.base.effects_of`).
MODEL_EFFECTS = (
    Effect("view-dependent geometry", False, "the splats are the same for every camera", "decoding the splats for each camera"),
    Effect("levels of detail", False, "all splats are used at every distance", "a distance and a comparison per splat"),
    Effect("time", False, "the scene does not move", "a pass through a deformation field per image"),
    Effect("appearance embedding", False, "all views share one appearance", "more inputs of a color network"),
    EXPOSURE,
    Effect("3D filter", False, "splats have no 3D filter", "three square roots per splat"),
)


def as_outputs(names: Sequence[str] | None) -> tuple[str, ...]:
    """What is rendered besides the image, as `Effects.outputs`. Raises SettingsError for what is no sequence, and for a text, which is one too."""
    if not isinstance(names, str):
        with suppress(TypeError):
            return () if names is None else tuple(names)
    raise SettingsError(f"outputs must be a sequence of names, such as ['depth'], got {names!r}")


def explain(
    effects: Effects, gaussians: Gaussians, reported: Sequence[Effect] = (), config: AdaptConfig | None = None, scale: float = 1.0
) -> tuple[Effect, ...]:
    """List all effects, on or off, with their reasons and costs.

    `reported`: the effects that the model reports; `config` and `scale`: of an adaptation, if there is one.
    """
    by_name = {effect.name: effect for effect in (*MODEL_EFFECTS, *reported)}
    if effects.exposure:
        by_name["exposure"] = replace(by_name["exposure"], on=True, reason="requested; exposure.json has an entry for this view")
    model_effects = [by_name[effect.name] for effect in MODEL_EFFECTS]
    base_degree = effects.sh_degree if config is None else gaussians.used_sh_degree()  # which takes a look at all, too long for a render
    return (*model_effects, *_rendering_effects(effects, gaussians, base_degree), *_adaptation_effects(config, scale))


def enlarges(config: AdaptConfig, scale: float) -> bool:
    """Whether the truth of an adaptation is the enlarged image of the base."""
    return scale > 1 and config.compare_at == "target"


def _rendering_effects(effects: Effects, gaussians: Gaussians, base_degree: int) -> list[Effect]:
    integrates, n, has_covariances = effects.screen_filter in INTEGRATED, effects.supersampling, gaussians.covariances is not None
    size = "over the area of a pixel" if integrates else f"{effects.eps2d:g} px²"
    filter_cost = "five more exponentials per splat and pixel" if integrates else "two sums and a determinant per splat"
    return [
        _view_dependent_color(effects.sh_degree, gaussians, base_degree),
        Effect("screen filter", effects.eps2d > 0 or integrates, f"{effects.screen_filter}, {size}", filter_cost),
        Effect("compensation", *_compensation(effects), "a square root per splat"),
        Effect("supersampling", n > 1, f"{n * n} sample{'s' if n > 1 else ''} per pixel", f"{n * n if n > 1 else 'N x N'} times the pixels"),
        *_viewer_effects(effects.settings),
        Effect(
            "covariances", has_covariances, "the model provides them" if has_covariances else "quaternions and scales suffice",
            "two matrix products per splat",
        ),
        *(Effect(name, name in effects.outputs, "requested" if name in effects.outputs else "not requested", cost) for name, cost in OUTPUTS.items()),
    ]  # fmt: skip


def _compensation(effects: Effects) -> tuple[bool, str]:
    if effects.screen_filter in COMPENSATED and effects.eps2d == 0:
        return False, "the dilation is 0, so there is nothing to compensate"
    return effects.screen_filter in COMPENSATED, f"the screen filter is {effects.screen_filter}"


def _viewer_effects(settings: RenderSettings) -> list[Effect]:
    """What a viewer does besides its screen filter."""
    size, contribution, spread = settings.min_variance, settings.min_contribution, settings.least_spread
    end = f"a splat {'falls to 0' if settings.fades else 'is cut off'} at {settings.radius or 0:.3g} standard deviations"
    variance = "larger variance along x and y" if settings.boxed else "variance along its longer axis"
    measure = "sqrt(opacity · det)" if settings.rooted else "opacity · sqrt(det)"
    stretched = f"variances are at least {spread:.3g} px² from their mean; splats whose smaller variance would be 0 are not rendered"
    limited = settings.fits_picture or settings.max_half_axis < math.inf
    limits = [f"{settings.max_half_axis:g} px"] * (settings.max_half_axis < math.inf) + ["the picture's shorter side"] * settings.fits_picture
    coarse = settings.bucketed or settings.even_buckets is not None
    root, max_color = "a square root and a comparison per splat", settings.max_color
    rounded = settings.packing is not None or settings.color_steps is not None
    parts = [
        ("edge", settings.radius is not None, end, f"a splat ends where its alpha is below {settings.min_alpha:.2g}", "an exponential per splat"),
        ("size cull", size > 0, f"a splat is not rendered if its {variance} is below {size:.3g} px²", "small splats are rendered too", root),
        ("contribution cull", contribution > 0, f"a splat is not rendered if its {measure} is below {contribution:.3g} px²",
         "no splat contributes too little", root),
        ("stretching", spread > 0, stretched, "round splats stay round", "two square roots and four divisions per splat"),
        ("size limit", limited, f"a splat's half-axes are at most {' and '.join(limits)}", "splats may be of any size",
         "a square root and two divisions per splat"),
        ("frame", settings.frame < math.inf, f"splats whose center is more than {settings.frame:g} half pictures from the middle are not rendered",
         "a splat is rendered wherever its center lies", "two comparisons per splat"),
        ("color limit", max_color is not None, f"colors are at most {max_color or 0:g}", "colors have no upper bound",
         "a comparison per channel and splat"),
        ("order by distance", settings.radial, "splats are sorted by their distance to the eye", "splats are sorted by depth",
         "a square root per splat"),
        ("coarse order", coarse, "splats in the same bucket of depth are not sorted", "the order is exact",
         "a sort of all splats"),
        ("linear light", settings.linear_light is not None, "splats are blended in linear light", "splats are blended as their colors are",
         "three powers per splat and per pixel"),
        ("rounded picture", settings.picture_step is not None, "8 bits after each splat", "rounded only for display", "another copy of the image"),
        ("packing", rounded, "the viewer keeps rounded splats", "splats are not rounded", "a rounding for each number of a splat"),
    ]  # fmt: skip
    return [Effect(name, on, reason_on if on else reason_off, cost) for name, on, reason_on, reason_off, cost in parts]


def _view_dependent_color(degree: int, gaussians: Gaussians, base_degree: int) -> Effect:
    held, bands = gaussians.sh_degree, (degree + 1) ** 2
    available = max(bands, gaussians.sh.shape[1])
    more = f"SH up to degree {degree}, of the base up to {base_degree}: merging has made room for more"
    above = ": above it every coefficient is 0" if degree < held else ""
    reason = more if degree > base_degree else f"SH up to degree {degree} of {held}{above}"
    count = bands if degree > 0 else available - 1
    return Effect("view-dependent color", degree > 0, reason, f"a direction and {count} of {available} coefficients per splat")


def _adaptation_effects(config: AdaptConfig | None, scale: float) -> list[Effect]:
    upsampling = statistics = False, "nothing is optimized"
    if config is not None and config.steps:
        threshold = config.densify_gradient
        reason = "no splats are cloned or split" if threshold is None else f"splats with gradients above {threshold:g} are cloned or split"
        upsampling, statistics = _upsampler(config, scale), (threshold is not None, reason)
    return [
        Effect("upsampler", *upsampling, "an enlarged image for each view"),
        Effect("densification statistics", *statistics, "two sums and a norm per splat, for each view of each step"),
    ]


def _upsampler(config: AdaptConfig, scale: float) -> tuple[bool, str]:
    if enlarges(config, scale):
        return True, f"{config.upsampler} enlarges the base's image to the truth"
    if scale > 1 and config.compare_at == "both":
        return True, f"{config.upsampler} adds detail that the base's image does not have"
    return False, "no image is enlarged" if scale <= 1 else "images are shrunk and compared with the base's own"
