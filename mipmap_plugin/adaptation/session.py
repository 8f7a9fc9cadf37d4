"""One call of adapt: its pieces, the order they run in, and what comes out."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.optimization.growing import verdict
from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.resume import Keeper
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.state_file import StateFile
from mipmap_plugin.adaptation.optimization.validation import HARM, WINDOW, Validation, hold_back
from mipmap_plugin.adaptation.report import Peak, Report, filters, versions
from mipmap_plugin.adaptation.start.candidates import Problem, Start, warm
from mipmap_plugin.adaptation.target.detail import Detail
from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.adaptation.target.portable import extremes, middle
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.views import choose_views, with_times
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effect, Effects, explain
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel, effects_of
from mipmap_plugin.progress import announced

# (step, seconds of adapting so far, what renders a camera of the new scale as the model is then) -> None. The clock stands meanwhile.
Observer = Callable[[int, float, Callable[[Camera], Tensor]], None]

AS_IT_IS = "the base as it is"

# What a zoom-in is validated against: the base's own image, whatever it is adapted to.
AS_THE_BASE = {"compare_at": "base", "quantize_truth": False}


@dataclass(frozen=True)
class Base:
    """What is adapted: a model, how it was rendered in training, and what renders it."""

    model: SplatModel
    effects: Effects
    targets: Mapping[str, Effects]  # how the adapted file is rendered, by the viewers that it is for; the first of them is the one that it says
    viewer: str | None  # what it is made for; None: no viewer in particular
    backend: Backend
    why: str  # this backend was taken
    differentiates: bool  # whether it has gradients for what is asked
    given: SplatModel  # what the viewer shows of the base's own file: the base, where it reads all of it


class Session:
    """One call of adapt: the pieces, made once, and the order they run in."""

    def __init__(self, base: Base, scale: float, config: AdaptConfig, cameras: list[Camera], real: Photographs | None) -> None:
        self.base, self.backend, self.why, self.trained, self.targets = base.model, base.backend, base.why, base.effects, base.targets
        self.differentiates, self.effects = base.differentiates, next(iter(self.targets.values()))
        self.extremes, self.aim = extremes(self.targets), middle(self.targets)
        self.scale, self.config, self.viewer, self._given = scale, config, base.viewer, base.given
        self.seconds, self.peak = {"optimization": 0.0}, Peak(self.base.parameters()["means"].device)
        views, self.which = choose_views(cameras, self.base.parameters()["means"], config)
        self.views, validation = hold_back(cameras, views, self.base.parameters()["means"], scale, config)
        self.which += f", {len(views) - len(self.views)} of them kept for validation" if len(self.views) < len(views) else ""
        if self.base.traits.moves:
            self.views, when = with_times(self.views, config.seed)
            validation, _ = with_times(validation, config.seed)
            self.which += f", {when}"
        self.which += f", {len(real.cameras)} of them real images" if real else ""
        self.truth = PseudoTruth(self.base, self.backend, self.trained, scale, config, real)
        self.detail = Detail(self.truth, scale, config) if scale > 1 and config.compare_at == "both" and config.steps else None
        if self.detail is not None:
            self.views = evenly(self.views, config.upsampled_views)
            self.which += f", {len(self.views)} of them upsampled"
        self.state: StateFile | None = None
        asked = PseudoTruth(self.base, self.backend, self.trained, scale, config.model_copy(update=AS_THE_BASE if scale > 1 else {}))
        first, *others = [_shows(self.backend, target) for target in self.extremes.values()]
        self.validation = Validation(validation[::2], validation[1::2], scale, asked, first, config.resize, others)

    def run(self, resume: Path | None, observe: Observer | None) -> Adapted:
        if self.scale == 1 and all(target == self.trained for target in self.targets.values()):
            why = "scale 1, at which the base is right as it is"
            return Adapted(self.fresh(), self._report(self.fresh(), [], why, AS_IT_IS, {}), self.backend, self.effects, self.targets)
        began = time.perf_counter()
        with self.phase("compilation"):
            warm(self.backend, self.base.gaussians(self.views[0]), (self.trained, *self.targets.values()), gradients=self.config.steps > 0)
        as_it_is = self._to_be_shown(self._given)
        weighs = self.differentiates and self.base.traits.same_for_all_views
        problem = Problem(self.fresh, self.views, self.scale, self.trained, self.aim, self.config, self.backend, weighs, self.steer, self.phase)
        student, start = Start(problem).best()
        initial = student.copy()
        states = {AS_IT_IS: as_it_is, f"the start, {start}": initial}
        curve: list[CurvePoint] = []
        ended_by = "0 steps"
        self.seconds["total"] = time.perf_counter() - began
        if self.config.steps:
            run, ended_by = self._optimize(student, resume, observe)
            curve, states = run.curve, states | self._reached(run, initial)
        return self._returned(states, curve, ended_by)

    def _reached(self, run: Run, initial: SplatModel) -> dict[str, SplatModel]:
        """The best state of a run and its last, where these are others than the start, the `initial` model, and than each other."""
        step, states = run.steering.best_step, {}
        if 0 < step < run.step:
            states[f"the state after step {step}"] = run.steering.best.over(initial)
        if not run.curve[-1].taken_back:  # else it is the best
            states["the last state"] = run.student
        return states

    def _returned(self, states: dict[str, SplatModel], curve: list[CurvePoint], ended_by: str) -> Adapted:
        """The best of the states on views that have not steered the run, or the last where that is asked for."""
        began, last = time.perf_counter(), next(reversed(states))
        with self.phase("validation"):
            best, found = self.validation.choose(states)
        self.seconds["total"] += time.perf_counter() - began
        if self.config.returns == "last":
            best = last
        elif self.detail is not None and found[last] >= max(found[name] for name in list(states)[:2]) - HARM:
            best = last  # what the base's own image cannot tell is what a network is asked for
        why = "" if best == last else f", for {last} shows {found[last]:.2f} dB where it shows {found[best]:.2f}"
        curve = curve or [CurvePoint(step=0, seconds=self.seconds["total"], psnr_db=None, validation_db=found[last], gaussians=_rows(states[last]))]
        if not self.validation.choosing:
            why, found = f", not judged: at this scale one pixel of the base is more than {WINDOW} px", {}
        report = self._report(states[best], curve, ended_by, f"{best}{why}", found)
        seen = [*self.views, *self.validation.steering, *self.validation.choosing]
        return Adapted(states[best], report, self.backend, self.effects, self.targets, self.state, seen)

    def _optimize(self, student: SplatModel, resume: Path | None, observe: Observer | None) -> tuple[Run, str]:
        """Algorithm 1 on `student`, or the rest of it where `resume` exists, and what ended it."""
        most = sys.maxsize if self.config.most_growth is None else int(self.config.most_growth * _rows(student))
        first, *others = [_shows(self.backend, _smooth(target)) for target in self.extremes.values()]
        task = Task(self.views, self.scale, self.truth, first, self._white, self.validation, self.detail, most, others)
        keeper = Keeper(resume, self._fingerprint())
        if not any(target.sh_degree for target in self.extremes.values()) and (unused := student.parameters().get("shN")) is not None:
            unused.requires_grad_(False)  # no color follows the direction: its coefficients stay out of the gradient
        if self.detail is not None:
            with self.phase("upsampling"):
                self.detail.prepare(self.views)
            self.seconds["total"] += self.seconds["upsampling"]
        run = keeper.begin(student, task, self.config, self.seconds["total"])
        before = run.watch.seconds if run.step == 0 else self.seconds["total"]

        def look(run: Run) -> None:
            keeper.now_and_then(run)
            if observe is not None:
                observe(run.step, run.watch.seconds, lambda camera: first(run.student.gaussians(camera), camera))

        ended_by = adapt(run, task, self.config, keeper.stop, look)
        self.state = keeper.left()
        self.seconds["optimization"] = run.watch.seconds - before
        self.seconds["total"] = run.watch.seconds
        return run, ended_by + verdict(run)

    def fresh(self) -> SplatModel:
        """The base as it is, to be rendered as the target is."""
        return self._to_be_shown(self.base)

    def _to_be_shown(self, model: SplatModel) -> SplatModel:
        """A copy, to be rendered as the target is."""
        model = model.copy()
        model.trained = replace(model.trained, screen_filter=self.effects.screen_filter, eps2d=self.effects.eps2d)
        return model

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        with announced(f"{name} x{self.scale:g}"):
            yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def steer(self, model: SplatModel) -> float:
        """dB of a model on the views that steer the run."""
        with self.phase("validation"):
            return self.validation.steer(model)

    @property
    def _white(self) -> bool:
        return self.effects.background == (1.0, 1.0, 1.0)

    def _fingerprint(self) -> str:
        """Names what a run depends on, so that a state is never resumed as another run."""
        poses = [[view.width, view.height, view.fx, view.fy, view.time, *view.viewmat.flatten().tolist()] for view in self.views]
        base = self.base.digest or _digest(self.base)
        targets = [asdict(target) for target in self.targets.values()]
        facts = [base, self.scale, self.config.model_dump(), self.backend.name, asdict(self.trained), targets, poses]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    def _in_each(self, model: SplatModel) -> dict[str, float]:
        """dB in each viewer, where the file is for several."""
        if len(self.targets) == 1:
            return {}
        first, *others = [_shows(self.backend, target) for target in self.targets.values()]
        found = replace(self.validation, render=first, others=others).in_each(model, self.validation.choosing)
        return dict(zip(self.targets, found, strict=True))

    def _explained(self) -> list[Effect]:
        """Every effect, on where it is so in any viewer that the file is for."""
        before, of_model = self.base.gaussians(self.views[0]), effects_of(self.base)
        found = [explain(target, before, of_model, self.config, self.scale) for target in self.targets.values()]
        return [next((effect for effect in same if effect.on), same[0]) for same in zip(*found, strict=True)]

    def _report(self, student: SplatModel, curve: list[CurvePoint], ended_by: str, returned: str, validation: dict[str, float]) -> Report:
        return Report(
            scale=self.scale,
            base=self.base.digest or _digest(self.base),
            settings=self.config,
            backend=self.why,
            views=self.which,
            viewer=self.viewer,
            filters=filters(self.scale, self.config, self.trained, list(self.targets.values())),
            effects=self._explained(),
            gaussians_before=len(self.base.gaussians(self.views[0])),
            gaussians_after=len(student.gaussians(self.views[0])),
            seconds=self.seconds,
            ended_by=ended_by,
            returned=returned,
            validation=validation,
            viewers=self._in_each(student) if validation else {},
            peak_memory_mib=self.peak.mib(),
            curve=curve,
            versions=versions(),
        )


def _shows(backend: Backend, effects: Effects) -> Callable[[Gaussians, Camera], Tensor]:
    """What a camera sees. It knows of no session, which would else outlive its run, and hold on to the state's file."""
    return lambda gaussians, camera: backend.render(gaussians, camera, effects).image


def _smooth(effects: Effects) -> Effects:
    """What a step sees: without the rounding of a viewer's file and picture, which is noise to it and a third of its time."""
    return replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))


def _rows(model: SplatModel) -> int:
    return len(model.parameters()["means"])


def _digest(model: SplatModel) -> str:
    """The sha256 of a model that was made in memory."""
    digest = hashlib.sha256()
    for tensor in {**model.parameters(), **model.shared_parameters()}.values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()
