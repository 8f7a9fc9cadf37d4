"""The splats that the tiles begin with. They are found as without tiles, but merged core by core, and drawn from the disk to be compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.validation import mean_db
from mipmap_plugin.adaptation.pixel_size import LEAST_VIEWS, pixel_size, views_for
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.adaptation.start.blend_weights import may_show, whole_weights
from mipmap_plugin.adaptation.start.candidates import mildest_costs, start_name
from mipmap_plugin.adaptation.start.closed_form import FormSettings, closed_form, draws_alike, filter_suffices
from mipmap_plugin.adaptation.start.matching import matched_opacities
from mipmap_plugin.adaptation.start.merging import merge_seen
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.formats.torch_file import save_torch
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process import pool
from mipmap_plugin.tiles.folder import START, start_file
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.store import Store, write_store
from mipmap_plugin.tiles.truth import Truths

# The roots of `merge_to` that are tried, as without tiles (`candidates.POWERS`): the last, the mildest, and then the others.
ROOTS = (1, 2, 4)

CANDIDATES = ("formed", "mildest", "merged")  # names of their files


class StartSearch:
    """Tries the starts of `adaptation.start.candidates` on the whole scene, and leaves the best in its folder."""

    def __init__(self, scene: TiledScene) -> None:
        self.scene, self.truths = scene, Truths(scene)
        effects = scene.base_effects, scene.target
        self.alike = draws_alike(*effects)
        self.forms = scene.config.closed_form and not filter_suffices(*effects)
        self.views: list[Camera] = []  # those in which blend weights are measured, which `_measured` finds

    @torch.no_grad()
    def run(self) -> None:
        """Write the start of each tile, and `start.pt`: its name, and its PSNR on the steering views."""
        config, base_db = self.scene.config, self.steer(self.scene.base)
        if not (self.forms or config.merge_to < 1):
            return self._take_base(base_db)
        weights = self._measured()
        pool.release_to_system()
        self._candidate("formed", weights, 1.0)
        formed_db = self.steer(self._open("formed"))
        if self.alike and formed_db < base_db:  # the filter itself is the better answer, for merged splats too, as without tiles
            self.forms, formed_db = False, base_db
        if config.merge_to < 1 and self._takes_merged(weights, formed_db, base_db):
            return
        if formed_db < base_db or not self.forms:
            return self._take_base(base_db)
        self._take("formed", start_name(self.forms), formed_db)

    def _measured(self) -> Tensor:
        """[N]: the blend weights of the base's splats, in target pixels of a view, from as many views as show enough of them, as without tiles."""
        scene, painter = self.scene, self.scene.painter(self.scene.base_effects)
        first = evenly(scene.views.adapted, LEAST_VIEWS)
        weights, shown = painter.weighed(scene.base, first)
        self.views = evenly(scene.views.adapted, views_for(shown))
        if further := [view for view in self.views if view not in first]:
            weights = weights.lerp(painter.weighed(scene.base, further)[0], len(further) / (len(first) + len(further)))
        return weights * scene.scale**2

    def _takes_merged(self, weights: Tensor, formed_db: float, base_db: float) -> bool:
        """Take the strongest merging that costs little, and return whether there is one; where the mildest costs too much, no other is tried."""
        scene, config = self.scene, self.scene.config

        def tried(name: str, root: int, costs: float) -> tuple[float, bool]:
            self._candidate(name, weights, config.merge_to ** (1 / root))
            psnr = self.steer(self._open(name))
            return psnr, psnr >= max(formed_db - costs, base_db)

        title = start_name(self.forms, merged=True)
        mildest_db, suits = tried("mildest", ROOTS[-1], mildest_costs(config, scene.base_effects, scene.target))
        for root in ROOTS[:-1] if suits or mildest_db >= formed_db else ():
            merged_db, is_taken = tried("merged", root, config.merging_costs)
            if is_taken:
                self._take("merged", title, merged_db)
                return True
        if suits:
            self._take("mildest", title, mildest_db)
        return suits

    def steer(self, splats: Splats) -> float:
        """PSNR (dB) on the steering views."""
        return psnr(self.scene, splats, self.truths, self.scene.views.steering)

    def _file(self, name: str, number: int) -> Path:
        return self.scene.folder / f"{name}_{number}.splats"

    def _open(self, name: str) -> Splats:
        return Splats.of(self.scene.kind, [Store(self._file(name, number)) for number in range(len(self.scene.cores))])

    def _candidate(self, name: str, weights: Tensor, fraction: float) -> None:
        """Write the closed form of the base after merging each core down to a fraction."""
        cores = range(len(self.scene.cores))
        merged = [self._merged(self._file(name, number), self.scene.cores[number], weights, fraction) for number in cores]
        pool.release_to_system()
        if self.forms:
            self._match(name, *map(torch.cat, zip(*merged, strict=True)))
            pool.release_to_system()

    def _merged(self, file: Path, core: Tensor, weights: Tensor, fraction: float) -> tuple[Tensor, Tensor]:
        """Write a core's candidate; returns its blend weights, and those that it had if nothing hid it."""
        scene = self.scene
        model = scene.for_target(scene.base.parameters(core))
        own, whole = weights[core], torch.empty(0)

        def sizes(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
            """Of a base pixel at each splat, and of the splat's weight if nothing hid it."""
            pixel = pixel_size(gaussians.means, scene.views.adapted, len(self.views))
            return pixel, whole_weights(gaussians, pixel, scene.views.adapted, scene.base_effects, scene.scale)

        def merged(gaussians: Gaussians) -> Gaussians:
            nonlocal own
            pixel, before = sizes(gaussians)
            seen = may_show(own, before, gaussians.means, scene.views.adapted, self.views)
            splats, own = merge_seen(gaussians, pixel / scene.scale, own, fraction, seen)
            return splats

        def formed(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
            nonlocal whole
            pixel, whole = sizes(gaussians)
            form = FormSettings(area_power=1.0, views=len(self.views), pixel=pixel, matched=True)
            return closed_form(gaussians, scene.views.adapted, scene.scale, scene.base_effects, scene.target, form)

        if fraction < 1:
            model.rebuild(merged)
        if self.forms:
            model.reshape(formed)
        write_store(file, model.parameters())
        return own, whole

    def _match(self, name: str, wanted: Tensor, whole: Tensor) -> None:
        """Give the splats opacities with which they have the `wanted` blend weights [N] (`start.matching`), and write them again.

        `whole` [N]: the weights that they would have if nothing hid them.
        """
        splats = self._open(name)
        views = [view.zoomed(self.scene.scale) for view in self.views]
        painter = self.scene.painter(self.scene.target)

        def weights_of(opacities: Tensor) -> Tensor:
            splats.opacities = opacities
            return painter.weighed(splats, views)[0]

        opacities = torch.cat([part.shapes[:, -1] for part in splats.parts]).sigmoid()
        splats.release()
        opacities = matched_opacities(opacities, wanted, whole, weights_of)
        for number, (part, matched) in enumerate(zip(splats.parts, opacities.split([*map(len, splats.parts)]), strict=True)):
            model = self.scene.for_target(part.parameters())
            model.reshape(lambda gaussians: (gaussians.scales, matched))  # noqa: B023  # it is called at once
            write_store(self._file(name, number), model.parameters())

    def _take_base(self, psnr: float) -> None:
        for number, core in enumerate(self.scene.cores):
            write_store(self._file("formed", number), self.scene.base.parameters(core))
        self._take("formed", AS_IT_IS, psnr)

    def _take(self, name: str, title: str, psnr: float) -> None:
        """Keep the splats of a candidate as the start, and delete the other candidates."""
        for number in range(len(self.scene.cores)):
            self._file(name, number).replace(start_file(self.scene.folder, number))
            for other in CANDIDATES:
                self._file(other, number).unlink(missing_ok=True)
        save_torch(self.scene.folder / START, {"name": title, "psnr": psnr}, overwrite=True)


@torch.no_grad()
def psnr(scene: TiledScene, splats: Splats, truths: Truths, views: Any) -> float:
    """The mean PSNR (dB) of splats as the target shows them over views, of images and truths clamped as a display does (`validation.mean_db`)."""
    painter = scene.painter(scene.target)
    images = ((painter.image(splats, view.zoomed(scene.scale)), truths[view.name]) for view in views)
    return mean_db([float((image.clamp(0, 1) - truth.clamp(0, 1)).square().mean()) for image, truth in images])
