"""One tile: its core is adapted in front of, behind and among the splats of the others."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import StateKeeper
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles.crops import crops
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.start import open_starts
from mipmap_plugin.tiles.surroundings import Surroundings
from mipmap_plugin.tiles.truth import Truths


class Tile:
    """A core with its views."""

    def __init__(self, scene: TiledScene, number: int, folder: Path) -> None:
        self.scene, self.number = scene, number
        starts = open_starts(scene, folder)
        core = torch.arange(starts.starts[number], starts.starts[number + 1])
        weights = load_torch(folder / "start.pt")["weights"][core]
        self.start = scene.for_target(starts.parameters(core))
        near = scene.target.near_plane
        adapted, steering, choosing = (
            crops(starts, core, weights, [view.zoomed(scene.scale) for view in views], near)
            for views in (scene.views.adapted, scene.views.steering, scene.views.choosing)
        )
        self.crops = [*adapted, *steering, *choosing]
        self.views, self.steering, self.choosing = ([crop.camera for crop in each] for each in (adapted, steering, choosing))
        truths = Truths(folder, {crop.camera.name: crop.box for crop in self.crops})
        unrounded = replace(scene.target, settings=replace(scene.target.settings, packing=None, picture_step=None))
        self.surroundings = Surroundings(starts, core, self.crops, scene.painter(unrounded))
        splats = self.start.gaussians().detach()
        self._wanted = {camera.name: self.surroundings.wanted(splats, camera, truths(camera)) for camera in (crop.camera for crop in self.crops)}

    @property
    def config(self) -> AdaptConfig:
        """The settings of the whole scene, with as many views a step as would show this tile if they were drawn from all."""
        config = self.scene.config
        views = round(config.views_per_step * len(self.views) / max(1, len(self.scene.views.adapted)))
        return config.model_copy(update={"views_per_step": max(1, views)})

    def adapt(self, resume: Path) -> tuple[VanillaModel, dict[str, Any], StateKeeper | None]:
        """Adapt the core, or continue from the state in `resume`; return it, what there is to say, and what keeps the state until it is saved."""
        began, config = time.perf_counter(), self.config
        facts: dict[str, Any] = {"tile": self.number, "splats": len(self.start), "views": len(self.views), "views_per_step": config.views_per_step}
        if not (config.steps and self.views and self.steering and self.choosing):
            ended_by = "0 steps" if not config.steps else "no view shows enough of it"
            return self.start, facts | {"ended_by": ended_by, "returned": "the start", "seconds": time.perf_counter() - began}, None
        facts["drawn_beside"] = round(self.surroundings.beside)
        task = self._task()
        student = self.start.copy()
        if not self.scene.target.sh_degree:
            student.parameters()["shN"].requires_grad_(False)
        keeper = StateKeeper(resume, self._fingerprint())
        run = keeper.start_or_resume(student, task, config, 0.0)
        ended_by = adapt(run, task, config, keeper.save_and_stop, keeper.save_if_due)
        name, model, psnrs = self._best(run, task.validation)
        facts |= {"ended_by": ended_by, "returned": name, "validation": psnrs, "splats_after": len(model.parameters()["means"])}
        facts |= {"curve": [point.model_dump() for point in run.curve], "seconds": time.perf_counter() - began}
        return model, facts, keeper

    def _task(self) -> Task:
        """What the loop optimizes. The views are those of the new scale, so that there is nothing left to zoom."""
        render = self.surroundings.render

        def truth(camera: Camera) -> Tensor:
            return self._wanted[camera.name].float()

        validation = Validation(self.steering, self.choosing, 1.0, truth, render, self.scene.config.resize)
        white = self.scene.target.background == (1.0, 1.0, 1.0)
        return Task(self.views, 1.0, truth, render, white, validation)

    def _best(self, run: Run, validation: Validation) -> tuple[str, VanillaModel, dict[str, float]]:
        """The best of the start, the best state on steering views and the last one, on views that did not steer (as `adaptation.session`)."""
        states: dict[str, Any] = {"the start": self.start}
        if 0 < run.steering.best_step < run.step:
            states[f"the state after step {run.steering.best_step}"] = run.steering.best.over(self.start)
        if not run.curve[-1].taken_back:
            states["the last state"] = run.student
        name, psnrs = validation.choose(states)
        if self.scene.config.returns == "last":
            name = next(reversed(states))
        return name, states[name], psnrs

    def _fingerprint(self) -> str:
        """A hash of everything that the run depends on."""
        poses = [[*view.size, view.fx, view.cx, view.cy, *view.viewmat.flatten().tolist()] for view in self.views]
        start = [hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest() for tensor in self.start.parameters().values()]
        return hashlib.sha256(json.dumps([self.scene.digest, start, self.config.model_dump(), poses]).encode()).hexdigest()
