"""wrap_model(model).adapt(scale): test-time adaptation as a wrapper. What is wrapped never changes."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.closed_form import closed_form
from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.detail import Detail, evenly
from mipmap_plugin.adaptation.loop import Run, Task, adapt
from mipmap_plugin.adaptation.photographs import Photographs
from mipmap_plugin.adaptation.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.report import Report, filters, versions
from mipmap_plugin.adaptation.resume import Interrupted as Interrupted  # what `adapt` raises
from mipmap_plugin.adaptation.resume import Keeper
from mipmap_plugin.adaptation.views import choose_views, with_times
from mipmap_plugin.backends import choose_backend, supersample
from mipmap_plugin.backends.base import Backend, Needs, Rendered
from mipmap_plugin.backends.filters import INTEGRALS, USUAL_EPS2D
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig, Recipe
from mipmap_plugin.config import recipe as make_config
from mipmap_plugin.effects import DILATION, Effects, explain
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.files import write_json
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import SplatModel, TrainedScale, effects_of
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.models.live import adopt
from mipmap_plugin.scenes import Scene, model_cameras

# (step, seconds of adapting so far, what renders a camera of the new scale as the model is then) -> None. The clock stands meanwhile.
Observer = Callable[[int, float, Callable[[Camera], Tensor]], None]


@dataclass(frozen=True, eq=False)
class Adapted:
    """A model that looks right at its scale, and the report of how it came to."""

    model: SplatModel
    report: Report
    backend: Backend
    effects: Effects
    state: Path | None = None  # of the run, which is of use until the model is saved

    def render(self, camera: Camera) -> Rendered:
        """The view of a camera of the new scale."""
        return _shown(self.model, self.backend, camera, self.effects)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the checkpoint, and the report beside it as `<file>.adaptation.json`; return the checkpoint's path. Raises OutputExists."""
        saved = self.model.save(path, provenance=self.report.provenance(), overwrite=overwrite)
        write_json(saved.with_name(saved.name + ".adaptation.json"), self.report.model_dump(), overwrite=True)
        if self.state is not None:
            self.state.unlink(missing_ok=True)
        return saved


class Wrapped:
    """A frozen base model with its cameras, ready to be adapted to any scale."""

    def __init__(self, model: SplatModel, cameras: Sequence[Camera], backend: str, trained: TrainedScale) -> None:
        self.model, self.cameras, self._backend, self.trained = model, list(cameras), backend, trained
        self.background = trained.background or (0.0, 0.0, 0.0)

    def effects(self, scale: float = 1.0, screen_filter: str | None = None, supersampling: int = 1) -> Effects:
        """How this model is rendered at `scale`.

        `screen_filter`: None for what it was trained with, a filter's name, or "scaled" for the training-free filter
        whose dilation keeps its size in the world. The filters that integrate over the pixel see splats so dilated too: a
        classic model was trained to look right with it.
        """
        trained = self.trained
        degree = self._needs.sh_degree
        if screen_filter in (None, "scaled"):
            eps2d = trained.eps2d * (scale**2 if screen_filter == "scaled" else 1)
            return Effects(degree, trained.screen_filter, eps2d, self.background, supersampling, trained.near_plane)
        eps2d = USUAL_EPS2D.get(screen_filter, DILATION)
        if screen_filter in INTEGRALS and trained.screen_filter == "classic":
            eps2d = trained.eps2d * scale**2
        return Effects(degree, screen_filter, eps2d, self.background, supersampling, trained.near_plane)

    def backend(self, *, gradients: bool = False, screen_filter: str | None = None) -> tuple[Backend, str]:
        """The backend that serves this model, and why it was taken."""
        needs = replace(self._needs, gradients=gradients, screen_filter=self.effects(screen_filter=screen_filter).screen_filter)
        return choose_backend(self._backend, needs)

    def render(self, camera: Camera, scale: float = 1.0, screen_filter: str | None = None, supersampling: int = 1) -> Rendered:
        """The base model's view of `camera`, which is taken to sample `scale` times as finely as training did."""
        backend, _ = self.backend(screen_filter=screen_filter)
        return _shown(self.model, backend, camera, self.effects(scale, screen_filter, supersampling))

    def adapt(
        self,
        scale: float,
        *,
        recipe: Recipe = "default",
        cameras: Sequence[Camera] | None = None,
        resume: str | Path | None = None,
        observe: Observer | None = None,
        images: Scene | None = None,
        **settings: Any,
    ) -> Adapted:
        """A new model for `scale` (target focal length in px over base focal length in px); the base stays as it is.

        `cameras`: views of the base scale, instead of the checkpoint's own. `settings` override the recipe's, by the names
        of AdaptConfig: steps, time_budget_s, target_db, seed, views, ... `resume`: a file to go on from if it exists; Ctrl-C writes it
        and raises Interrupted, a long run writes it every minute, and saving the model removes it. `observe` sees the model before
        the first step and after each.
        `images`: a scene whose training images are the truth of a zoom-in, instead of what the base shows of them.
        Raises SettingsError and BackendUnavailable.
        """
        if not 0 < scale < float("inf"):
            raise SettingsError(f"scale {scale} is no zoom; give a number above 0, such as 0.25 or 4")
        config = make_config(recipe, scale, **settings)
        real = None if images is None else Photographs(self.place(images), next(iter(self.cameras), None), self.background)
        if cameras is None:
            cameras = real.cameras if real else self.cameras
        adaptation = _Adaptation(self, scale, config, list(cameras), real)
        return adaptation.run(None if resume is None else Path(resume), observe)

    def views(self) -> list[Camera]:
        """The checkpoint's cameras, or a generated orbit where it came without any."""
        return self.cameras or choose_views([], self.model.parameters()["means"], AdaptConfig())[0]

    def place(self, scene: Scene) -> Scene:
        """The scene as the model was trained on it (`placed`); its cameras become those of a checkpoint that came without any."""
        here = placed(self.model, scene)
        if here is not scene and not self.cameras:
            self.cameras = list(here.cameras)
        return here

    @cached_property
    def _needs(self) -> Needs:
        """What the base asks of a backend; asked once, for the base never changes."""
        with torch.no_grad():
            gaussians = self.model.gaussians(self.any_camera())
        return Needs.of(gaussians, Effects(gaussians.used_sh_degree(), self.trained.screen_filter), gradients=False)

    def any_camera(self) -> Camera:
        return self.cameras[0] if self.cameras else Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(4))


