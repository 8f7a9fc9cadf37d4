"""Viewers: what the programs that people look at splats with do to them, as data. A new one is one record.

Read in the sources of the versions named, which count variances in other units: where a viewer's focal length is viewport · projection, and
so twice that of the picture, a variance of v there is v/4 px² here; where its covariances are four times as large besides, v/16. What every
WebGL viewer has in common is `WEBGL`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from mipmap_plugin.effects import DILATION, FRUSTUM_MARGIN, NEAR_PLANE, USUAL, Effects, Packing, RenderSettings
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.registry import Registry


@dataclass(frozen=True)
class Viewer:
    """One convention of drawing: a screen filter, and what a viewer does beside it."""

    name: str
    title: str
    source: str  # what was read, with its version
    screen_filter: str  # of `Effects`: "classic" dilates, "antialiased" and "mip" compensate
    eps2d: float  # px² of the picture
    settings: RenderSettings = USUAL
    near_plane: float | None = None  # world units; None: the page that shows the viewer decides
    sh_degree: int = 3  # bands above it are not drawn
    filter_3d: bool = False  # whether splats are smoothed by a column filter_3D of their file; others do not read it
    unlike: str = ""  # what it does otherwise than this record says

    def effects(self, effects: Effects) -> Effects:
        """`effects`, which say what the splats are, as this viewer draws them. Where it has no near plane of its own, that of `effects` stays."""
        near = effects.near_plane if self.near_plane is None else self.near_plane
        degree = min(effects.sh_degree, self.sh_degree)
        return replace(
            effects, sh_degree=degree, screen_filter=self.screen_filter, eps2d=self.eps2d, near_plane=near, settings=self.settings
        )


# Standard deviations at which viewers that draw a splat as a square of 2 by 2 with the weight exp(-r²) to r = 2 end it.
EDGE = 8**0.5

# Pictures of 8 bits, in which each splat is rounded: what adds less than half a step to them is not seen. A splat may cover a pixel wholly;
# here the largest alpha is a little less, so that what lies behind keeps a gradient. No viewer stops at a transmittance; here one so small
# that nobody sees it ends a pixel.
WEBGL = RenderSettings(min_alpha=0.5 / 255, radius=EDGE, max_alpha=0.999, min_transmittance=1e-6, frozen_beyond=math.inf, picture_step=1 / 255)

# px²: PlayCanvas and Cesium ask for half-axes of 2 half pixels: 2·sqrt(2·4·v) >= 2, v >= 1/8.
PIXEL_SIZE = 1 / 8

# px²: PlayCanvas asks for opacity · 2π · sqrt(det) >= 3 in half pixels, where the determinant is 16 times as large.
CONTRIBUTION = 3 / (2 * math.pi * 4)

PLAYCANVAS = replace(
    WEBGL,
    min_alpha=1 / 255,
    fades=True,
    min_variance=PIXEL_SIZE,
    bucketed=True,
    max_half_axis=1024.0,
    fits_picture=True,
    max_color=4.0,
    color_steps=(4 / 2047, 4 / 2047, 4 / 1023),
    packing=Packing(log_scales=(-12 + 21 / 255, 9.0, 21 / 255), quats="stereographic"),
)
PLAYCANVAS_SOURCE = "playcanvas 2.23.3, gsplatCorner, gsplat and containerCompactWrite shaders (SuperSplat, supersplat-viewer 1.36)"
INRIA_UNLIKE = "INRIA ends a splat at three standard deviations, rounded up to tiles; gsplat at 3.33, and its largest alpha may be 0.999"

# RGBA of 8 bits, colors of SH degree 0 within 0..1.
EIGHT_BITS = Packing(color=1 / 255)

BUILT_IN = (
    Viewer(
        "classic", "3DGS: INRIA's viewer, gsplat, nerfstudio", "diff-gaussian-rasterization; gsplat 1.5, rasterize_mode classic",
        "classic", DILATION, near_plane=NEAR_PLANE, unlike=INRIA_UNLIKE,
    ),
    Viewer(
        "antialiased", "3DGS with compensation: INRIA --antialiasing, gsplat, nerfstudio",
        "diff-gaussian-rasterization, dr_aa; gsplat 1.5, rasterize_mode antialiased",
        "antialiased", DILATION, near_plane=NEAR_PLANE, unlike=INRIA_UNLIKE,
    ),
    Viewer(
        "mip", "Mip-Splatting", "diff-gaussian-rasterization of Mip-Splatting", "mip", 0.1, near_plane=NEAR_PLANE, filter_3d=True,
        unlike=INRIA_UNLIKE,
    ),
    Viewer(
        # Its compensation has no least share; that of "mip" lies below its least alpha, so that nobody sees it.
        "spark", "Spark (three.js)", "@sparkjsdev/spark 2.2.0, SparkRenderer, vertex and fragment shader, packSplatEncoding",
        "mip", DILATION,
        replace(
            WEBGL, frame=1.4, max_half_axis=512.0, radial=True, max_color=1.0, color_steps=(1 / 255, 1 / 255, 1 / 255),
            packing=Packing(
                opacity=(1 / 255, 2 / 255), color=1 / 255, bands=(1 / 63, 1 / 127, 1 / 31),
                log_scales=(-12.0, 9.0, 21 / 254), quats="octahedral", half_means=True,
            ),
        ),
    ),
    Viewer("playcanvas", "PlayCanvas and SuperSplat, WebGL", PLAYCANVAS_SOURCE, "classic", DILATION / 4, PLAYCANVAS),
    Viewer(
        "playcanvas-webgpu", "PlayCanvas and SuperSplat, WebGPU", "playcanvas 2.23.3, compute-gsplat-common, gsplat-hybrid-renderer",
        "classic", DILATION / 4, replace(PLAYCANVAS, bucketed=False, boxed=True, min_contribution=CONTRIBUTION),
        unlike="amid splats much larger than the picture it shows something else here and there, 40 dB away",
    ),
    Viewer("playcanvas-aa", "PlayCanvas and SuperSplat with antiAlias", PLAYCANVAS_SOURCE, "mip", DILATION / 4, PLAYCANVAS),
    Viewer(
        "gaussian-splats-3d", "GaussianSplats3D", "@mkkellogg/gaussian-splats-3d 0.4.7, SplatMaterial3D",
        "classic", DILATION,
        replace(WEBGL, frame=1.2, max_half_axis=1024.0, least_spread=0.1**0.5, packing=replace(EIGHT_BITS, downwards=True)), sh_degree=0,
        unlike="degree 0 is its default, and 2 what it can be asked for",
    ),
    Viewer(
        "antimatter15", "antimatter15/splat", "antimatter15/splat ba182b5, main.js", "classic", 0.0,
        replace(WEBGL, frame=1.2, max_half_axis=1024.0, packing=EIGHT_BITS), sh_degree=0,
        unlike="covariances are kept in float16; not compared with a picture",
    ),
    Viewer(
        "cesium", "Cesium", "@cesium/engine 24.0.0, PrimitiveGaussianSplat shaders; cesium-wasm-utils, wasm-splats", "classic", DILATION / 16,
        replace(WEBGL, frame=1.2, min_variance=PIXEL_SIZE, packing=EIGHT_BITS),
        unlike="a splat ends at a square instead of an ellipse, and covariances are kept in float16; not compared with a picture",
    ),
    Viewer(
        "babylon", "Babylon.js", "@babylonjs/core 9.34.0, gaussianSplatting shaders, GaussianSplattingMaterial", "classic", DILATION / 4,
        replace(WEBGL, frame=1.2, packing=EIGHT_BITS),
        unlike="covariances are kept in float16 and coefficients in 8 bits; not compared with a picture",
    ),
    Viewer(
        "unity", "UnityGaussianSplatting (aras-p)", "UnityGaussianSplatting 1.1.1 (2c6fed3), RenderGaussianSplats, GaussianSplatting.hlsl",
        "classic", DILATION, replace(WEBGL, min_alpha=1 / 255, frozen_beyond=FRUSTUM_MARGIN, picture_step=None),
        unlike="a splat ends at a square instead of an ellipse, and assets are packed as coarsely as they were asked to be; "
        "not compared with a picture",
    ),
    Viewer(
        "brush", "Brush", "brush 8b7f5c6c, brush-render, for a file without SplatRenderMode mip", "classic", DILATION,
        RenderSettings(max_alpha=0.999), near_plane=0.01, sh_degree=4, unlike="of a file with SplatRenderMode mip it is mip; "
        "not compared with a picture",
    ),
)  # fmt: skip

ALIASES = {"supersplat": "playcanvas"}

VIEWERS = Registry("mipmap_plugin.viewers", {})


def register_viewer(name: str, viewer: Viewer | tuple[str, ...] | str, *, replace: bool = False) -> None:
    """Add a viewer under `name`: a record, or `"package.module:RECORD"` that is imported at first use; or the names of several registered
    ones, which a file can be for at once."""
    VIEWERS.add(name, viewer, replace=replace)


for _viewer in BUILT_IN:
    register_viewer(_viewer.name, _viewer)
for _alias, _name in ALIASES.items():
    register_viewer(_alias, VIEWERS.get(_name))
register_viewer("portable", tuple(viewer.name for viewer in BUILT_IN))


def viewers_for(name: str) -> tuple[str, ...]:
    """The viewers that a file made for `name` has to be right in: that one, or those that it stands for.

    Raises SettingsError when unknown, PluginError for several that are no names.
    """
    viewer = VIEWERS.get(name)
    if not isinstance(viewer, tuple):
        return (name,)
    if not viewer or not all(isinstance(each, str) for each in viewer):
        raise PluginError(f"viewer {name!r} stands for {viewer!r}; it has to be the names of registered viewers")
    return viewer


def find_viewer(name: str) -> Viewer:
    """The viewer `name`. Raises SettingsError when unknown or several, PluginError when it is no record of a viewer."""
    viewer = VIEWERS.get(name)
    if isinstance(viewer, tuple):
        raise SettingsError(f"{name} is not one viewer but several, which draw a file differently; name one: {', '.join(viewers_for(name))}")
    if not isinstance(viewer, Viewer):
        raise PluginError(f"viewer {name!r} is a {type(viewer).__name__}; it has to be a mipmap_plugin.splatting.viewers.Viewer")
    return viewer
