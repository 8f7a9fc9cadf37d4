"""The report of an adaptation: what it did, gained and cost. It is saved beside the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict

from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.start.bands import used_degree
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effect, Effects, enlarges, explain
from mipmap_plugin.models.base import SPLATS, SplatModel, effects_of
from mipmap_plugin.scenes.orbits import Orbit

# The name of the base among a run's states.
AS_IT_IS = "the base as it is"

# The name of a start with which nothing was done to the base.
UNCHANGED = "the start, the base"


class Report(BaseModel):
    """Everything needed to assess an adapted model, or to make it again.

    Attributes:
        scale: What it was adapted to, over the scale of the training.
        base: sha256 of the base checkpoint; of its parameters, where it was made in memory.
        settings: Those of the run, as the recipe and its overrides give them.
        backend: Which one, and why.
        views: Which views were adapted to, in a sentence.
        viewer: What the file is made for; None: what renders as the base's training did.
        filters: Of the pseudo truth, the base and the adapted file.
        effects: What adapting and rendering simulate, what they do not, and why.
        gaussians_before: Splats of the base; where a camera decides, those of one view at the new scale.
        gaussians_after: Splats of the file, likewise.
        seconds: By phase; "total": all of them but "loading".
        ended_by: What ended the run, such as a number of steps or a time budget.
        returned: Which of the run's states the file holds, and why if it is not the last.
        validation: dB of each state on views that nothing was adapted to, at most 54 of a view. They did not steer the run, unless there is only one.
        written: dB of the file itself on the same views, where its format rounds splats; None where it does not.
        viewers: Of a file for several viewers: dB in each on the same views; `validation` is the worst of the extreme viewers.
        as_trained: dB of the base itself on the same views, drawn as its training drew it; None at x1, and where the file is drawn so too.
        peak_memory_mib: Of tensors on the GPU while adapting; None without a GPU.
        curve: Quality against time; a point per check.
        versions: Of this package and of torch.
        notes: What became of the model on the way, such as columns of the base's file that the new splats do not have, in sentences.
        inputs: What was given beside the checkpoint: hashes of cameras and photographs, background, screen filter.
        cameras_from: Where its cameras were read from on this machine, for whoever looks at a lone file, which has none beside it.
        orbit: What views without cameras go around, the same for the file as for its base.
    """

    model_config = ConfigDict(frozen=True)

    scale: float
    base: str
    settings: AdaptConfig
    backend: str
    views: str
    viewer: str | None = None
    filters: str
    effects: list[Effect]
    gaussians_before: int
    gaussians_after: int
    seconds: dict[str, float]
    ended_by: str
    returned: str
    validation: dict[str, float]
    written: float | None = None
    viewers: dict[str, float] = {}
    as_trained: float | None = None
    peak_memory_mib: float | None = None
    curve: list[CurvePoint]
    versions: dict[str, str]
    notes: list[str] = []
    inputs: dict[str, str] = {}
    cameras_from: dict[str, str] = {}
    orbit: Orbit | None = None

    def __repr__(self) -> str:
        splats = f"{self.gaussians_before:,} -> {self.gaussians_after:,}"
        return f"<Report: scale x{self.scale:g}, splats {splats}, {self.gain()}, ended by {self.ended_by}>"

    __str__ = __repr__  # in place of all that it holds, which is `model_dump()`

    def psnr_before(self) -> float | None:
        """PSNR (dB) of the base on views that nothing was adapted to; None if it was not measured."""
        return self.validation.get(AS_IT_IS)

    def psnr_after(self) -> float | None:
        """PSNR (dB) of what the file holds, on the same views; before its format rounds it, where the file is not saved yet."""
        if self.written is not None:
            return self.written
        return next((psnr for state, psnr in self.validation.items() if self.returned.startswith(state)), None)

    def holds_base(self) -> bool:
        """Whether the file holds the base as it is, also where it is called a start with which nothing was done to it."""
        unchanged = UNCHANGED in self.validation and self.validation[UNCHANGED] == self.psnr_before()
        return self.returned.startswith((AS_IT_IS, UNCHANGED) if unchanged else AS_IT_IS)

    def gain(self) -> str:
        """The PSNR before and after in a sentence, as far as it was measured."""
        before, after = self.psnr_before(), self.psnr_after()
        if before is None or after is None:
            return f"holds {self.returned}"
        if self.holds_base():
            return f"holds {AS_IT_IS}, for nothing was better: {after:.2f} dB on views that nothing was adapted to"
        return f"{before:.2f} -> {after:.2f} dB on views that nothing was adapted to"

    def provenance(self) -> dict[str, Any]:
        """Return what the file's header records: viewer, base, scale, inputs, settings, versions. Nothing in it depends on the clock."""
        made_from = self.model_dump(include={"scale", "viewer", "base", "inputs", "orbit"})
        return provenance(made_from, self.settings, self.versions)