def wrap_model(
    model: SplatModel | str | Path | Any,
    *,
    cameras: Sequence[Camera] | Scene | None = None,
    backend: str = "auto",
    background: tuple[float, float, float] | None = None,
    screen_filter: str | None = None,
) -> Wrapped:
    """Wrap a loaded model, the checkpoint at a path, or another project's live model, which is copied (`models.live.adopt`).

    `cameras`: views of the scale it was trained at, or the scene that it was trained on; by default those beside the
    checkpoint. `background`: linear RGB; by default what the checkpoint says, else black. `screen_filter`: what it was trained
    with, where its files do not say ("classic", "antialiased", "mip", "analytic"). Raises CheckpointError, SceneError, and
    SettingsError for an unknown filter or an object that is no model.
    """
    model = load_model(model) if isinstance(model, (str, Path)) else adopt(model)
    trained = replace(model.trained, background=background or model.trained.background)
    if screen_filter is not None:
        if screen_filter not in USUAL_EPS2D:
            raise SettingsError(f"there is no screen filter {screen_filter!r}; known are {', '.join(USUAL_EPS2D)}")
        trained = replace(trained, screen_filter=screen_filter, eps2d=USUAL_EPS2D[screen_filter])
    if isinstance(cameras, Scene):
        cameras = placed(model, cameras).cameras
    return Wrapped(model, own_cameras(model) if cameras is None else cameras, backend, trained)


def placed(model: SplatModel, scene: Scene) -> Scene:
    """The scene as the model was trained on it: gsplat and splatfacto have a frame and a size of their own. Raises SceneError."""
    if getattr(model, "host", None) is None:
        return scene
    scene = scene.original()
    return scene.with_cameras(model.as_trained(scene.cameras, scene.points))  # type: ignore[attr-defined]


def own_cameras(model: SplatModel) -> list[Camera]:
    """The cameras beside the model's file, at the size that it was trained at; empty where there are none."""
    return model_cameras(model.folder, read_options(model.folder)[0])


class _Adaptation:
    """One call of adapt: the pieces, made once, and the order they run in."""

    def __init__(self, wrapped: Wrapped, scale: float, config: AdaptConfig, cameras: list[Camera], real: Photographs | None) -> None:
        self.base, self.scale, self.config = wrapped.model, scale, config
        self.backend, self.why = wrapped.backend(gradients=config.steps > 0)
        self.trained = wrapped.effects()
        self.effects = self.trained if wrapped.trained.keeps_filter else replace(self.trained, screen_filter="classic", eps2d=DILATION)
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

    def run(self, resume: Path | None, observe: Observer | None) -> Adapted:
        began = time.perf_counter()
        student = self.base.copy()
        student.trained = replace(student.trained, screen_filter=self.effects.screen_filter, eps2d=self.effects.eps2d)
        nothing_to_do = self.scale == 1 and self.effects == self.trained
        if self.config.closed_form and not nothing_to_do:
            self._start_closed_form(student)
        self.seconds["total"] = time.perf_counter() - began
        curve: list[CurvePoint] = []
        ended_by = "scale 1, at which the base is right as it is" if nothing_to_do else "0 steps"
        if self.config.steps and not nothing_to_do:
            curve, ended_by = self._optimize(student, resume, observe)
        else:
            resume = None  # whatever run it is of
        return Adapted(student, self._report(student, curve, ended_by), self.backend, self.effects, resume)

    def _optimize(self, student: SplatModel, resume: Path | None, observe: Observer | None) -> tuple[list[CurvePoint], str]:
        """Algorithm 1 on `student`, or the rest of it where `resume` exists; the curve and what ended it."""
        task = Task(self.views, self.scale, self.truth, self._render, self._white, self.detail)
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
                observe(run.step, before + run.watch.seconds, lambda camera: self._render(run.student, camera))

        ended_by = adapt(run, task, self.config, keeper.stop, look)
        self.seconds["optimization"] = run.watch.seconds
        self.seconds["total"] += run.watch.seconds
        return run.curve, ended_by

    @torch.no_grad()
    def _start_closed_form(self, student: SplatModel) -> None:
        began = time.perf_counter()
        student.reshape(lambda gaussians: closed_form(gaussians, self.views, self.scale, self.trained, self.effects), self.views)
        self.seconds["closed form"] = time.perf_counter() - began

    def _render(self, model: SplatModel, camera: Camera) -> Tensor:
        return self.backend.render(model.gaussians(camera), camera, self.effects).image

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
            curve=curve,
            versions=versions(),
        )


@torch.no_grad()
def _shown(model: SplatModel, backend: Backend, camera: Camera, effects: Effects) -> Rendered:
    gaussians = model.gaussians(camera)
    rendered = supersample.render(backend, gaussians, camera, effects)
    return replace(rendered, effects=explain(effects, gaussians, effects_of(model)))


def _digest(model: SplatModel) -> str:
    """The sha256 of a model that was made in memory."""
    digest = hashlib.sha256()
    for tensor in {**model.parameters(), **model.shared_parameters()}.values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()
