"""One level by distance: its start, the views that show it, and its optimization among the other levels as a viewer mixes them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.optimization.amount import fewer_note
from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import StateKeeper
from mipmap_plugin.adaptation.optimization.run import Task
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, Validation
from mipmap_plugin.adaptation.report import Report, filters
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.compilation import warm_up
from mipmap_plugin.adaptation.target.image_store import ImageStore
from mipmap_plugin.adaptation.target.pseudo_truth import LIMIT
from mipmap_plugin.adaptation.views.for_validation import split_validation
from mipmap_plugin.adaptation.views.pixel_size import enough_views
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.backends.base import Calls
from mipmap_plugin.camera import Camera, digest_of, evenly
from mipmap_plugin.effects import colorless, explain
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.coarsening import coarsened, kept_splats
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.scene import DistanceScene
from mipmap_plugin.levels.distance.walks import WalkTruth
from mipmap_plugin.levels.request import MERGING_COSTS
from mipmap_plugin.models.base import SplatModel, digest_of_model, digest_of_parameters, effects_of
from mipmap_plugin.models.contract import rebuild
from mipmap_plugin.models.health import doubts_in
from mipmap_plugin.process.clock import now
from mipmap_plugin.process.versions import versions
from mipmap_plugin.progress import announced

# Samples of the truth per pixel along each side.
SAMPLES = 2

# What the state is called in which a level is the finer one, unchanged.
AS_FINER = "the finer level as it is"

# A view is used at least so many times in a run, or else it would not be worth its truth, which costs as much as several steps.
USES = 6


@dataclass(eq=False)
class LevelRun:
    """The making of one level below the first."""

    scene: DistanceScene
    number: int
    finer: Sequence[SplatModel]  # all levels before it
    seconds: dict[str, float] = field(default_factory=lambda: {"optimization": 0.0})

    def __post_init__(self) -> None:
        scene, self.config, viewpoints = self.scene, self.scene.config(self.number), self.scene.base.viewpoints
        self.size = scene.rule.middle(self.number)
        cameras = scene.views if scene.base.cameras else []
        chosen, note = choose_views(cameras, viewpoints, self.config)
        most = max(self.config.validation_views, self.config.steps * self.config.views_per_step // USES)
        views, held_out = split_validation(cameras, evenly(chosen, most), viewpoints, 1.0, self.config)
        begins: dict[Camera, Camera] = {}

        def walked(starts: Sequence[Camera]) -> list[Camera]:
            found = [scene.walked(view, self.number, number) for number, view in enumerate(starts)]
            begins.update(zip(found, starts, strict=True))
            return found

        self.views, steering, choosing = walked(views), walked(held_out[::2]), walked(held_out[1::2])
        self.views_note = f"{note}, each from as far back as this level is seen from"
        truth = WalkTruth((scene.splats, scene.backend, scene.base.effects()), scene.views, begins, SAMPLES)
        finest = [scene.splats_of(each) for each in self.finer]
        coming = [scene.unmade(finest[0], level) for level in range(self.number + 1, scene.rule.count)]
        self.finest, self.others = finest[-1], (finest, coming)
        self.unmerged = Mixture.of(scene.rule, scene.chunks, [*finest, finest[-1], *coming])
        self.shares = ImageStore(LIMIT, self.finest.means)
        self.truth = lambda view: truth(view) * self._share(view)
        self.validation = Validation(steering, choosing, 1.0, self.truth, [self._render], self.config.resize)
        self.whole = replace(self.validation, truth=truth, renders=[self._picture])
        self.fixed, self.mixture = 0, self.unmerged

    def _picture(self, splats: Gaussians, camera: Camera) -> Tensor:
        """A view in which the level is shown where the viewer shows it, and all other levels elsewhere."""
        drawn = self.mixture.with_student(self.number, splats, camera, self.fixed)
        return self.scene.backend.render(drawn, camera, self.scene.target).image

    def _render(self, splats: Gaussians, camera: Camera) -> Tensor:
        """The picture of a view, in which each pixel counts by the level's share of it."""
        return self._picture(splats, camera) * self._share(camera)

    @torch.no_grad()
    def _share(self, camera: Camera) -> Tensor:
        """[H, W, 3], 0..1: the part of each pixel that is this level's. Without it, the level would make up for what others lack elsewhere."""

        def make() -> Tensor:
            live = self.scene.pixel_of(self.finest.means) < self.size
            part = self.unmerged.part_of(self.number, live, camera)
            return self.scene.backend.render(part, camera, colorless(self.scene.target)).image.clamp(0, 1)

        return self.shares((camera.viewmat.numpy().tobytes(), camera.size, camera.fx, camera.cx, camera.cy), make)

    def run(self, resume: Path | None) -> Adapted:
        """Make the level, or go on with the run that `resume` holds."""
        began = now(self.finest.means.device)
        pixels = tuple(view.width * view.height for view in self.views)
        drawn_with = self.scene.target, self.scene.base.effects()
        warm_up(self.scene.backend, self.finest, drawn_with, Calls(self.config.steps > 0, True, pixels=pixels))
        with announced(f"level {self.number}: merging"):
            student, name = self._start()
        initial, curve, ended_by, kept = student.copy(), [], "0 steps", None
        states = {f"the start, {name}": initial}
        self.seconds["start"] = self.seconds["total"] = now(self.finest.means.device) - began
        if self.config.steps:
            # Steered by whole pictures, as states are chosen: by the level's share of them steps seem to gain that do harm beside it. The median
            # splat may be far away, where the level is not shown. Beside finer levels that are right there is much to lose, so it does not dare.
            part = f"level {self.number}"
            task = Task(self.views, 1.0, self.truth, [self._render], False, self.whole, part=part, pixel=self.size, dares=False)
            keeper = StateKeeper(resume, self._fingerprint())
            run = keeper.start_or_resume(student, task, self.config, self.seconds["total"])
            ended_by = adapt(run, task, self.config, keeper.save_and_stop, keeper.save_if_due).told(self.config, run.step)
            states |= run.states(initial)
            self.seconds["pseudo truth"], self.seconds["validation"] = run.costs.sums()
            self.seconds["optimization"] = run.watch.seconds - self.seconds["total"] - run.costs.seconds()
            curve, kept, self.seconds["total"] = run.curve, keeper.remaining_file(), run.watch.seconds
        with announced(f"level {self.number}: validation"):
            best, psnrs, *_ = self.whole.choose(states)  # by whole pictures, as whoever walks there sees them
            psnrs[AS_FINER] = self._as_finer(lambda finer: self.whole.viewer_psnrs(finer, self.whole.choosing)[0])
        report = self._report(states[best], curve, ended_by, best, psnrs)
        effects = {str(self.scene.request.viewer): self.scene.target}
        return Adapted(states[best], report, self.scene.backend, self.scene.target, effects, [kept] if kept else [], self.views, self.scene.views)

    def _start(self) -> tuple[SplatModel, str]:
        """The student, and what it is called: as few splats as a ladder by zoom would keep, or more where merging would cost too much."""
        scene, pixels = self.scene, self.scene.pixel_of(self.scene.splats.means)
        kept, moved = kept_splats(pixels, self.size, scene.rule.ratio), int((scene.pixel_of(self.finest.means) < self.size).sum())
        weights = blend_weights(self.finest, evenly(scene.views, enough_views(scene.splats.means, scene.views)), scene.backend, scene.target)
        formed_db, finer_db = self.validation.steer(self._coarser(None, moved)), self._as_finer(self.validation.steer)
        least = formed_db - MERGING_COSTS
        if not self.config.steps:  # which would regain it; half of what it gains on the finer level may go, as by zoom
            least = max(formed_db, finer_db) - min(MERGING_COSTS, max(self.config.merging_costs, (formed_db - finer_db) / 2))
        for root in (1, 2, 4):
            student = self._coarser(weights, math.ceil(moved * min(1.0, kept / max(1, moved)) ** (1 / root)))
            if self.validation.steer(student) >= least:
                return student, "merged splats of the finer level"
        if finer_db > formed_db and not self.config.steps:
            self.mixture, self.fixed = self.unmerged, 0
            return self._for_target(), AS_FINER
        return self._coarser(None, moved), "the finer level in closed form"

    def _as_finer(self, measure: Callable[[SplatModel], float]) -> float:
        """What `measure` says of the finer level where this one is shown, which it would replace."""
        own, self.mixture, self.fixed = (self.mixture, self.fixed), self.unmerged, 0
        measured = measure(self.finer[-1])
        self.mixture, self.fixed = own
        return measured

    def _for_target(self) -> SplatModel:
        """A copy of the finer level that is rendered with the target's screen filter."""
        student = self.finer[-1].copy()
        student.trained = student.trained.drawn_with(self.scene.target)
        return student

    def _coarser(self, weights: Tensor | None, kept: int) -> SplatModel:
        """The finer level, merged down to so many of the splats that change. Its mixture with the other levels is the run's from now on."""
        scene, number, student = self.scene, self.number, self._for_target()
        sizes = (scene.rule.middle(number - 1) if number > 1 else 0.0, self.size)

        def form(splats: Gaussians) -> Gaussians:
            made, self.fixed = coarsened(splats, scene.pixel_of, sizes, weights, kept, scene.target)
            return made

        with torch.no_grad():
            rebuild(student, form)
            made, coming = scene.splats_of(student), self.others[1]
            self.mixture = Mixture.of(scene.rule, scene.chunks, [*self.others[0], made, *coming])
        return student

    def _fingerprint(self) -> str:
        scene = self.scene
        base = digest_of_model(scene.base.model)
        facts = [base, self.number, self.config.model_dump(), scene.backend.name, asdict(scene.target), asdict(scene.rule)]
        return hashlib.sha256(json.dumps([*facts, *map(digest_of_parameters, self.finer), digest_of(self.views)]).encode()).hexdigest()

    def _report(self, student: SplatModel, curve: list[CurvePoint], ended_by: str, best: str, psnrs: dict[str, float]) -> Report:
        scene, effects = self.scene, self.scene.base.effects()
        return Report(
            scale=scene.scale(self.number),
            base=digest_of_model(scene.base.model),
            settings=self.config,
            backend=scene.note,
            views=self.views_note,
            viewer=scene.request.viewer,
            filters=filters(1.0, self.config, effects, [scene.target]),
            effects=explain(scene.target, scene.splats, effects_of(scene.base.model), self.config, 1.0),
            gaussians_before=len(scene.splats),
            gaussians_after=len(scene.splats_of(student)),
            seconds=self.seconds,
            ended_by=ended_by + fewer_note(scene.asked(self.number).steps, self.config),
            returned=best,
            validation=psnrs,
            curve=curve,
            versions=versions(),
            inputs=scene.base.asked,
            cameras_from=scene.base.cameras_from,
            orbit=scene.base.viewpoints.orbit,
            notes=[*doubts_in(scene.base.model.notes), *self._worse(best, psnrs)],
        )

    def _worse(self, best: str, psnrs: dict[str, float]) -> list[str]:
        """A note, which is also a warning, on a level with which pictures have less dB than with the finer one; none if they have not."""
        if psnrs[best] >= psnrs[AS_FINER] - HARM_DB:
            return []
        figures = f"pictures in which it is shown have {psnrs[best]:.1f} dB, and {psnrs[AS_FINER]:.1f} with the finer level in its place"
        warn(note := f"level_{self.number}: {figures}, which has more splats; more steps would better it")
        return [note]
