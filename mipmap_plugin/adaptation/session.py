"""One call of adapt: its pieces, the order they run in, and what comes out."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.closed_form import closed_form, pixel_size
from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.detail import Detail
from mipmap_plugin.adaptation.growing import verdict
from mipmap_plugin.adaptation.light import light
from mipmap_plugin.adaptation.loop import Run, Task, adapt
from mipmap_plugin.adaptation.merging import merge
from mipmap_plugin.adaptation.photographs import Photographs
from mipmap_plugin.adaptation.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.report import Peak, Report, filters, versions
from mipmap_plugin.adaptation.resume import Keeper
from mipmap_plugin.adaptation.state_file import StateFile
from mipmap_plugin.adaptation.views import choose_views, evenly, with_times
from mipmap_plugin.backends import supersample
from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import DILATION, Effects, explain
from mipmap_plugin.files import together, write_json
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel, effects_of, exposures_of
from mipmap_plugin.models.exposure import exposed
from mipmap_plugin.models.outputs import REPORT

# (step, seconds of adapting so far, what renders a camera of the new scale as the model is then) -> None. The clock stands meanwhile.
Observer = Callable[[int, float, Callable[[Camera], Tensor]], None]

# Views that tell how much of the base's images each splat makes up.
LIT_VIEWS = 5


@dataclass(frozen=True, eq=False)
class Adapted:
    """A model that looks right at its scale, and the report of how it came to."""

    model: SplatModel
    report: Report
    backend: Backend
    effects: Effects
    state: StateFile | None = None  # of the run, which is of use until the model is saved

    def render(self, camera: Camera, *, outputs: Sequence[str] = (), exposure: bool = False) -> Rendered:
        """The view of a camera of the new scale; `outputs` and `exposure` as of `Wrapped.render`."""
        return shown(self.model, self.backend, camera, replace(self.effects, outputs=tuple(outputs), exposure=exposure))

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the checkpoint, and the report beside it as `<file>.adaptation.json`; return the checkpoint's path. Raises OutputExists."""
        with together(Path(path)):  # no new model without its report
            saved = self.model.save(path, provenance=self.report.provenance(), overwrite=overwrite)
            write_json(saved.with_name(saved.name + REPORT), self.report.model_dump(), overwrite=True)
        if self.state is not None:
            self.state.remove()
        return saved


@dataclass(frozen=True)
class Base:
    """What is adapted: a model, how it was rendered in training, and what renders it."""

    model: SplatModel
    effects: Effects
    keeps_filter: bool  # an adapted file keeps the filter of training
    backend: Backend
    why: str  # this backend was taken


