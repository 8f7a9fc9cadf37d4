"""Viewers: the drawing conventions of the programs that show splats, as data. A new viewer is one record.

Taken from the sources of the versions named. Units of variance differ: where a viewer's focal length is viewport · projection, twice
that of the image, a variance of v there is v/4 px² here; where its covariances are four times as large as well, v/16. `WEBGL` is what
all WebGL viewers have in common.
"""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import replace
from typing import Any

from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.registry import Registry
from mipmap_plugin.render_settings import EvenBuckets, Packing
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.native_viewers import BRUSH, FURTHER, UNITY
from mipmap_plugin.splatting.viewer import UP_TO_3, WEBGL
from mipmap_plugin.splatting.viewer import Viewer as Viewer

# px²: PlayCanvas and Cesium require half-axes of 2 half pixels: 2·sqrt(2·4·v) >= 2, v >= 1/8.
PIXEL_SIZE = 1 / 8

# px²: PlayCanvas requires opacity · 2π · sqrt(det) >= 3 in half pixels, where the determinant is 16 times as large.
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
PLAYCANVAS_SOURCE = "playcanvas 2.23.3, gsplatCorner, gsplat and containerCompactWrite shaders (SuperSplat)"

# Its pages draw with WebGPU where the browser has it. They ask for a contribution of 1 instead of 3, and sort by distance.
SUPERSPLAT_VIEWER = Viewer(
    "supersplat-viewer", "SuperSplat's viewer (superspl.at, exported pages), WebGPU",
    "@playcanvas/supersplat-viewer 1.36.2, viewer.js; playcanvas 2.23.3, compute-gsplat-common, gsplat-hybrid-renderer", "classic", DILATION / 4,
    replace(PLAYCANVAS, bucketed=False, boxed=True, radial=True, min_contribution=CONTRIBUTION / 3), read_degrees=UP_TO_3,
    unlike="without WebGPU it is playcanvas, sorted by distance",
)  # fmt: skip
INRIA_UNLIKE = "a splat ends at three standard deviations, rounded up to tiles"

# RGBA of 8 bits, colors of SH degree 0 within 0..1.
EIGHT_BITS = Packing(color=1 / 255)

# antimatter15's sort, in 16 bits. Of two splats in a bucket the first is drawn first: it is in front if splats are drawn front to back.
FRONT_FIRST, BACK_FIRST = EvenBuckets(2**16 - 1), EvenBuckets(2**16 - 1, later_in_front=True)

FRONT_TO_BACK = "covariances are stored in float16, quaternions in 8 bits, and the picture is rounded from the front to the back"

