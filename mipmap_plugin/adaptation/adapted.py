"""The result of an adaptation: the model and its report, with methods to render and save it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.adaptation import notebook
from mipmap_plugin.adaptation.optimization.state_file import StateFile
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, Validation, psnr_per_viewer
from mipmap_plugin.adaptation.parallel import large_for_torch
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.backends import supersample
from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera, checked
from mipmap_plugin.effects import Effects, as_outputs, explain
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import refuse_output, staged, together, write_json
from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.limits import check_image, path_of
from mipmap_plugin.models import contract, load_model
from mipmap_plugin.models.base import SplatModel, digest_of_model, effects_of, tensors_of
from mipmap_plugin.models.exposure import exposed
from mipmap_plugin.models.loaders import for_loader_of, unread
from mipmap_plugin.models.outputs import cut_off, drawn_otherwise, parts_of, without_place
from mipmap_plugin.models.places import REPORT, page_of
from mipmap_plugin.plugin_errors import naming_any, unchanged
from mipmap_plugin.process import threads
from mipmap_plugin.process.torch_modes import in_usual_modes, usual_modes
from mipmap_plugin.progress import announced


@dataclass(frozen=True, eq=False, repr=False)
class Adapted:
    """A model that looks right at its scale, and the report of how it was made.

    Attributes:
        model: The adapted model.
        report: How it was made, and what it gained.
        backend: What renders it.
        effects: How it is rendered: by the filter that its file is for.
        viewers: How each viewer that the file is made for renders it.
        states: The state files of the run, and of a conversion before it, which are needed until the model is saved.
        adapted_to: The cameras of the base scale that the model was adapted to or selected on.
        cameras: The base's, at its scale.
        judge: The views that nothing was adapted to, with their truth, to measure a file whose format rounds splats; None where there are none.
        written: What the reports of such files say of those views, once they are saved: dB, and dB in each of several viewers.
    """

    model: SplatModel
    report: Report
    backend: Backend
    effects: Effects
    viewers: Mapping[str, Effects] = field(default_factory=dict)
    states: Sequence[StateFile] = ()
    adapted_to: Sequence[Camera] = ()
    cameras: Sequence[Camera] = ()
    judge: Validation | None = None
    written: dict[Path, dict[str, Any]] = field(default_factory=dict)

    @in_usual_modes
    def render(self, camera: Camera, *, outputs: Sequence[str] | None = (), exposure: bool = False, viewer: str | None = None) -> Rendered:
        """Render the view of a camera of the new scale, in one of the `viewers`; `outputs`, `exposure` and errors as in `Wrapped.render`."""
        [camera] = checked([camera])
        outputs = as_outputs(outputs)
        if viewer is not None and viewer not in tuple(self.viewers):
            available = ", ".join(filter(None, self.viewers)) or "no viewer by name"
            raise SettingsError(f"this model was not made for the viewer {viewer!r}, but for {available}")
        effects = self.effects if viewer is None else self.viewers[viewer]
        check_image(camera.width, camera.height, self.model.parameters()["means"].device)
        return render_model(self.model, self.backend, camera, replace(effects, outputs=outputs, exposure=exposure))

    def views(self) -> list[Camera]:
        """The base's cameras at the scale of this model, for `render`."""
        return [camera.zoomed(self.report.scale) for camera in self.cameras]

    def plot(self) -> Any:
        """dB over the seconds of adapting, as a matplotlib Figure. Raises SettingsError without matplotlib (extra `plot`)."""
        from mipmap_plugin.adaptation.plot import plot

        return plot(self.report)

    def __repr__(self) -> str:
        return notebook.line("Adapted", notebook.adapted_facts(self.model, self.report))

    def _repr_html_(self) -> str:
        facts = notebook.adapted_facts(self.model, self.report)
        return notebook.table("Adapted", facts, lambda camera: self.render(camera).image, self.views()[0])

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the checkpoint, and the report beside it as `<file>.adaptation.json`; return the checkpoint's path.

        Raises OutputExists, OutputError, and SettingsError for a format that the family does not write.
        """
        path = path_of(path)
        refuse_output(path, overwrite, parts_of(self.model.source, self.model.folder))  # whatever the family itself looks at
        family = {f"family {self.model.family!r}": self.model}
        with usual_modes(), together(path, self._spent(path)), naming_any(family):  # a new model never appears without its report
            model = for_loader_of(self.report.viewer, self.model, path)
            with announced(f"writing {path.name}"):
                saved = contract.save(model, path, self.report.provenance(), overwrite=overwrite)
            self._judge(saved)
            write_json(saved.with_name(saved.name + REPORT), self.report_of(saved).model_dump(), overwrite=overwrite)
        for state in self.states:
            state.release()
        for said in filter(None, (unread(self.report.viewer, self.model, saved), self._rounded(saved), self._drawn_otherwise(saved))):
            warn(said)
        return saved

    def _spent(self, path: Path) -> list[Path]:
        """What goes when this is written to `path`: the states of its run, and the page that shows what it replaces."""
        return [file for state in self.states for file in state.files] + page_of(path)

    def _judge(self, saved: Path) -> None:
        """Measure a file that is being written, as far as its format rounds splats. Raises CheckpointError if it cannot be read."""
        if self.judge is None or not is_written(saved):
            return
        with announced(f"measuring {saved.name}"):
            model = self._read(staged(saved))
            psnr = min(self.judge.viewer_psnrs(model, self.judge.choosing))
            self.written[saved] = {"written": psnr, "viewers": psnr_per_viewer(self.judge, self.backend, self.viewers, model)}

    def as_written(self, path: Path) -> Adapted:
        """This with the splats and the report of the file at `path`, whose format may round them."""
        return replace(self, model=self._read(staged(path)) if is_written(path) else self.model, report=self.report_of(path))

    def _read(self, file: Path) -> SplatModel:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what there is to say of its splats was said of the base's
            return load_model(file).to(self.model.parameters()["means"].device)

    def report_of(self, path: Path) -> Report:
        """The report of the file at `path`, which also says what its format rounds, what it has no place for, and who draws it otherwise."""
        left_out = without_place(path, getattr(self.model, "extras", ()), getattr(self.model, "sh_degree", 0))
        left_out = "; ".join(filter(None, (left_out, cut_off(path, self.model.parameters()))))
        lost = filter(None, (left_out, unread(self.report.viewer, self.model, path), self._rounded(path), self._drawn_otherwise(path)))
        moved = self.model.traits.placed and (path.suffix.lower() == ".ply" or is_written(path))  # which does not say where the cameras go
        cameras_from = {} if moved else self.report.cameras_from
        changes = {"notes": [*self.report.notes, *lost], "cameras_from": cameras_from, "written": None}
        return self.report.model_copy(update=changes | self.written.get(path, {}))

    def _rounded(self, path: Path) -> str:
        """What the rounding of its format costs the file at `path`, in a sentence; "" where that is hardly anything, or was not measured."""
        exact, written = self.report.psnr_after(), self.written.get(path, {}).get("written")
        if exact is None or written is None or written >= exact - HARM_DB:
            return ""
        base = self.report.psnr_before()
        worse = base is not None and written < base
        advice = f"the file is worse than its base ({base:.2f} dB); keep the base, or give a .ply" if worse else "a .ply keeps them"
        return f"{path.name}: its format rounds splats, which costs {exact - written:.2f} dB on views that nothing was adapted to; {advice}"

    def _drawn_otherwise(self, path: Path) -> str:
        return "" if self.report.viewer else drawn_otherwise(path, self.model.trained)


def as_start(start: Any, viewer: str | None, scale: float, base: SplatModel) -> FinerLevel | None:
    """What an adaptation of `base` to `scale` for `viewer` starts from: of an adapted model, its splats.

    Raises SettingsError for anything else, and for a model of another viewer, of another base, or of a scale that is not finer.
    """
    if start is None:
        return None
    if not isinstance(start, (Adapted, FinerLevel)):
        raise SettingsError(f"start must be a model that was adapted to a finer scale, got {type(start).__name__}")
    finer = start if isinstance(start, FinerLevel) else _level(start, viewer, base)
    if finer.scale <= scale:
        raise SettingsError(f"start: x{finer.scale:g} is not finer than x{scale:g}; leave it out")
    return finer


def _level(start: Adapted, viewer: str | None, base: SplatModel) -> FinerLevel:
    if start.report.viewer != viewer:
        made, wanted = (name or "what draws as the training did" for name in (start.report.viewer, viewer))
        raise SettingsError(f"start: it is made for {made}, and not for {wanted}; leave it out, or give the same viewer")
    if start.report.base != digest_of_model(base):
        raise SettingsError("start: it was adapted from another base; leave it out, or give a model that was adapted from this one")
    return FinerLevel(start.model, start.report.scale, f"the model adapted to x{start.report.scale:g}")


@torch.no_grad()
def render_model(
    model: SplatModel, backend: Backend, camera: Camera, effects: Effects, form: Callable[[Gaussians], Gaussians] | None = None, clamped: bool = False
) -> Rendered:
    """Render a model, its splats first changed by `form`, and report the effects that were simulated. Raises SettingsError.

    `clamped`: whether each of several samples of a pixel is clamped before their mean is taken.
    """
    matrix = model.traits.exposures.of(camera) if effects.exposure else None
    family = f"family {model.family!r}"
    with threads.limited_for(backend, None):
        with naming_any({family: model}), unchanged(family, tensors_of(model)), large_for_torch(model.parameters()["means"]):
            gaussians = contract.checked_splats(model, supersample.of_samples(camera, effects.supersampling))
        gaussians = gaussians if form is None else form(gaussians)
        rendered = supersample.render(backend, gaussians, camera, effects, clamped=clamped)
        if effects.outputs:
            from mipmap_plugin.backends import geometry  # an effect that is off is not imported

            rendered = geometry.with_outputs(rendered, backend, gaussians, camera, effects)
    if matrix is not None:
        rendered = rendered.replaced(image=exposed(rendered.image, matrix))
    return rendered.replaced(effects=tuple(explain(effects, gaussians, effects_of(model))))
