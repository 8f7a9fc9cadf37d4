"""One call of `adapt`: it makes the parts, runs them in order, and returns the result."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch
from mipmap_plugin.adaptation.drawn import Drawn
from mipmap_plugin.adaptation.optimization.amount import affordable_for_model, affordable_moments, fewer_note, looks_in_budget, takes_steps
from mipmap_plugin.adaptation.optimization.budget import for_upsampling, no_steps_notes, plan_note, within_budget
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.following import Following, release
from mipmap_plugin.adaptation.optimization.growing import growth_note
from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import StateKeeper
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.state_file import StateFile
from mipmap_plugin.adaptation.optimization.validation import COMPARED_WITH_BASE, HARM_DB, Quality, Validation, psnr_as_trained, psnr_per_viewer
from mipmap_plugin.adaptation.renderers import Renderer, SteppingRenderer, color_limits, views_renderer
from mipmap_plugin.adaptation.report import AS_IT_IS, PeakMemory, Report, changes, filters, option_note, simulated
from mipmap_plugin.adaptation.request import AdaptationRequest, Observer, ends_run
from mipmap_plugin.adaptation.start.bands import used_degree, with_more_bands
from mipmap_plugin.adaptation.start.compilation import calls_of, warm_up
from mipmap_plugin.adaptation.start.matching import UNMATCHED
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.search import best_start
from mipmap_plugin.adaptation.start.splitting import in_parts
from mipmap_plugin.adaptation.target.detail import DetailLoss, unused_upsampler
from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import fitting
from mipmap_plugin.adaptation.views.for_validation import WINDOW
from mipmap_plugin.adaptation.views.moments import at_their_moments, evaluate_moments
from mipmap_plugin.adaptation.views.of_run import views_of_run
from mipmap_plugin.adaptation.views.policy import over_band
from mipmap_plugin.adaptation.views.refusals import refuse_blind
from mipmap_plugin.adaptation.views.remarks import hints, remarks, too_far_out
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.adaptation.worse import better_as_trained, worse_viewers, worse_views
from mipmap_plugin.backends.base import Calls
from mipmap_plugin.camera import ONE_PIXEL, Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models.base import SplatModel, count_of, digest_of_model, means_at
from mipmap_plugin.models.health import doubts_in
from mipmap_plugin.process import pool, threads
from mipmap_plugin.process.clock import now
from mipmap_plugin.process.versions import versions
from mipmap_plugin.progress import announced


class Session:
    """One call of `adapt`: makes the parts, and runs them in order."""

    notes: Sequence[str] = ()  # on what the views show of the base
    ended: End | None = None  # why the steps ended
    state: StateFile | None = None  # of the run, as long as its model is not saved

    def __init__(self, request: AdaptationRequest, scale: float, config: AdaptConfig, cameras: list[Camera], photographs: Photographs | None) -> None:
        self.request, self.scale, self.finer = request, scale, request.finer
        self.base, self.backend = request.images.model, request.images.backend
        self.drawn = Drawn(request.images.effects, request.targets).with_bands(used_degree(self.finer.model) if self.finer else 0)
        self.asked, self.config = config, affordable_for_model(config, self.base, cameras, self.drawn.effects.near_plane)
        self._most_splats, self.device = config.most_splats or sys.maxsize, self.base.parameters()["means"].device
        self.viewpoints = replace(request.viewpoints, looks=looks_in_budget(self.config, self.base))
        self.seconds, self.peak = {"optimization": 0.0, "total": 0.0}, PeakMemory(self.device)
        self._has_photographs, self._orbits = photographs is not None, not cameras or config.views == "orbit"
        self.base_views, validation, self.views_note = self._choose_views(cameras)
        self.config = config = fitting(self.config, self.drawn.base, self.base_views, scale)
        self.seconds["total"] = sum(self.seconds.values())
        self._closest_of = cameras if scale > 1 and cameras else self.base_views  # a zoom-in is as fine as what the base was seen from
        self.views = over_band(self.base_views, config)
        self.views_note += f", {photographs.note(self.base_views)}" if photographs else ""
        steering, choosing = (over_band(half, config) for half in (validation[::2], validation[1::2] or validation))
        request.images.keep_only([*self.views, *steering, *choosing])
        self.truth = PseudoTruth(request.images, scale, config, photographs)
        self.detail = DetailLoss(self.truth, scale, config) if scale > 1 and config.compare_at == "both" and config.steps else None
        if self.detail is not None:
            self.views = evenly(self.views, min(config.upsampled_views, config.steps * config.views_per_step))
        truth = PseudoTruth(request.images, scale, config.model_copy(update=COMPARED_WITH_BASE if scale > 1 else {}))
        self.validation = Validation(steering, choosing, scale, truth, self.drawn.renders(self.backend), config.resize)

    def _choose_views(self, cameras: list[Camera]) -> tuple[list[Camera], list[Camera], str]:
        """The views to adapt to, the views for validation, and a description of the former."""
        means, near = partial(means_at, self.base), self.drawn.base.near_plane
        with self._looking():
            views, validation, note = views_of_run(cameras, self.viewpoints, means, near, self.scale, self.config)
        if self.base.traits.moves:
            moments = None if self._has_photographs else affordable_moments(self.config, self.base)  # a photograph shows no moment but its own
            views, validation, times = at_their_moments(views, validation, moments, self.config.seed)
            note += f", {times}"
        return views, validation, note

    def _looking(self) -> AbstractContextManager[None]:
        """A phase for choosing views where that looks at the base, after what draws it is compiled."""
        if not (self._orbits and self.viewpoints.orbit.nearest):
            return nullcontext()
        with self.phase("compilation"):
            warm_up(self.backend, self.base.gaussians(ONE_PIXEL), [self.drawn.base], Calls(gradients=False, merging=False))
        return self.phase("views")

    def run(self, resume: Path | None, observe: Observer | None) -> Adapted:
        """Adapt the base, or continue the run that `resume` holds, and return the best state."""
        near, final, views = self.drawn.base.near_plane, self.request.zoom_in or self.scale, self.base_views
        refuse_blind(views, self.base, near, self.truth, final)
        if self._base_is_right:
            copy, reason = self.drawn.copied(self.base), "scale 1, at which the base is right as it is"
            return Adapted(copy, self._report(copy, [], reason, AS_IT_IS, {}), self.backend, self.drawn.effects, self.drawn.targets)
        found = [*hints(views, self.base, near), too_far_out(self.base, views, self.drawn.targets), unused_upsampler(self.config, final)]
        for remark in filter(None, [*remarks(views, self.base, near, orbit=self._orbits), *found, option_note(self.base, final)]):
            warn(remark)
        began = now(self.device) - self.seconds["total"]
        self._compile(self.base)
        evaluate_moments(self.base, [*self.views, *self.validation.steering], self.phase)
        initial, start, notes = best_start(self._start_problems())
        self.notes = [note for note in notes if note == UNMATCHED or not (self.finer and self.finer.converts)]
        states = {AS_IT_IS: self.drawn.copied(self.request.base_in_viewer, shared=True), f"the start, {start}": initial}
        initial = self._with_more_bands(initial)
        curve, ended_by = list[CurvePoint](), "0 steps" + fewer_note(self.asked.steps, self.config.model_copy(update={"steps": 0}))
        pool.release_to_system()
        self.seconds["total"] = now(self.device) - began
        if self._takes_steps:
            run, ended_by = self._optimize(initial.copy(), resume, observe)
            curve, states = run.curve, states | run.states(initial)
        return self._select(states, curve, ended_by)

    def _compile(self, model: SplatModel) -> None:
        """Let the backend compile what the run will call for splats such as the model's, in a phase of its own."""
        merging, effects = self.config.merge_to < 1 and self.request.has_blend_weights, (self.drawn.base, *self.drawn.targets.values())
        with self.phase("compilation"):
            calls = calls_of(self.views, self.scale, self.config, gradients=self._takes_steps, merging=merging, plain=self.base.traits.plain)
            warm_up(self.backend, model.gaussians(self.views[0]), effects, calls)

    def _start_problems(self) -> list[StartProblem]:
        from_base = StartProblem(
            lambda: self.drawn.copied(self.base, shared=True), self.base_views, self._closest_of, self.scale, self.drawn.base,
            self.drawn.median, self.config, self.backend, self.request.has_blend_weights, self.quality, self.phase,
            may_lose=self.config.merging_costs if len(self.drawn.targets) > 1 and self.config.steps else 0.0,
        )  # fmt: skip
        if (finer := self.finer) is None:
            return [in_parts(from_base)]
        from_level = from_base.from_level(finer, lambda: self.drawn.copied(finer.model, shared=True))
        if not finer.converts:
            return [from_level]
        return [from_level, in_parts(from_base)] if finer.learned else [in_parts(from_base), from_level]

    def _with_more_bands(self, start: SplatModel) -> SplatModel:
        """The start with the SH bands that steps can give it and that it has room for, which are drawn from now on."""
        learns = self._takes_steps and self.config.most_splats is None
        most = min(self.config.most_sh_degree, self.drawn.most_degree(self.backend, start)) if learns else 0
        start, degree = with_more_bands(start, self.base, self.request.images.effects.sh_degree, most, self.request.viewer)
        self._draw_bands(start, degree)
        return start

    def _draw_bands(self, model: SplatModel, degree: int) -> bool:
        """Draw SH bands up to a degree, those of the model, from now on; return whether these are more than until now."""
        if (drawn := self.drawn.with_bands(degree)) == self.drawn:
            return False
        self.drawn, self.validation = drawn, replace(self.validation, renders=drawn.renders(self.backend))
        self._compile(model)
        return True

    def _select(self, states: dict[str, SplatModel], curve: list[CurvePoint], ended_by: str) -> Adapted:
        """Return the best of the states on views that did not steer the run, or the last where the settings say so."""
        allowed = [name for name, model in states.items() if len(model.parameters()["means"]) <= self._most_splats]
        began, (base, start, *_), last, view = now(self.device), states, allowed[-1], self.views[0]
        with self.phase("validation"):
            best, psnrs, by_view, by_viewer = self.validation.choose(states, allowed)
        self.seconds["total"] += now(self.device) - began
        if self.config.returns == "last":
            best = last
        elif self.detail is not None and psnrs[last] >= max(psnrs[name] for name in allowed if name in (base, start)) - HARM_DB:
            best = last  # a network adds detail that the base's own image does not have, so that its gain cannot be measured
        elif self.detail is None and self.request.zoom_in is None:
            means = means_at(self.base, view)
            worse = worse_views(self.validation.choosing, by_view[base], by_view[best], self.scale, means, orbit=self._orbits)
            self.notes = [*self.notes, *worse, *worse_viewers(self.drawn.extremes, by_viewer[base], by_viewer[best])]
        note = "" if best == last else f": {psnrs[best]:.2f} dB on validation views, {last} {psnrs[last]:.2f} dB"
        at_end = CurvePoint(step=0, seconds=self.seconds["total"], validation_db=psnrs[last], gaussians=count_of(states[last], view, self.scale))
        if not self.validation.choosing:
            note, psnrs = f", not validated: at this scale one pixel of the base is more than {WINDOW} px wide", {}
        report = self._report(states[best], curve or [at_end], ended_by, f"{best}{note}", psnrs)
        used, files = [*self.views, *self.validation.steering, *self.validation.choosing], [self.state] if self.state else []
        model = states[best].copy() if getattr(states[best], "shares", False) else states[best]
        return Adapted(model, report, self.backend, self.drawn.effects, self.drawn.targets, files, used, judge=self.validation.kept())

    def _task(self, student: SplatModel) -> Task:
        """What is optimized from `student` on: up to how many splats, and by which of the ways to draw them that the backend has."""
        growth, targets = self.config.most_growth, self.drawn.to_step
        renders, white = [Renderer(self.backend, target) for target in targets], self.drawn.effects.background == (1.0, 1.0, 1.0)
        return Task(
            self.views, self.scale, self.truth, renders, white, self.validation, self.detail,
            max_splats=self._most_splats if growth is None else min(self._most_splats, int(growth * len(student.parameters()["means"]))),
            render_views=views_renderer(self.backend, targets), color_limits=color_limits(self.drawn.extremes.values()),
            render_to_step=SteppingRenderer.of(self.backend, targets), follow=Following(self.base, self.views, self.scale),
        )  # fmt: skip

    def _optimize(self, student: SplatModel, resume: Path | None, observe: Observer | None) -> tuple[Run, str]:
        """Run Algorithm 1 on `student`, or continue it from the state in `resume`; return the run and what ended it."""
        keeper = StateKeeper(resume, self.request.fingerprint(self.scale, self.config, self.views))
        if not any(target.sh_degree for target in self.drawn.extremes.values()) and (unused := student.parameters().get("shN")) is not None:
            unused.requires_grad_(False)  # no viewer evaluates view-dependent color, so that these coefficients need no gradient
        if self.detail is not None and (seconds := for_upsampling(self.config, self.seconds["total"], resume)) > 0:
            with self.phase("upsampling"), threads.lent_to_torch():
                self.views = self.detail.prepare(self.views, seconds)
            self.views_note += f", {len(self.views)} of them upsampled"
            self.seconds["total"] += self.seconds["upsampling"]
        task = self._task(student)
        run = keeper.start_or_resume(student, task, self.config, self.seconds["total"])
        if run.step and self._draw_bands(run.student, used_degree(run.student)):  # of a start that was merged further than this one
            task = replace(self._task(run.student), max_splats=task.max_splats)
        renderer = Renderer(self.backend, self.drawn.to_step[0])

        def after_step(run: Run) -> bool:
            keeper.save_if_due(run)
            try:
                return observe is not None and ends_run(observe(run.step, run.watch.seconds, renderer.of_model(run.student)))
            except KeyboardInterrupt:  # as between two steps
                keeper.save_and_stop(run)

        if run.ended_by is None:
            task, config = within_budget(run, task, self.config)
            run.ended_by = adapt(run, task, config, keeper.save_and_stop, after_step)
            release(run.student)
        if self.request.zoom_in is not None:
            keeper.save(run)
        run.optimizer.state.clear()
        pool.release_to_system()
        self.state = keeper.remaining_file()
        self.seconds["pseudo truth"], checks = run.costs.sums()
        self.seconds["validation"] = self.seconds.get("validation", 0.0) + checks
        self.seconds["optimization"] = run.watch.seconds - self.seconds["total"] - run.costs.seconds()
        self.seconds["total"] = run.watch.seconds
        share, self.ended = self.request.budget_share, run.ended_by
        self.notes = [*self.notes, *(no_steps_notes(run, self.config, share) if self.request.zoom_in is None else [])]
        told = run.ended_by.told(self.config, run.step, share)
        return run, told + (plan_note(run, self.config) or fewer_note(self.asked.steps, self.config)) + growth_note(run)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the seconds spent inside under a phase of that name, those of a GPU too."""
        watch = Stopwatch(self.device, self.seconds.get(name, 0.0))
        with announced(f"{name} x{self.scale:g}"), watch:
            yield
        self.seconds[name] = watch.seconds

    def quality(self, model: SplatModel) -> Quality:
        """That of a model on the views that steer the run."""
        with self.phase("validation"):
            return self.validation.quality(model)

    @property
    def _base_is_right(self) -> bool:
        """Whether the base is the answer as it is: at its own scale, where it is drawn as in its training, and no splats are too many."""
        few = len(self.base.parameters()["means"]) <= self._most_splats
        return self.scale == 1 and self.config.band == (1, 1) and few and all(target == self.drawn.base for target in self.drawn.targets.values())

    @property
    def _takes_steps(self) -> bool:
        return self._has_photographs or takes_steps(self.config, self.scale, self.drawn.base, self.drawn.targets.values())

    def _report(self, student: SplatModel, curve: list[CurvePoint], ended_by: str, returned: str, validation: dict[str, float]) -> Report:
        known = [*self.base.notes, *(self.finer.model.notes if self.finer else ())]
        notes = [*self.notes, *(note for note in student.notes if note not in known)]
        as_trained = psnr_as_trained(self.validation, self.backend, self.drawn.targets, self.base, self.drawn.base)
        shown = next((psnr for state, psnr in validation.items() if returned.startswith(state)), 0.0)
        notes += better_as_trained(as_trained, shown, self.drawn.base) if self.config.band == (1, 1) else []  # a level is for viewers alone
        for note in notes:
            warn(note)
        return Report(
            scale=self.scale,
            base=digest_of_model(self.base),
            settings=self.config.model_copy(update={"validation_views": self.asked.validation_views}),  # which a time budget bounds
            backend=self.request.backend_note,
            views=self.views_note,
            viewer=self.request.viewer,
            filters=filters(self.scale, self.config, self.drawn.base, list(self.drawn.targets.values())),
            effects=simulated(self.base, self.views[0], self.drawn.targets.values(), self.config, self.scale),
            gaussians_before=count_of(self.base, self.views[0], self.scale),
            gaussians_after=count_of(student, self.views[0], self.scale),
            seconds=self.seconds,
            ended_by=ended_by,
            returned=returned,
            validation=validation,
            viewers=psnr_per_viewer(self.validation, self.backend, self.drawn.targets, student) if validation else {},
            as_trained=as_trained,
            peak_memory_mib=self.peak.mib(),
            curve=curve,
            versions=versions(),
            inputs=dict(self.request.inputs),
            orbit=self.viewpoints.orbit,
            notes=[*doubts_in(self.base.notes), *notes, *changes(self.base, student, self.scale)],
        )