BUILT_IN = (
    Viewer(
        "classic", "3DGS: INRIA's viewer", "diff-gaussian-rasterization",
        "classic", DILATION, near_plane=NEAR_PLANE, extra_columns=False, unlike=INRIA_UNLIKE,
    ),
    Viewer(
        "antialiased", "3DGS with compensation: INRIA --antialiasing", "diff-gaussian-rasterization, dr_aa",
        "antialiased", DILATION, near_plane=NEAR_PLANE, extra_columns=False, unlike=INRIA_UNLIKE,
    ),
    Viewer(
        "mip", "Mip-Splatting", "diff-gaussian-rasterization of Mip-Splatting", "mip", 0.1, near_plane=NEAR_PLANE, filter_3d=True,
        unlike=INRIA_UNLIKE,
    ),
    Viewer(
        # Its compensation has no lower bound; that of "mip" is below its least alpha, so the difference is invisible.
        "spark", "Spark (three.js)", "@sparkjsdev/spark 2.2.0, SparkRenderer, vertex and fragment shader, packSplatEncoding",
        "mip", DILATION,
        replace(
            WEBGL, frame=1.4, max_half_axis=512.0, radial=True, max_color=1.0, color_steps=(1 / 255, 1 / 255, 1 / 255),
            packing=Packing(
                opacity=(1 / 255, 2 / 255), color=1 / 255, bands=(1 / 63, 1 / 127, 1 / 31),
                log_scales=(-12.0, 9.0, 21 / 254), quats="octahedral", half_means=True,
            ),
        ),
        read_degrees=UP_TO_3,
    ),
    Viewer("playcanvas", "PlayCanvas and SuperSplat, WebGL", PLAYCANVAS_SOURCE, "classic", DILATION / 4, PLAYCANVAS, read_degrees=UP_TO_3),
    Viewer(
        "playcanvas-webgpu", "PlayCanvas and SuperSplat, WebGPU", "playcanvas 2.23.3, compute-gsplat-common, gsplat-hybrid-renderer",
        "classic", DILATION / 4, replace(PLAYCANVAS, bucketed=False, boxed=True, min_contribution=CONTRIBUTION), read_degrees=UP_TO_3,
        unlike="among splats much larger than the image some pixels differ, 43 dB in all; its order is by buckets of depth, and by chance in each",
    ),
    SUPERSPLAT_VIEWER,
    Viewer("playcanvas-aa", "PlayCanvas and SuperSplat with antiAlias", PLAYCANVAS_SOURCE, "mip", DILATION / 4, PLAYCANVAS, read_degrees=UP_TO_3),
    Viewer(
        "gaussian-splats-3d", "GaussianSplats3D", "@mkkellogg/gaussian-splats-3d 0.4.7, SplatMaterial3D",
        "classic", DILATION,
        replace(
            WEBGL, frame=1.2, max_half_axis=1024.0, least_spread=0.1**0.5, packing=replace(EIGHT_BITS, downwards=True), even_buckets=BACK_FIRST,
        ),
        sh_degree=0,
        unlike="SH degree 0 is its default; it can draw up to degree 2",
    ),
    Viewer(
        "antimatter15", "antimatter15/splat", "antimatter15/splat ba182b5, main.js", "classic", 0.0,
        replace(WEBGL, frame=1.2, max_half_axis=1024.0, packing=EIGHT_BITS, even_buckets=replace(FRONT_FIRST, largest_first=True)),
        sh_degree=0, unlike=FRONT_TO_BACK,
    ),
    Viewer(
        "gsplat-js", "gsplat.js", "gsplat 1.2.9, RenderProgram, PLYLoader, sort.cpp", "classic", DILATION / 4,
        replace(WEBGL, frame=1.2, max_half_axis=1024.0, packing=EIGHT_BITS, even_buckets=FRONT_FIRST), sh_degree=0, extra_columns=False,
        unlike=FRONT_TO_BACK,
    ),
    Viewer(
        "three", "three.js, GaussianSplat", "three 0.187.0, examples/jsm/objects/GaussianSplat", "mip", DILATION,
        replace(
            WEBGL, radius=2.0, frame=1.4, max_half_axis=2048.0, max_color=1.0, packing=Packing(color=1 / 255, bands=(1 / 128,) * 3),
            even_buckets=EvenBuckets(4095, sphere_from=0.1, later_in_front=True),
        ),
        read_degrees=UP_TO_3,
        unlike="buckets of depth are those of a camera whose near plane is at 0.1, three.js's default; colors are the file's if the renderer's "
        "outputColorSpace is linear",
    ),
    Viewer(
        "aframe", "aframe-gaussian-splatting, and drei's Splat", "aframe-gaussian-splatting b50238f, index.js; drei 0d9864e, Splat.tsx", "classic",
        DILATION,
        replace(WEBGL, frame=1.2, max_half_axis=2048.0, packing=EIGHT_BITS, even_buckets=replace(BACK_FIRST, largest_first=True)),
        sh_degree=0,
        unlike="covariances are stored in 16 bits, quaternions in 8; splats whose opacity times longest axis is below 1e-4 of their depth "
        "are left out, which hardly shows; the package on npm, 0.0.19, leaves out those up to ten times as large; drei rounds colors to 8 bits of "
        "linear light",
    ),
    Viewer(
        # A splat's opacity · det is at least 1/4 px⁴, whose root is 1/2 px².
        "viser", "viser", "viser 1.1.1, client/src/Splatting, GaussianSplatsHelpers and sorter.cpp", "classic", DILATION,
        replace(
            WEBGL, min_alpha=0.01, frame=1.1, max_half_axis=2048.0, min_contribution=0.5, rooted=True, even_buckets=BACK_FIRST,
            packing=replace(EIGHT_BITS, downwards=True),
        ),
        sh_degree=0,
        unlike="covariances are stored in float16, in world units: of widths below 2e-4 nothing is left; pixels are square, and colors those that "
        "its caller gives it, taken here as those of SH degree 0",
    ),
    Viewer(
        "cesium", "Cesium", "@cesium/engine 26.3.0, PrimitiveGaussianSplat shaders; cesium-wasm-utils, wasm-splats", "classic", DILATION / 16,
        replace(WEBGL, frame=1.2, max_half_axis=512.0, min_variance=PIXEL_SIZE, packing=EIGHT_BITS),
        unlike="a splat ends at a square instead of an ellipse, covariances are stored in float16, and its tiles are SPZ, which rounds splats",
    ),
    Viewer(
        # Colors are limited by the frame buffer, which they reach before they are multiplied by alpha.
        "babylon", "Babylon.js", "@babylonjs/core 9.35.0, gaussianSplatting shaders, GaussianSplattingMaterial", "classic", DILATION / 4,
        replace(WEBGL, even_buckets=EvenBuckets(), frame=1.2, max_half_axis=1024.0, max_color=1.0, packing=EIGHT_BITS),
        sh_degree=4,
        unlike="covariances are stored in float16, quaternions and SH coefficients in 8 bits; an SPZ file that says it was trained with "
        "antialiasing is drawn with compensation",
    ),
    UNITY, BRUSH, *FURTHER,
)  # fmt: skip