class Session:
    """One call of adapt: the pieces, made once, and the order they run in."""

    def __init__(self, base: Base, scale: float, config: AdaptConfig, cameras: list[Camera], real: Photographs | None) -> None:
        self.base, self.backend, self.why, self.trained = base.model, base.backend, base.why, base.effects
        self.scale, self.config = scale, config
        self.effects = self.trained if base.keeps_filter else replace(self.trained, screen_filter="classic", eps2d=DILATION)
        self.views, self.which = choose_views(cameras, self.base.parameters()["means"], config)
        if getattr(self.base, "moves", False):
            self.views, when = with_times(self.views, config.seed)
            self.which += f", {when}"
        self.which += f", {len(real.cameras)} of them real images" if real else ""
        self.truth = PseudoTruth(self.base, self.backend, self.trained, scale, config, real)
        self.detail = Detail(self.truth, scale, config) if scale > 1 and config.compare_at == "both" and config.steps else None
        if self.detail is not None:
            self.views = evenly(self.views, config.upsampled_views)
            self.which += f", {len(self.views)} of them upsampled"
        self.seconds = {"optimization": 0.0}
        self.state: StateFile | None = None
        self.peak = Peak(self.base.parameters()["means"].device)

    def run(self, resume: Path | None, observe: Observer | None) -> Adapted:
        began = time.perf_counter()
        student = self.base.copy()
        student.trained = replace(student.trained, screen_filter=self.effects.screen_filter, eps2d=self.effects.eps2d)
        nothing_to_do = self.scale == 1 and self.effects == self.trained
        if self.config.merge_to < 1:
            self._merge(student)
        if self.config.closed_form and not nothing_to_do:
            self._closed_form(student)
        self.seconds["total"] = time.perf_counter() - began
        curve: list[CurvePoint] = []
        ended_by = "scale 1, at which the base is right as it is" if nothing_to_do else "0 steps"
        if self.config.steps and not nothing_to_do:
            curve, ended_by = self._optimize(student, resume, observe)
        return Adapted(student, self._report(student, curve, ended_by), self.backend, self.effects, self.state)

    def _optimize(self, student: SplatModel, resume: Path | None, observe: Observer | None) -> tuple[list[CurvePoint], str]:
        """Algorithm 1 on `student`, or the rest of it where `resume` exists; the curve and what ended it."""
        most = sys.maxsize if self.config.most_growth is None else int(self.config.most_growth * len(student.parameters()["means"]))
        task = Task(self.views, self.scale, self.truth, self._render, self._white, self.detail, most)
        keeper = Keeper(resume, self._fingerprint())
        run = keeper.begin(student, task, self.config)
        if self.effects.sh_degree == 0 and (unused := student.parameters().get("shN")) is not None:
            unused.requires_grad_(False)  # no color follows the direction: its coefficients stay out of the gradient
        if self.detail is not None:
            began = time.perf_counter()
            self.detail.prepare(self.views)
            self.seconds["upsampling"] = time.perf_counter() - began
            self.seconds["total"] += self.seconds["upsampling"]
        before = self.seconds["total"]

        def look(run: Run) -> None:
            keeper.now_and_then(run)
            if observe is not None:
                observe(run.step, before + run.watch.seconds, lambda camera: self._render(run.student.gaussians(camera), camera))

        ended_by = adapt(run, task, self.config, keeper.stop, look)
        self.state = keeper.left()
        self.seconds["optimization"] = run.watch.seconds
        self.seconds["total"] += run.watch.seconds
        return run.curve, ended_by + verdict(run)

    @torch.no_grad()
    def _merge(self, student: SplatModel) -> None:
        """Fewer splats; only a family that offers `rebuild` is asked for it (`Wrapped.adapt`)."""

        def fewer(gaussians: Gaussians) -> Gaussians:
            filled = light(gaussians, evenly(self.views, LIT_VIEWS), self.backend, self.trained) * self.scale**2
            return merge(gaussians, pixel_size(gaussians.means, self.views) / self.scale, filled, self.config.merge_to)

        began = time.perf_counter()
        student.rebuild(fewer)  # type: ignore[attr-defined]
        self.seconds["merging"] = time.perf_counter() - began

    @torch.no_grad()
    def _closed_form(self, student: SplatModel) -> None:
        began = time.perf_counter()
        student.reshape(lambda gaussians: closed_form(gaussians, self.views, self.scale, self.trained, self.effects), self.views)
        self.seconds["closed form"] = time.perf_counter() - began

    def _render(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        return self.backend.render(gaussians, camera, self.effects).image

    @property
    def _white(self) -> bool:
        return self.effects.background == (1.0, 1.0, 1.0)

    def _fingerprint(self) -> str:
        """Names what a run depends on, so that a state is never resumed as another run."""
        poses = [[view.width, view.height, view.fx, view.fy, view.time, *view.viewmat.flatten().tolist()] for view in self.views]
        base = self.base.digest or _digest(self.base)
        facts = [base, self.scale, self.config.model_dump(), self.backend.name, asdict(self.trained), poses]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    def _report(self, student: SplatModel, curve: list[CurvePoint], ended_by: str) -> Report:
        before = self.base.gaussians(self.views[0])
        return Report(
            scale=self.scale,
            base=self.base.digest or _digest(self.base),
            settings=self.config,
            backend=self.why,
            views=self.which,
            filters=filters(self.scale, self.config, self.trained, self.effects),
            effects=list(explain(self.effects, before, effects_of(self.base), self.config, self.scale)),
            gaussians_before=len(before),
            gaussians_after=len(student.gaussians(self.views[0])),
            seconds=self.seconds,
            ended_by=ended_by,
            peak_memory_mib=self.peak.mib(),
            curve=curve,
            versions=versions(),
        )


@torch.no_grad()
def shown(model: SplatModel, backend: Backend, camera: Camera, effects: Effects, form: Callable[[Gaussians], Gaussians] | None = None) -> Rendered:
    """What the model, its splats changed by `form`, shows to a camera, and the effects that it called for. Raises SettingsError."""
    matrix = exposures_of(model).of(camera) if effects.exposure else None
    gaussians = model.gaussians(camera) if form is None else form(model.gaussians(camera))
    rendered = supersample.render(backend, gaussians, camera, effects)
    if effects.outputs:
        from mipmap_plugin.backends import geometry  # an effect that is off is not imported

        rendered = geometry.beside(rendered, backend, gaussians, camera, effects)
    if matrix is not None:
        rendered = replace(rendered, image=exposed(rendered.image, matrix))
    return replace(rendered, effects=explain(effects, gaussians, effects_of(model)))


def _digest(model: SplatModel) -> str:
    """The sha256 of a model that was made in memory."""
    digest = hashlib.sha256()
    for tensor in {**model.parameters(), **model.shared_parameters()}.values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()