def provenance(made_from: Mapping[str, Any], settings: AdaptConfig, versions: Mapping[str, str]) -> dict[str, Any]:
    """What a file's header records. `made_from`: its scale, viewer, base, inputs and orbit."""
    return {**made_from, "settings": settings.model_dump(), "versions": dict(versions)}


class PeakMemory:
    """The peak memory of this process's tensors on a GPU since this object was made, in MiB; None on another device.

    Torch has one such counter for the whole process, and this resets it: peaks that other code reads also start here.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def mib(self) -> float | None:
        return torch.cuda.max_memory_allocated(self._device) / 2**20 if self._device.type == "cuda" else None


def filters(scale: float, config: AdaptConfig, base: Effects, files: Sequence[Effects]) -> str:
    """Describe the filters of the pseudo truth (how base images are resized), and those that base and files are rendered with."""
    if not config.steps:
        truth = "none, since no step is taken"
    elif scale <= 1:
        truth = config.resize
    else:
        truth = config.upsampler if enlarges(config, scale) else f"the base itself, images shrunk by {config.resize}"
        truth += f", and {config.upsampler} fused with it" if config.compare_at == "both" else ""
    base_filter, *file_filters = (f"{effects.screen_filter} {effects.eps2d:g} px²" for effects in (base, *files))
    return f"pseudo truth {truth}; base {base_filter}; file {', '.join(dict.fromkeys(file_filters))}"


def simulated(base: SplatModel, view: Camera, targets: Iterable[Effects], config: AdaptConfig, scale: float) -> list[Effect]:
    """Every effect of adapting a base and of rendering its file; it is on where it is on in any of the `targets`."""
    gaussians, own = base.gaussians(view), effects_of(base)
    per_target = [explain(target, gaussians, own, config, scale) for target in targets]
    return [next((effect for effect in same if effect.on), same[0]) for same in zip(*per_target, strict=True)]


def changes(base: SplatModel, adapted: SplatModel, scale: float) -> list[str]:
    """What became of rows that are no splats, of what all rows share, and how to show it, in sentences without a full stop."""
    found, before = [], base.shared_parameters()
    if (rows := base.traits.rows) != SPLATS:
        left, all_of_them = (len(model.parameters()["means"]) for model in (adapted, base))
        found.append(f"{left:,} of {all_of_them:,} {rows} are left; the splats counted are those of one view")
    degree, before_it = (used_degree(model) for model in (adapted, base))
    if degree > before_it:
        found.append(f"colors depend on the view up to SH degree {degree}, those of the base up to {before_it}: merging had made room for it")
    moved = {name.partition(".")[0] for name, tensor in adapted.shared_parameters().items() if not torch.equal(tensor, before[name])}
    if moved:
        found.append(f"what the {rows} share has changed too: {', '.join(sorted(moved))}")
    return [*found, *filter(None, [option_note(base, scale)])]


def option_note(base: SplatModel, scale: float) -> str:
    """How to tell the base's own project that its levels of detail are to be those of the new scale, in a sentence; "" if it need not be told."""
    option = base.traits.shrink_option
    if scale == 1 or not option:
        return ""
    told = f"{option}=[{1 / scale:g}] in its cfg_args, in place of an option for the size of pictures"
    return f"its own project chooses levels of detail for x{scale:g} only with {told}; otherwise it shows this file with those of the training"
