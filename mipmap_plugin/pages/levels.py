"""The page of a ladder of levels: what is shown at each zoom, how good it is, and where levels change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.here import size_in_bytes
from mipmap_plugin.levels.contents import Contents
from mipmap_plugin.levels.yardstick import Yardstick, shrunk
from mipmap_plugin.pages.gallery import effects_of_base
from mipmap_plugin.pages.record import Page, Picture, Role, Zoom, zoom_name

# What the pictures are compared with.
TRUTH = "the base's own image, made smaller (no photographs)"

# Zooms that differ relatively by less are shown as one.
SAME = 1e-3


def levels_page(title: str, ladder: Contents, manifest: dict[str, Any], commands: Sequence[str]) -> Page:
    """The page of a ladder and its manifest (`levels.manifest`): pictures at the scale of each level and at each switch."""
    yardstick = Yardstick(ladder.base, ladder.request.seed)
    switches = [switch.zoom for switch in ladder.switches]
    scales = [level.band.scale for level in ladder.levels if not any(math.isclose(level.band.scale, zoom, rel_tol=SAME) for zoom in switches)]
    zooms = [_zoom(ladder, yardstick, scale) for scale in sorted(scales + switches)]
    effects = effects_of_base(ladder.base)
    where = f"from {rounded(ladder.curve[0].zoom)} to {rounded(ladder.curve[-1].zoom)}"
    return Page(title, lead(manifest, where), commands, zooms, ladder=manifest, effects=effects, provenance=manifest["versions"])


@torch.no_grad()
def _zoom(ladder: Contents, yardstick: Yardstick, scale: float) -> Zoom:
    """The base in the viewer, the level that is shown, at a switch the next one too, and the supersampled base."""
    viewer, (view, image) = ladder.request.viewer, yardstick.example()
    camera = view.zoomed(scale)
    truth = shrunk(image, camera).clamp(0, 1)
    base = ladder.base.render(camera, viewer=viewer).image
    pictures = [_picture(f"base in {viewer}", "base", base, truth, yardstick.psnr_of_base(viewer, scale))]
    for name, role, number in _shown(ladder, scale):
        adapted = ladder.levels[number].adapted
        pictures.append(_picture(name, role, adapted.render(camera).image, truth, yardstick.psnr(adapted, scale), f"level_{number}.ply"))
    pictures.insert(2, Picture("base, supersampled", "truth", truth, note=TRUTH))
    return Zoom(rounded(scale), scale, pictures, view.name, TRUTH, f"{plural(len(yardstick.views), 'view')} that no level was adapted to")


def _shown(ladder: Contents, scale: float) -> list[tuple[str, Role, int]]:
    """The level that is shown at a zoom, and at a switch the one after it: name, role, number."""
    number = sum(scale < switch.zoom for switch in ladder.switches)
    found: list[tuple[str, Role, int]] = [("level shown", "adapted", number)]
    if any(scale == switch.zoom for switch in ladder.switches):
        found.append(("next level", "other", number + 1))
    return found


def _picture(name: str, role: Role, image: Tensor, truth: Tensor, mean: float, note: str = "") -> Picture:
    image = image.clamp(0, 1)
    return Picture(name, role, image, {"psnr_db": psnr(image, truth)}, {"psnr_db": mean}, note)


def rounded(zoom: float) -> str:
    """A zoom to three digits."""
    return zoom_name(float(f"{zoom:.3g}"))


def lead(manifest: dict[str, Any], where: str) -> str:
    """What came out. `where`: what the curve is over."""
    levels, curve = manifest["levels"], manifest["curve"]
    splats, size = (sum(level[of] for level in levels) for of in ("splats", "bytes"))
    base = [point["base_db"] for point in curve]
    return (
        f"{plural(len(levels), 'level')} for {manifest['viewer']}, {plural(splats, 'splat')}, {size_in_bytes(size)}: {where} at worst "
        f"{manifest['worst_db']:.1f} dB, {manifest['mean_db']:.1f} dB on average; the base alone: at worst {min(base):.1f} dB, "
        f"{fmean(base):.1f} dB on average."
    )
