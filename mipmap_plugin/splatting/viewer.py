"""A viewer's drawing convention, as data, and what many of them have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from mipmap_plugin.allowed import OF_VIEWER, check
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError, unknown
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.screen_filters import SCREEN_FILTERS


@dataclass(frozen=True)
class Viewer:
    """One drawing convention: a screen filter and further render settings.

    Attributes:
        name: Short name, as in `--viewer`.
        title: The name that people know it by.
        source: The source code this record was taken from, with its version.
        screen_filter: As in `Effects`: "classic" dilates, "antialiased" and "mip" compensate.
        eps2d: The variance that the filter adds, px² of the image.
        settings: What else differs from 3DGS: cut-offs, order, rounding.
        near_plane: World units; None: decided by the page that embeds the viewer.
        sh_degree: Bands above it are not drawn.
        filter_3d: Whether the viewer reads the column filter_3D of a PLY and smooths splats by it.
        read_degrees: SH degrees of PLYs that its loader reads right. A file for it has one of these: with bands of zeros, or without those above.
        extra_columns: Whether its loader reads a PLY that has more columns than 3DGS defines, of any type.
        unlike: Known differences between the viewer and this record.
    """

    name: str
    title: str
    source: str
    screen_filter: str
    eps2d: float
    settings: RenderSettings = USUAL
    near_plane: float | None = None
    sh_degree: int = 3
    filter_3d: bool = False
    read_degrees: tuple[int, ...] = (0, 1, 2, 3, 4)
    extra_columns: bool = True
    unlike: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.screen_filter, str) or self.screen_filter not in SCREEN_FILTERS:
            raise SettingsError(f"viewer {self.name!r}: {unknown('screen filter', str(self.screen_filter), [*SCREEN_FILTERS])}")
        if not isinstance(self.settings, RenderSettings):
            raise SettingsError(f"viewer {self.name!r}: settings must be RenderSettings, got {type(self.settings).__name__}")
        check(f"viewer {self.name!r}", self, OF_VIEWER, optional=frozenset({"near_plane"}))

    def effects(self, effects: Effects) -> Effects:
        """`effects` under this viewer's convention. The near plane changes only if the viewer has one."""
        near = effects.near_plane if self.near_plane is None else self.near_plane
        degree = min(effects.sh_degree, self.sh_degree)
        return replace(effects, sh_degree=degree, screen_filter=self.screen_filter, eps2d=self.eps2d, near_plane=near, settings=self.settings)


# `Viewer.read_degrees` of loaders that refuse degree 4, or take its columns for those of degree 3; and of those that read all that is neither 0 nor 3
# as degree 0 or 3, or refuse it.
UP_TO_3, NONE_OR_3 = (0, 1, 2, 3), (0, 3)

# Standard deviations at which a splat ends in viewers that draw it as a 2 x 2 square with the weight exp(-r²) up to r = 2.
EDGE = 8**0.5

# The frame buffer has 8 bits and is rounded after each splat, so less than half a step is invisible. In the viewers alpha may be 1; here
# it is a little less, so that splats behind keep a gradient. The viewers have no least transmittance; here it is too small to be visible.
WEBGL = RenderSettings(min_alpha=0.5 / 255, radius=EDGE, max_alpha=0.999, min_transmittance=1e-6, frozen_beyond=math.inf, picture_step=1 / 255)
