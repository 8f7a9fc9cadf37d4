"""Each tile's picture of each view by itself, as a sweep begins. Of these layers all tiles' halos are made, so that each splat is drawn once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.renderers import unrounded
from mipmap_plugin.effects import Effects
from mipmap_plugin.tiles.folder import layer_file
from mipmap_plugin.tiles.pictures import Box, new_pictures
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.slabs import BLACK
from mipmap_plugin.tiles.steering import Steered
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep


def on_black(effects: Effects) -> Effects:
    """The effects on black, as the steps draw."""
    return replace(unrounded(effects), background=BLACK)


@torch.no_grad()
def draw_layers(scene: TiledScene, number: int, sweep: Sweep) -> None:
    """Draw a tile in each of a sweep's views, and write [h, w, 4] half of each: the picture on black, and the transmittance."""
    splats = scene.kind(Store(Steered.before(scene.folder, sweep.number).file(scene.folder, number)).parameters()).gaussians()
    effects = on_black(scene.target)
    with new_pictures(layer_file(scene.folder, number, sweep.halos)) as write:
        for view in scene.sweep_views(sweep):
            rendered = scene.backend.render(splats, view.zoomed(scene.scale), effects)
            if (box := box_of(rendered.alpha > 0)) is not None:
                layer = torch.cat([rendered.image, (1 - rendered.alpha)[..., None]], dim=2)
                write(view.name, within(layer, box).half(), box)


def box_of(shown: Tensor, pad: int = 0) -> Box | None:
    """The box around what is True in `shown` [H, W], and so many pixels more, within the picture; None if nothing is."""
    rows, columns = (shown.any(dim=dim).nonzero()[:, 0] for dim in (1, 0))
    if not len(rows):
        return None
    height, width = shown.shape
    left, top = max(0, int(columns[0]) - pad), max(0, int(rows[0]) - pad)
    return left, top, min(width, int(columns[-1]) + 1 + pad), min(height, int(rows[-1]) + 1 + pad)


def within(picture: Tensor, box: Box) -> Tensor:
    """A view of the part of a picture [H, W, ...] that a box shows."""
    left, top, right, bottom = box
    return picture[top:bottom, left:right]
