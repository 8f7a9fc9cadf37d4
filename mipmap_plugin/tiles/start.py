"""The splats that the tiles begin with. They are found as without tiles, but merged core by core, and drawn from the disk to be compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.adaptation.start.base_weights import note_on_hidden, weighed_in_parts
from mipmap_plugin.adaptation.start.blend_weights import Wanted, may_show, wanted_of, whole_weights
from mipmap_plugin.adaptation.start.closed_form import LEAST_AXIS, FormSettings, closed_form, draws_alike, filter_suffices
from mipmap_plugin.adaptation.start.matching import matched_opacities, sweeps_over
from mipmap_plugin.adaptation.start.merging import merge_down, merge_seen
from mipmap_plugin.adaptation.start.search import MERGED_SPLATS, start_name
from mipmap_plugin.adaptation.start.strength import Bounds, Candidate, Merger, MergingCosts
from mipmap_plugin.adaptation.views.pixel_size import pixel_size
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.formats.torch_file import save_torch
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process import pool
from mipmap_plugin.tiles.folder import START, start_file
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.store import Store, write_store
from mipmap_plugin.tiles.truth import Truths

# What the files of candidates begin with: of the base's splats, and of merged ones.
FORMED, MERGED = "formed", "merged"


class StartSearch:
    """Tries the starts of `adaptation.start.search` on the whole scene, and leaves the best in its folder."""

    def __init__(self, scene: TiledScene) -> None:
        self.scene, self.truths = scene, Truths(scene)
        effects = scene.base_effects, scene.target
        self.alike = draws_alike(*effects)
        self.forms = scene.config.closed_form and not filter_suffices(*effects)
        self.views: list[Camera] = []  # those in which blend weights are measured, which `_measured` finds
        self.shown: list[Tensor] = []  # which splats of each core views show (`may_show`), as far as it is found
        self.notes: list[str] = []

    @torch.no_grad()
    def run(self) -> None:
        """Write the start of each tile, and `start.pt`: its name, its quality on the steering views, and notes on it."""
        config, base = self.scene.config, quality(self.scene, self.scene.base, self.truths)
        if not (self.forms or config.merge_to < 1):
            return self._take_base(base)
        weights = self._measured()
        pool.release_to_system()
        self._write(FORMED, weights, 1.0)
        formed = quality(self.scene, self._open(FORMED), self.truths)
        if self.alike and formed.visible < base.visible:  # the filter itself is the better answer, for merged splats too, as without tiles
            self.forms, formed = False, base
        bounds = Bounds(formed.psnr - config.merging_costs, base.visible, formed.psnr)
        if config.merge_to < 1 and (merged := self._merger(weights).strongest(bounds)):
            return self._take(merged.made, start_name(self.forms, MERGED_SPLATS), merged.quality)
        if not self.forms or formed.visible < base.visible:
            return self._take_base(base)
        self._take(FORMED, start_name(self.forms), formed)

    def _measured(self) -> Tensor:
        """[N, P]: the blend weights of the base's splats, in target pixels of a view, from as many views as show enough of them, as without tiles.

        But always in views of their own size (`base_weights.HALF`).
        """
        scene, painter = self.scene, self.scene.painter(self.scene.base_effects)
        views = scene.views.adapted
        weights, numbers = weighed_in_parts(len(views), lambda some, parts: painter.weighed(scene.base, [views[number] for number in some], parts))
        self.views = [views[number] for number in numbers]
        weights, opacities, self.shown = weights * scene.scale**2, [], []
        for core in scene.cores:
            gaussians = scene.base.gaussians(core, colored=False)
            whole = whole_weights(gaussians, self._pixel_size(gaussians.means), views, scene.base_effects, scene.scale)
            self.shown.append(may_show(weights[core].sum(1), whole, gaussians.means, views, self.views))
            opacities.append(gaussians.opacities)
        self.notes = note_on_hidden(torch.cat(self.shown), torch.cat(opacities))
        return weights

    def _pixel_size(self, means: Tensor) -> Tensor:
        """Of a base pixel at means [N, 3], in world units, [N]."""
        return pixel_size(means, self.scene.views.adapted, len(self.views))

    def _merger(self, weights: Tensor) -> Merger[str]:
        """Merges the base's splats, which have these blend weights [N, P], into candidates, which it names."""
        scene, config = self.scene, self.scene.config

        def merge(power: float, coarsely: bool) -> Candidate[str]:
            name = f"{MERGED}_{power:g}{'_coarsely' if coarsely else ''}"
            self._write(name, weights, config.merge_to**power, coarsely)
            splats = self._open(name)
            return Candidate(name, quality(scene, splats, self.truths), len(splats))

        count, costs = sum(map(len, scene.cores)), MergingCosts.of(config, scene.base_effects, scene.target)
        return Merger(merge, lambda power: math.ceil(config.merge_to**power * count), costs)

    def _file(self, name: str, number: int) -> Path:
        return self.scene.folder / f"{name}_{number}.splats"

    def _open(self, name: str) -> Splats:
        return Splats.of(self.scene.kind, [Store(self._file(name, number)) for number in range(len(self.scene.cores))])

    def _write(self, name: str, weights: Tensor, fraction: float, coarsely: bool = False) -> None:
        """Write the closed form of the base after merging each core down to a fraction; `coarsely`: even where too few splats share a pixel."""
        merged = [self._merged(name, number, weights[core], fraction, coarsely) for number, core in enumerate(self.scene.cores)]
        pool.release_to_system()
        if self.forms:
            self._match(name, Wanted(*map(torch.cat, zip(*merged, strict=True))))
            pool.release_to_system()

    def _merged(self, name: str, number: int, own: Tensor, fraction: float, coarsely: bool) -> Wanted:
        """Write a core's candidate, from its blend weights `own` [N, P]; returns what is wanted of the candidate."""
        scene = self.scene
        model = scene.for_target(scene.base.parameters(scene.cores[number]))
        wanted = Wanted(own, *torch.empty(2, 0))

        def pixel_of(means: Tensor) -> Tensor:
            return self._pixel_size(means) / scene.scale

        def merged(gaussians: Gaussians) -> Gaussians:
            nonlocal own
            if coarsely:
                splats, own = merge_down(gaussians, pixel_of, own, math.ceil(fraction * len(gaussians)))
            else:
                splats, own = merge_seen(gaussians, pixel_of(gaussians.means), own, fraction, self.shown[number])
            return splats

        def formed(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
            nonlocal wanted
            pixel = self._pixel_size(gaussians.means)
            wanted = wanted_of(own, gaussians, pixel, scene.views.adapted, scene.base_effects, scene.scale)
            least = LEAST_AXIS if scene.config.steps and scene.config.time_budget_s is None else 0.0
            form = FormSettings(area_power=1.0, views=len(self.views), pixel=pixel, matched=True, least_axis=least)
            return closed_form(gaussians, scene.views.adapted, scene.scale, scene.base_effects, scene.target, form)

        if fraction < 1:
            model.rebuild(merged)
        if self.forms:
            model.reshape(formed)
        write_store(self._file(name, number), model.parameters())
        return wanted

    def _match(self, name: str, wanted: Wanted) -> None:
        """Give the splats opacities with which they have the `wanted` blend weights (`start.matching`), and write them again."""
        splats = self._open(name)
        views = [view.zoomed(self.scene.scale) for view in self.views]
        painter = self.scene.painter(self.scene.target)

        def weights_of(opacities: Tensor, part: int, parts: int) -> Tensor:
            splats.opacities, some = opacities, views[part::parts]
            return painter.weighed(splats, some, [0] * len(some))[0][:, 0] * (len(some) / len(views))

        opacities = torch.cat([part.mapped()[0][:, -1] for part in splats.parts]).sigmoid()
        opacities = matched_opacities(opacities, wanted, weights_of, sweeps_over(views).usual)
        for number, (part, matched) in enumerate(zip(splats.parts, opacities.split([*map(len, splats.parts)]), strict=True)):
            model = self.scene.for_target(part.parameters())
            model.reshape(lambda gaussians: (gaussians.scales, matched))  # noqa: B023  # it is called at once
            write_store(self._file(name, number), model.parameters())

    def _take_base(self, found: Quality) -> None:
        for number, core in enumerate(self.scene.cores):
            write_store(self._file(FORMED, number), self.scene.base.parameters(core))
        self._take(FORMED, AS_IT_IS, found)

    def _take(self, name: str, title: str, found: Quality) -> None:
        """Keep the splats of a candidate as the start, and delete the other candidates."""
        for number in range(len(self.scene.cores)):
            self._file(name, number).replace(start_file(self.scene.folder, number))
        for other in (*self.scene.folder.glob(f"{FORMED}_*.splats"), *self.scene.folder.glob(f"{MERGED}_*.splats")):
            other.unlink()
        save_torch(self.scene.folder / START, {"name": title, "quality": list(found), "notes": self.notes}, overwrite=True)


def quality(scene: TiledScene, splats: Splats, truths: Truths) -> Quality:
    """The quality on the steering views, as without tiles."""
    return Quality.of([errors_of(scene, splats, truths, scene.views.steering)])


@torch.no_grad()
def errors_of(scene: TiledScene, splats: Splats, truths: Truths, views: Sequence[Camera], effects: Effects | None = None) -> list[float]:
    """The mean square error of each view of splats as the target, or a renderer with these `effects`, shows them, as without tiles: of images and
    truths clamped as a display does."""
    painter = scene.painter(effects or scene.target)
    images = ((painter.image(splats, view.zoomed(scene.scale)), truths[view.name]) for view in views)
    return [float((image.clamp(0, 1) - truth.clamp(0, 1)).square().mean()) for image, truth in images]