# What a name may be: files that are adapted for the viewer have it in theirs.
IN_FILES = re.compile(r"\w[\w.+-]*")
NOT_IN_FILES = "viewers are named in files: a name begins with a letter or a digit, and has . _ + - beside these, got {name!r}"

ALIASES = {
    "inria": "classic",
    **{"supersplat": "playcanvas", "mkkellogg": "gaussian-splats-3d", "threejs": "three", "drei": "aframe", "godot": "gdgs"},
    **{"nerfstudio": "gsplat", "nerfstudio-antialiased": "gsplat-antialiased"},
}

# What is asked for, but has no record: why, and what to take instead.
SECRET = "its source is not public, so that how it draws is not known; take portable, which suits many viewers"
NO_RECORD = {
    **dict.fromkeys(("luma", "polycam", "postshot", "scaniverse"), SECRET),
    "blender": "add-ons draw splats in it, of which KIRI's 3DGS Render is known; take kiri",
    "unreal": "its plug-ins blend and map tones as the engine does, which is not simulated; take portable, which suits many viewers",
}

VIEWERS = Registry("mipmap_plugin.viewers", {})


def register_viewer(name: str, viewer: Viewer | tuple[str, ...] | str, *, replace: bool = False) -> None:
    """Register a viewer under `name`: a record, or `"package.module:RECORD"`, which is imported at first use; or a group, given by the
    names of registered viewers, that one file has to suit. Raises SettingsError for a name that is taken, or cannot be part of a file's."""
    if isinstance(name, str) and not IN_FILES.fullmatch(name):
        raise SettingsError(NOT_IN_FILES.format(name=name))
    VIEWERS.add(name, viewer, replace=replace)


for _viewer in BUILT_IN:
    register_viewer(_viewer.name, _viewer)
for _alias, _name in ALIASES.items():
    register_viewer(_alias, VIEWERS.get(_name))
register_viewer("portable", tuple(viewer.name for viewer in BUILT_IN if viewer not in (SUPERSPLAT_VIEWER, *FURTHER)))
VIEWERS.seal()


def _registered(name: str) -> Any:
    if isinstance(name, str) and name in NO_RECORD and name not in VIEWERS.names():
        raise SettingsError(f"viewer {name}: {NO_RECORD[name]}")
    viewer = VIEWERS.get(name)
    if not IN_FILES.fullmatch(name):  # of an entry point
        raise PluginError(NOT_IN_FILES.format(name=name))
    return viewer


def own_name(name: str) -> str:
    """The name of the record that people know by `name` too."""
    return ALIASES.get(name, name)


def viewers_for(name: str) -> tuple[str, ...]:
    """The names of the viewers that a file for `name` has to suit: `name` itself, or the members of a group.

    Raises SettingsError for an unknown viewer, PluginError for a group that is not made of names.
    """
    viewer = _registered(name)
    if not isinstance(viewer, tuple):
        return (name,)
    known = VIEWERS.names()
    if not viewer or any(member not in known for member in viewer):
        raise PluginError(f"viewer group {name!r} must contain names of registered viewers, got {viewer!r}")
    return viewer


def degree_for(viewer: str | None, degree: int) -> int:
    """The SH degree of a PLY that the viewer, or each of a group, reads right and draws as one of this `degree`; the highest where there is none.

    Raises what `viewers_for` does.
    """
    read = set.intersection(*(set(find_viewer(name).read_degrees) for name in viewers_for(viewer))) if viewer else {degree}
    return min((each for each in read if each >= degree), default=max(read, default=degree))


def reads_extra_columns(viewer: str | None) -> bool:
    """Whether the loader of the viewer, or of each of a group, reads a PLY with further columns. Raises what `viewers_for` does."""
    return viewer is None or all(find_viewer(name).extra_columns for name in viewers_for(viewer))


def find_viewer(name: str) -> Viewer:
    """The viewer `name`. Raises SettingsError if it is unknown or a group, PluginError if its target is not a `Viewer`."""
    viewer = _registered(name)
    if isinstance(viewer, tuple):
        raise SettingsError(f"{name} is a group of viewers, which draw a file differently; name one of them: {', '.join(viewers_for(name))}")
    if not isinstance(viewer, Viewer):
        raise PluginError(f"viewer {name!r} must be a mipmap_plugin.splatting.viewers.Viewer, got {type(viewer).__name__}")
    return viewer


def single_viewers() -> list[str]:
    """The names of all viewers, each once, without groups of them and without those of packages that cannot be loaded."""
    found = []
    for name in VIEWERS.names():
        with contextlib.suppress(PluginError, SettingsError):
            find_viewer(name)
            found.append(own_name(name))
    return list(dict.fromkeys(found))
