"""One tile: its core is adapted in front of, behind and among the splats of the others."""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import StateKeeper, load_run, save_run
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import Steering, Validation
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles.crops import Crop, crops
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.start import open_round
from mipmap_plugin.tiles.surroundings import Surroundings
from mipmap_plugin.tiles.truth import Truths


# The fraction of the steps after which each round ends.
ROUNDS = tuple(float(each) for each in os.environ.get("ROUNDS", "0.1,0.25,0.5,1").split(","))
ATTRIBUTE = os.environ.get("ATTRIBUTE", "1") == "1"


class _RoundEnds(Exception):
    """The steps of a round are done."""


class Tile:
    """A core with its views in one round."""

    def __init__(self, scene: TiledScene, number: int, finished: int, folder: Path) -> None:
        """`finished`: how many rounds are done."""
        self.scene, self.number, self.finished, self.folder = scene, number, finished, folder
        starts = open_round(scene, folder, finished)
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
        self.truths = Truths(folder, {crop.camera.name: crop.box for crop in self.crops})
        unrounded = replace(scene.target, settings=replace(scene.target.settings, packing=None, picture_step=None))
        self.surroundings = Surroundings(starts, core, self.crops, scene.painter(unrounded)) if self.crops else None
        self.wanted = {crop.camera.name: self._wanted(crop.camera) for crop in self.crops}

    @torch.no_grad()
    def _wanted(self, camera: Camera) -> Tensor:
        """[h, w, 3]: the truth, with the part of the error that is the halo's, by its fraction of the blend weights."""
        truth = self.truths(camera)
        if not ATTRIBUTE: return truth
        core = self.start.gaussians()
        error = self.surroundings.render(core, camera) - truth
        return truth + (1 - self.surroundings.share(core, camera)) * error

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
        if not (config.steps and self.views and self.steering and self.choosing and self.surroundings):
            ended_by = "0 steps" if not config.steps else "no view shows enough of it"
            return self.start, facts | {"ended_by": ended_by, "returned": "the start", "seconds": time.perf_counter() - began}, None
        facts["drawn_beside"] = self.surroundings.beside
        task = self._task()
        student = self.start.copy()
        if not self.scene.target.sh_degree:
            student.parameters()["shN"].requires_grad_(False)
        keeper = StateKeeper(resume, self._fingerprint())
        run = keeper.start_or_resume(student, task, config, 0.0)
        first, last = (round(config.steps * each) for each in ((0.0, *ROUNDS)[self.finished], ROUNDS[self.finished]))
        if run.step <= first and self.finished:
            run = load_run(load_torch(self.folder / f"tile_{self.number}_round_{self.finished}.run"), student, config)
            run.steering = replace(Steering.begin(student, task.validation.steer(student)), ceiling=run.steering.ceiling)

        def after_step(run: Run) -> None:
            keeper.save_if_due(run)
            if first < run.step == last < config.steps:
                raise _RoundEnds

        try:
            ended_by = adapt(run, task, config, keeper.save_and_stop, after_step)
        except _RoundEnds:
            save_run(run, self.folder / f"tile_{self.number}_round_{self.finished + 1}.run", "")
            return run.student, facts, keeper
        name, model, psnrs = self._best(run, task.validation)
        facts |= {"ended_by": ended_by, "returned": name, "validation": psnrs, "splats_after": len(model.parameters()["means"])}
        facts |= {"curve": [point.model_dump() for point in run.curve], "seconds": time.perf_counter() - began}
        return model, facts, keeper

    def _task(self) -> Task:
        """What the loop optimizes. The views are those of the new scale, so that there is nothing left to zoom."""
        assert self.surroundings is not None
        render, truth = self.surroundings.render, lambda camera: self.wanted[camera.name]
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
        return hashlib.sha256(json.dumps([self.scene.digest, self.finished, start, self.config.model_dump(), poses]).encode()).hexdigest()
