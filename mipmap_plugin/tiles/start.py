"""The splats that the tiles begin with, and that all other tiles see of each: as without tiles, but merged core by core and measured on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.adaptation.start.candidates import WEIGHT_VIEWS
from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, FormSettings, closed_form, filter_suffices, pixel_size
from mipmap_plugin.adaptation.start.matching import matched_opacities
from mipmap_plugin.adaptation.start.merging import merge
from mipmap_plugin.camera import evenly
from mipmap_plugin.formats.ply_rows import PlyRows
from mipmap_plugin.formats.torch_file import save_torch
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.truth import Truths

# What is tried after `merge_to`, where merging loses too much: its roots.
ROOTS = (1, 2, 4)


def start_file(folder: Path, number: int) -> Path:
    """The file of the splats that a tile begins with."""
    return folder / f"start_{number}.ply"


def base_file(folder: Path, number: int) -> Path:
    """The file of a tile's splats in the base, where nothing was better than that."""
    return folder / f"base_{number}.ply"


def tile_file(folder: Path, number: int) -> Path:
    """The file of an adapted tile."""
    return folder / f"tile_{number}.ply"


def open_starts(scene: TiledScene, folder: Path) -> Splats:
    """The splats that all tiles begin with, tile after tile."""
    return Splats.of(scene.kind, [PlyRows(start_file(folder, number)) for number in range(len(scene.cores))])


def open_tiles(scene: TiledScene, folder: Path) -> Splats:
    """All adapted tiles, one after the other."""
    return Splats.of(scene.kind, [PlyRows(tile_file(folder, number)) for number in range(len(scene.cores))])


def write_base(scene: TiledScene, files: Sequence[Path]) -> None:
    """Write the base's own splats of each tile to its file."""
    for file, core in zip(files, scene.cores, strict=True):
        scene.for_target(scene.base.parameters(core)).save(file, provenance={}, overwrite=True)


class StartSearch:
    """Tries the starts of `adaptation.start.candidates` on the whole scene, and leaves the best in `folder`."""

    def __init__(self, scene: TiledScene, folder: Path) -> None:
        self.scene, self.folder = scene, folder
        self.truths = Truths.whole(folder, scene.views.steering)
        self.matches = scene.scale <= 1 and not filter_suffices(scene.scale, scene.base_effects, scene.target)
        self.views = evenly(scene.views.adapted, WEIGHT_VIEWS)

    @torch.no_grad()
    def run(self) -> None:
        """Write the start of each tile, and `start.pt`: its name, and the blend weight of each splat in target pixels of a view."""
        scene, config = self.scene, self.scene.config
        weights = scene.painter(scene.base_effects).blend_weights(scene.base, self.views) * scene.scale**2
        if not (config.closed_form or config.merge_to < 1):
            return self._take_base(weights)
        formed = self._candidate(weights, 1.0)
        formed_db = self.steer(open_starts(scene, self.folder))
        base_db = self.steer(self.scene.base)
        for fraction in (config.merge_to ** (1 / root) for root in ROOTS) if config.merge_to < 1 else ():
            merged = self._candidate(weights, fraction)
            merged_db = self.steer(open_starts(scene, self.folder))
            if merged_db >= formed_db - config.merging_costs:
                return self._done("the closed form of merged splats", merged) if merged_db >= base_db else self._take_base(weights)
        if formed_db < base_db:
            return self._take_base(weights)
        if config.merge_to < 1:
            formed = self._candidate(weights, 1.0)
        return self._done("the closed form", formed)

    def steer(self, splats: Splats) -> float:
        """PSNR (dB) on the steering views."""
        return psnr(self.scene, splats, self.truths, self.scene.views.steering)

    def _candidate(self, weights: Tensor, fraction: float) -> Tensor:
        """Write the closed form of the base after merging each core down to a fraction; return the blend weight that each splat should have."""
        wanted = torch.cat([self._merged(number, weights, fraction) for number in range(len(self.scene.cores))])
        if self.matches:
            self._match(wanted)
        return wanted

    def _merged(self, number: int, weights: Tensor, fraction: float) -> Tensor:
        scene, core = self.scene, self.scene.cores[number]
        model = scene.for_target(scene.base.parameters(core))
        merged_weights = [weights[core]]

        def merged(gaussians: Gaussians) -> Gaussians:
            pixel = pixel_size(gaussians.means, scene.views.adapted) / scene.scale
            splats, merged_weights[0] = merge(gaussians, pixel, weights[core], fraction)
            return splats

        def formed(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
            form = FormSettings(1.0 if self.matches else AREA_POWER, scene.config.crispness)
            return closed_form(gaussians, scene.views.adapted, scene.scale, scene.base_effects, scene.target, form)

        if fraction < 1:
            model.rebuild(merged)
        if scene.config.closed_form:
            model.reshape(formed)
        model.save(start_file(self.folder, number), provenance={}, overwrite=True)
        scene.base.release()
        return merged_weights[0]

    def _match(self, wanted: Tensor) -> None:
        """Give the splats opacities with which they have the `wanted` blend weights [N] (`start.matching`), and write them again."""
        splats = open_starts(self.scene, self.folder)
        views = [view.zoomed(self.scene.scale) for view in self.views]
        painter = self.scene.painter(self.scene.target)

        def weights_of(opacities: Tensor) -> Tensor:
            splats.opacities = opacities
            return painter.blend_weights(splats, views)

        opacities = splats.gaussians(torch.arange(len(splats))).opacities
        opacities = matched_opacities(opacities, wanted, weights_of)
        for number, (first, end) in enumerate(zip(splats.starts, splats.starts[1:], strict=False)):
            model = self.scene.for_target(splats.parameters(torch.arange(first, end)))
            _set_opacities(model, opacities[first:end])
            model.save(start_file(self.folder, number), provenance={}, overwrite=True)

    def _take_base(self, weights: Tensor) -> None:
        write_base(self.scene, [start_file(self.folder, number) for number in range(len(self.scene.cores))])
        self._done(AS_IT_IS, weights[torch.cat(self.scene.cores)])

    def _done(self, name: str, weights: Tensor) -> None:
        facts: dict[str, Any] = {"name": name, "weights": weights}
        save_torch(self.folder / "start.pt", facts, overwrite=True)


def _set_opacities(model: VanillaModel, opacities: Tensor) -> None:
    model.reshape(lambda gaussians: (gaussians.scales, opacities))


@torch.no_grad()
def psnr(scene: TiledScene, splats: Splats, truths: Truths, views: Any) -> float:
    """The mean PSNR (dB) of splats as the target shows them over views, of images clamped as a display does."""
    painter = scene.painter(scene.target)
    psnrs = []
    for view in views:
        image = painter.image(splats, view.zoomed(scene.scale)).clamp(0, 1)
        psnrs.append(decibel(float((image - truths(view)).square().mean())))
        splats.release()
    return fmean(psnrs) if psnrs else 0.0
