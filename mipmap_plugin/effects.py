"""Effects: what one image calls for, as data. Derived from the model, the camera and the request."""

from __future__ import annotations

from dataclasses import dataclass

from mipmap_plugin.gaussians import Gaussians

# px²: the variance that every 3DGS rasterizer adds to a projected splat (diff-gaussian-rasterization, forward.cu).
DILATION = 0.3

# World units: a splat whose centre is nearer than this is not drawn (diff-gaussian-rasterization, auxiliary.h).
NEAR_PLANE = 0.2

# What every 3DGS rasterizer leaves out (diff-gaussian-rasterization, forward.cu).
MIN_ALPHA = 1 / 255  # below one 8-bit step a splat cannot change a displayed pixel
MIN_TRANSMITTANCE = 1e-4  # a pixel this opaque is finished

TILE = 16  # px

# Screen filters that dim what they widen.
COMPENSATED = frozenset({"antialiased", "mip"})


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
    screen_filter: str = "classic"  # "classic" dilates; "antialiased", "mip" also keep a splat's light; "analytic" integrates over pixels
    eps2d: float = DILATION  # px²
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear RGB
    supersampling: int = 1  # N: N x N samples per pixel, averaged
    near_plane: float = NEAR_PLANE  # world units
    settings: RenderSettings = USUAL


@dataclass(frozen=True)
class Effect:
    """One thing that a renderer can do, whether this image calls for it, and why."""

    name: str
    on: bool
    reason: str


def explain(effects: Effects, gaussians: Gaussians) -> list[Effect]:
    """Every effect that rendering knows, on or off, with its reason."""
    integrates = effects.screen_filter == "analytic"
    size = "over the area of a pixel" if integrates else f"{effects.eps2d:g} px²"
    degree, room, n, given = effects.sh_degree, gaussians.sh_degree, effects.supersampling, gaussians.covariances is not None
    return [
        Effect("view-dependent color", degree > 0, f"SH up to degree {degree} of {room}: above it every coefficient is 0"),
        Effect("screen filter", effects.eps2d > 0 or integrates, f"{effects.screen_filter}, {size}"),
        Effect("compensation", effects.screen_filter in COMPENSATED, f"the screen filter is {effects.screen_filter}"),
        Effect("supersampling", n > 1, f"{n * n} sample{'s' if n > 1 else ''} a pixel"),
        Effect("covariances", given, "the model gives them" if given else "quaternions and scales suffice"),
    ]
