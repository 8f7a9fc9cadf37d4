"""What each tile has around it in each view as a sweep begins: the layers of the others, in the order in which the camera sees the cores.

A layer is the picture of a tile by itself. Of the layers all tiles' halos are made, so that each splat is drawn once.
The order of the cores is right for points, but a splat that reaches across a plane may be drawn on the wrong side of its neighbors. So
layers say only how much a tile shows of what it changes (the transmittance in front of it, the picture behind it); what the view looks like
with all of it is drawn exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.renderers import unrounded
from mipmap_plugin.adaptation.target.image_store import in_16_bits
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.tiles.cut import front_to_back
from mipmap_plugin.tiles.folder import halo_file, layer_file
from mipmap_plugin.tiles.pictures import Album, Box, new_pictures
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.slabs import BLACK, Layer
from mipmap_plugin.tiles.steering import Steered, open_state
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep
from mipmap_plugin.tiles.truth import part_of

# Blend weights of a pixel that are too small to be seen.
INVISIBLE = 1 / 255

# A tile is left out of views of which it fills less than this fraction. Pixels around what it fills that belong to its box.
LEAST, PAD = 1e-3, 8

# Steps from 0 to 1 of halos, which are stored in 8 bits: they decide how strongly a splat is moved, and not what a view looks like.
FINE = 255


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


def draw_halos(scene: TiledScene, part: int, sweep: Sweep) -> None:
    """Draw the `part`-th of a sweep's views as it begins; write each picture as the view's NAME, and the halo of each TILE in it as NAME/TILE."""
    splats, painter = open_state(scene, Steered.before(scene.folder, sweep.number)), scene.painter(on_black(scene.target))
    layers = [Album([layer_file(scene.folder, number, sweep.halos)]) for number in range(len(scene.cores))]
    background = torch.tensor(scene.target.background)
    with new_pictures(halo_file(scene.folder, part, sweep.halos)) as write:
        for view in part_of(scene.sweep_views(sweep), part):
            write(view.name, in_16_bits(painter.draw(splats, view.zoomed(scene.scale)).over(background)), None)
            for number, halo, box in _halos(scene, view, layers):
                write(f"{view.name}/{number}", halo, box)


def _halos(scene: TiledScene, view: Camera, layers: list[Album]) -> Iterator[tuple[int, Tensor, Box]]:
    """Tiles with their halos in a view, [h, w, 5] in 8 bits: the transmittance of what is in front, what is seen of what is behind,
    and the fraction of the pixel's blend weights that the tile has. Layers are read twice, so that memory does not hold those of all tiles at once.
    """
    size = view.zoomed(scene.scale).size
    seen = [number for number in front_to_back(scene.tree, view.center.tolist()) if view.name in layers[number]]
    boxes = {number: layers[number].box(view.name) for number in seen}
    fronts, through = {}, torch.ones(*size, 1)
    for number in seen:
        front = within(through, boxes[number])
        fronts[number] = front.clone()
        front *= layers[number][view.name][..., 3:]
    all_weights = (1 - through).clamp_min(INVISIBLE)
    behind = torch.tensor(scene.target.background).expand(*size, 3).clone()
    for number in reversed(seen):
        picture, front, back = layers[number][view.name].float(), fronts.pop(number), within(behind, boxes[number])
        layer = Layer(picture[..., :3], picture[..., 3:])
        weights = front * (1 - layer.transmittance)
        halo = torch.cat([front, front * back, weights / within(all_weights, boxes[number])], dim=2)
        back.copy_(layer.over(back))
        inner = box_of(weights[..., 0] > INVISIBLE, PAD)
        if inner is not None and float(weights.sum()) > LEAST * size[0] * size[1]:
            left, top, right, bottom = inner
            x, y = boxes[number][:2]
            yield number, (within(halo, inner) * FINE).round().clamp(0, FINE).to(torch.uint8), (x + left, y + top, x + right, y + bottom)


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
