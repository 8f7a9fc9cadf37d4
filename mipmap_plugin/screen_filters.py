"""Screen filters as data: how a projected splat is widened, so that a grid of pixels can sample it. A new one is one record, and its kernels.

Their mathematics is in `splatting.filters`; a backend says which of them it has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from mipmap_plugin.errors import SettingsError, unknown

# px²: the variance that every 3DGS rasterizer adds to a projected splat (diff-gaussian-rasterization, forward.cu).
DILATION = 0.3

Name = Literal["classic", "antialiased", "mip", "analytic", "window"]
TrainedName = Literal["classic", "antialiased", "mip", "analytic"]  # those that a project trains with


@dataclass(frozen=True)
class ScreenFilter:
    """One screen filter."""

    eps2d: float = DILATION  # px², the usual dilation
    min_compensation: float = 1.0  # the least factor by which it multiplies an opacity; 1: it does not compensate
    integrates: bool = False  # over the pixel, or over the part of it that is not hidden, instead of sampling its center


# Where the least compensation is reached, a splat is too bright and has no gradient.
# "antialiased" (dr_aa, gsplat 1.6): keeps flat and needle-shaped splats, whose projected area is almost zero, visible.
# "mip" (Mip-Splatting): the root of its 1e-6, too small for any splat to be visible. Mip-Splatting also adds 1e-6 to det_blur, and drops
# splats whose det is below 1e-6 px⁴; here they fade.
SCREEN_FILTERS: dict[str, ScreenFilter] = {
    "classic": ScreenFilter(),
    "antialiased": ScreenFilter(min_compensation=0.005),
    "mip": ScreenFilter(0.1, min_compensation=0.001),
    "analytic": ScreenFilter(0.0, integrates=True),  # Analytic-Splatting
    "window": ScreenFilter(0.0, integrates=True),  # Gaussian Blending
}
assert tuple(SCREEN_FILTERS) == get_args(Name) and set(get_args(TrainedName)) <= SCREEN_FILTERS.keys()

INTEGRATED = frozenset(name for name, screen_filter in SCREEN_FILTERS.items() if screen_filter.integrates)
COMPENSATED = frozenset(name for name, screen_filter in SCREEN_FILTERS.items() if screen_filter.min_compensation < 1)
USUAL_EPS2D = {name: screen_filter.eps2d for name, screen_filter in SCREEN_FILTERS.items()}


def check_screen_filter(name: str, *others: str) -> None:
    """Raise SettingsError for a name that is none of a screen filter, nor of `others` that may stand in its place."""
    names = dict.fromkeys((*others, *SCREEN_FILTERS))
    if name not in names:
        raise SettingsError(unknown("screen filter", name, [*names]))
