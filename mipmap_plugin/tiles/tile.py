"""One tile in one sweep: its core is adapted in front of, behind and among the splats of the others."""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import StateKeeper
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.adaptation.optimization.validation import no_validation
from mipmap_plugin.adaptation.renderers import color_limits
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.tiles.folder import run_file, start_file, tile_file
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.steering import Steered
from mipmap_plugin.tiles.store import Store, write_store
from mipmap_plugin.tiles.surroundings import Surroundings, nothing
from mipmap_plugin.tiles.sweeps import Sweep

# A tile is not steered by itself (`steering`), and ends with the last sweep, or when its time is over.
STEERED_AS_A_WHOLE = {"returns": "last", "target_db": None, "patience": None}

# Why a tile takes no further step in a sweep, if it has all of them.
SWEEP = "the end of the sweep"


class Tile:
    """A core with its views, in one sweep."""

    def __init__(self, scene: TiledScene, number: int, sweep: Sweep) -> None:
        self.scene, self.number, self.sweep = scene, number, sweep
        self.config = scene.config.model_copy(update=STEERED_AS_A_WHOLE)
        self.before = Steered.before(scene.folder, sweep.number)
        self.student = scene.for_target(Store(self.before.file(scene.folder, number)).parameters())
        self.surroundings = Surroundings(scene, number, sweep)
        self.crops = [*map(self.surroundings.crop, scene.views.adapted)]

    def adapt(self, resume: Path) -> tuple[dict[str, Any], dict[str, Any], StateKeeper | None]:
        """Make the sweep's steps, or continue from the state in `resume`, and write the core at each check.

        Returns what the next sweep goes on with, what there is to say, and what keeps the state until that is saved.
        """
        began, seen = time.perf_counter(), sum(crop is not None for crop in self.crops)
        facts: dict[str, Any] = {"tile": self.number, "sweep": self.sweep.number, "splats": len(self.student), "views": seen}
        student = self.student
        if not seen:
            self._write(student.parameters(), self.sweep.checks)
            facts |= {"step": self.sweep.first, "splats_after": len(student), "ended_by": "no view shows enough of it", "seconds": 0.0}
            return {}, facts, None
        if not self.scene.target.sh_degree:
            student.parameters()["shN"].requires_grad_(False)
        task, keeper = self._task(), StateKeeper(resume, self._fingerprint())
        run = keeper.start_or_resume(student, task, self.config, 0.0)
        if run.step < self.sweep.first or not run.step:  # a run that begins: one that is resumed has made some of the sweep's steps
            self._continue(run)

        def after_step(run: Run) -> bool:
            if run.step in self.sweep.checks:
                self._write(run.student.parameters(), [run.step])
            keeper.save_if_due(run)
            return run.step >= self.sweep.end

        end = adapt(run, task, self.config, keeper.save_and_stop, after_step)
        ended_by = SWEEP if end is End.OBSERVER else end.told(self.config, run.step)
        self._write(run.student.parameters(), [step for step in self.sweep.checks if step > run.step])
        after = len(run.student.parameters()["means"])
        facts |= {"step": run.step, "splats_after": after, "ended_by": ended_by, "seconds": time.perf_counter() - began}
        return {"optimizer": run.optimizer.state_dict(), "step": run.step, "seconds": run.watch.seconds}, facts, keeper

    def _write(self, parameters: dict[str, Any], steps: Any) -> None:
        for step in steps:
            write_store(tile_file(self.scene.folder, self.number, self.sweep.number, step), parameters)

    def _continue(self, run: Run) -> None:
        """Let a run go on in the state that it was steered to, with Adam's moments if that state ended a sweep."""
        run.step, run.steering = self.sweep.first, Steering(0.0, math.inf, Snapshot({}, {}), ceiling=self.before.ceiling)  # no best state is kept
        run.curve[0] = run.curve[0].model_copy(update={"step": run.step})
        if not self.sweep.number:
            return
        run.watch.seconds += load_torch(run_file(self.scene.folder, self.number, self.sweep.number - 1)).get("seconds", 0.0)
        saved = load_torch(run_file(self.scene.folder, self.number, self.before.sweep)) if self.before.sweep >= 0 else {}
        if saved.get("step") == self.before.step:
            run.optimizer.load_state_dict(saved["optimizer"])

    def _task(self) -> Task:
        """What the loop optimizes. The views are those of the new scale, so that there is nothing left to zoom."""
        around = self.surroundings
        views = [crop or nothing(view.zoomed(self.scene.scale)) for view, crop in zip(self.scene.views.adapted, self.crops, strict=True)]
        white = self.scene.target.background == (1.0, 1.0, 1.0)
        validation = no_validation(around.wanted, around.render)
        start, growth = start_file(self.scene.folder, self.number), self.config.most_growth
        most = sys.maxsize if growth is None else int(growth * len(Store(start)))
        return Task(
            views, 1.0, around.wanted, [around.render], white, validation, max_splats=most, render_views=around.render_views,
            render_to_step=around.to_step, color_limits=color_limits([self.scene.target]), part=f"tile {self.number + 1} x{self.scene.scale:g}",
        )  # fmt: skip

    def _fingerprint(self) -> str:
        """A hash of everything that the run depends on."""
        poses = [[*crop.size, crop.fx, crop.cx, crop.cy, *crop.viewmat.flatten().tolist()] for crop in self.crops if crop is not None]
        start = [hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest() for tensor in self.student.parameters().values()]
        facts = [self.scene.digest, self.sweep.number, self.before.ceiling, start, self.config.model_dump(), poses]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()
