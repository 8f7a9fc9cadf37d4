"""Effects: what one image calls for, as data. Derived from the model, the camera and the request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians

# px²: the variance that every 3DGS rasterizer adds to a projected splat (diff-gaussian-rasterization, forward.cu).
DILATION = 0.3

# The screen filter of 2D Gaussian Splatting (`backends.surfels`), and the variance of its low-pass, px²: a deviation of half the root of
# two (diff-surfel-rasterization, auxiliary.h).
SURFEL, LOW_PASS = "surfel", 0.5

# World units: a splat whose centre is nearer than this is not drawn (diff-gaussian-rasterization, auxiliary.h).
NEAR_PLANE = 0.2

# What every 3DGS rasterizer leaves out (diff-gaussian-rasterization, forward.cu).
MIN_ALPHA = 1 / 255  # below one 8-bit step a splat cannot change a displayed pixel
MIN_TRANSMITTANCE = 1e-4  # a pixel this opaque is finished

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
class RenderSettings:
    """What an image may lack so that it is drawn sooner. Only `tile` changes nothing but the time."""

    min_alpha: float = MIN_ALPHA  # below it a splat is not drawn on a pixel
    min_transmittance: float = MIN_TRANSMITTANCE  # a pixel stops before the splat that would leave it less
    radius: float | None = None  # standard deviations at which a splat ends; None: where `min_alpha` ends it
    tile: int = TILE  # px: pixels that share a list of splats


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
        Effect("covariances", given, "the model gives them" if given else "quaternions and scales suffice", extra),
        *(Effect(name, name in effects.outputs, "asked for" if name in effects.outputs else "not asked for", cost) for name, cost in OUTPUTS.items()),
    ]


def _view_dependent_color(degree: int, gaussians: Gaussians) -> Effect:
    bands, room = (degree + 1) ** 2, gaussians.sh.shape[1]
    reason = f"SH up to degree {degree} of {gaussians.sh_degree}: above it every coefficient is 0"
    on = f"a direction and {bands} of {room} coefficients a splat"
    return Effect("view-dependent color", degree > 0, reason, on if degree > 0 else f"a direction and {room - 1} of {room} coefficients a splat")


def _of_adapting(config: AdaptConfig | None, scale: float) -> list[Effect]:
    enlarges, counts = "an enlarged image for each view", "two sums and a norm a splat, for each view of each step"
    if config is None or not config.steps:
        why = "nothing is optimised"
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
