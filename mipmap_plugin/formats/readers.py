"""Which viewers do not read which exchange formats, by their source: for these a PLY has to be written. Of others it is not known, or they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mipmap_plugin.errors import SettingsError, warn

# Viewers that read a .glb as it is written here, and names for whatever draws as 3DGS does: three.js by an extension of its loader, Babylon.js by the
# package of its loaders.
READ_GLB = ("playcanvas", "playcanvas-webgpu", "playcanvas-aa", "three", "babylon", "classic", "antialiased")

NOT_IN_PLY = "Mip-Splatting reads PLYs only, with a column filter_3D that {} has no place for"
KIRI = "KIRI's add-on for Blender reads PLYs only"

# Viewers that read PLYs, and no other format that is written here.
PLY_ONLY = ("3dgs.cpp", "web-splat", "splatapult")

# Viewers that open no file of splats by itself.
TILES_ONLY = {"cesium": "Cesium opens splats in 3D Tiles only, which levels --tiles writes"}


def _read_no(ending: str, *viewers: str) -> dict[str, str]:
    told = {"mip": NOT_IN_PLY.format(ending), "kiri": KIRI, **TILES_ONLY}
    told |= dict.fromkeys(("antimatter15", "aframe", "gsplat-js"), f"antimatter15/splat, aframe-gaussian-splatting and gsplat.js read no {ending}")
    return told | {viewer: f"{viewer} reads no {ending}" for viewer in (*PLY_ONLY, *viewers)}


# By the ending of a file: viewer -> why it does not read it.
UNREAD: dict[str, dict[str, str]] = {
    ".spz": {
        **_read_no(".spz", "brush", "gdgs", "supersplat-viewer"),
        "gaussian-splats-3d": "GaussianSplats3D 0.4.7 reads .spz up to version 2, and splat-transform writes 3 at least",
        "unity": "UnityGaussianSplatting 1.1.1 reads .spz of version 2 only, and splat-transform writes 3 at least",
    },
    ".sog": _read_no(".sog", "brush", "gaussian-splats-3d", "unity", "three", "metalsplatter", "vk-gaussian-splatting"),
    ".compressed.ply": _read_no(".compressed.ply", "unity", "three", "metalsplatter", "vk-gaussian-splatting", "lichtfeld"),
    ".glb": {
        **{
            viewer: f"{viewer} reads no splats in glTF"
            for viewer in ("spark", "gaussian-splats-3d", "gsplat-js", "antimatter15", "aframe", "mip", "brush", "lichtfeld", "visionary", "unity",
                           "metalsplatter", "vk-gaussian-splatting", "gdgs", "kiri", "supersplat-viewer", *PLY_ONLY)
        },
        **TILES_ONLY,
    },
}  # fmt: skip

# The same of viewers in whose name more than one program is, of which some do.
PARTLY = {
    ".spz": dict.fromkeys(
        ("playcanvas", "playcanvas-aa", "playcanvas-webgpu"), "PlayCanvas's engine and supersplat-viewer read no .spz, SuperSplat's editor does"
    )
}


def refuse_unread(path: Path, viewers: Sequence[str]) -> None:
    """Raise SettingsError for an output that none of the viewers it is made for reads; warn of one that only some of them read.

    Tiles may be made of a PLY or a folder, so that it is written for viewers that open tiles only, and warned of.
    """
    unread, partly = ({viewer: told[viewer] for viewer in viewers if viewer in told} for told in (_told(path, UNREAD), _told(path, PARTLY)))
    if viewers and not unread and set(viewers) <= TILES_ONLY.keys():
        warn(f"{path}: {TILES_ONLY[viewers[0]]}")
    elif reasons := "; ".join(dict.fromkeys([*unread.values(), *partly.values()])):
        advice = f"{path}: {reasons}" + ("" if set(viewers) <= TILES_ONLY.keys() else "; give a .ply by --output")
        if len(unread) == len(viewers):
            raise SettingsError(advice)
        warn(f"{advice} if it is for these too")


def _told(path: Path, by_ending: Mapping[str, dict[str, str]]) -> dict[str, str]:
    return next((told for ending, told in by_ending.items() if path.name.lower().endswith(ending)), {})
