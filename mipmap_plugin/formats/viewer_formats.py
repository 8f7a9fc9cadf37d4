"""Which viewers read the exchange formats that are written here, found in their sources. Every viewer reads a PLY."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import is_glb, is_spz

# Viewers that do not read an SPZ as it is written here, and why. "classic" and "antialiased" are names for whatever draws as 3DGS does, some of which
# reads it.
NO_SPZ = {
    "gaussian-splats-3d": "GaussianSplats3D 0.4.7 reads .spz up to version 2, and splat-transform writes 3 at least",
    **dict.fromkeys(("antimatter15", "aframe", "gsplat-js"), "antimatter15/splat, aframe-gaussian-splatting and gsplat.js read no .spz"),
    "mip": "Mip-Splatting reads PLYs only, with a column filter_3D that .spz has no place for",
    "kiri": "KIRI's add-on for Blender reads PLYs only",
}

# Viewers that read a .glb as it is written here: three.js by an extension of its loader, Babylon.js by the package of its loaders.
READ_GLB = ("playcanvas", "playcanvas-webgpu", "playcanvas-aa", "three", "babylon", "classic", "antialiased")

# Viewers that do not, and why. Of viewers in neither list it is not known.
NO_GLB = {
    **{
        viewer: f"{viewer} reads no splats in glTF"
        for viewer in ("spark", "gaussian-splats-3d", "gsplat-js", "antimatter15", "aframe", "mip", "brush", "lichtfeld", "web-splat",
                       "visionary", "metalsplatter", "vk-gaussian-splatting", "splatapult", "gdgs", "3dgs.cpp", "kiri")
    },
    "cesium": "Cesium draws no splats in glTF but SPZ, as levels --tiles writes them",
}  # fmt: skip


def refuse_unread(path: Path, viewers: Sequence[str]) -> None:
    """Raise SettingsError for an output that none of the viewers it is made for reads; warn of one that only some of them read."""
    unread = NO_GLB if is_glb(path) else NO_SPZ if is_spz(path) else {}
    reasons = {viewer: unread[viewer] for viewer in viewers if viewer in unread}
    if not reasons:
        return
    advice = f"{path}: {'; '.join(dict.fromkeys(reasons.values()))}; give a .ply by --output"
    if len(reasons) == len(viewers):
        raise SettingsError(advice)
    warnings.warn(f"{advice} if it is for these too", stacklevel=3)
