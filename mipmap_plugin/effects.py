"""Effects: what one image calls for, as data. Derived from the model, the camera and the request."""

from __future__ import annotations

from dataclasses import dataclass

# px²: the variance that every 3DGS rasterizer adds to a projected splat (diff-gaussian-rasterization, forward.cu).
DILATION = 0.3

# World units: a splat whose centre is nearer than this is not drawn (diff-gaussian-rasterization, auxiliary.h).
NEAR_PLANE = 0.2


@dataclass(frozen=True)
class Effects:
    """How one image is rendered.

    `eps2d` is the variance of the screen filter in px² of the *output* image; supersampling keeps it there.
    """

    sh_degree: int = 3  # bands above it are not evaluated
    screen_filter: str = "classic"  # "classic" dilates; "antialiased" dilates and keeps each splat's light
    eps2d: float = DILATION  # px²
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear RGB
    supersampling: int = 1  # N: N x N samples per pixel, averaged
    near_plane: float = NEAR_PLANE  # world units
