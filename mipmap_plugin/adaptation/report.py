"""What an adaptation did, gained and cost: the record that travels with the file."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict

from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effect, Effects, enlarges


class Report(BaseModel):
    """Everything needed to judge an adapted model, or to make it again."""

    model_config = ConfigDict(frozen=True)

    scale: float
    base: str  # sha256 of the base checkpoint; of its numbers, where it was made in memory
    settings: AdaptConfig
    backend: str  # which, and why
    views: str  # which, in a sentence
    viewer: str | None = None  # what the file is for; None: what draws as 3DGS does, or the base's own project where it keeps its filter
    filters: str  # of the pseudo truth, the base and the adapted file
    effects: list[Effect]  # what adapting and rendering simulate, what they do not, and why
    gaussians_before: int
    gaussians_after: int
    seconds: dict[str, float]  # by phase; "optimization" includes pseudo truth and steering, "total" everything
    ended_by: str
    returned: str  # which of the run's states the file holds, and why where it is not the last
    validation: dict[str, float]  # dB of each state on views that nothing was adapted to and that did not steer the run
    viewers: dict[str, float] = {}  # of a file for several: dB in each on the same views; `validation` is of the worst of those that go farthest
    peak_memory_mib: float | None = None  # of tensors on the GPU while adapting; None without one
    curve: list[CurvePoint]
    versions: dict[str, str]

    def provenance(self) -> dict[str, Any]:
        """What fits into a file's header: base, scale, settings, versions. Nothing in it depends on the clock."""
        return {"scale": self.scale, "viewer": self.viewer, "base": self.base, "settings": self.settings.model_dump(), "versions": self.versions}


class Peak:
    """The most memory that the process's tensors took on a GPU since this was made, MiB; None on another device.

    Torch counts once for all: whoever else asks it for a peak is told one that begins here too.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def mib(self) -> float | None:
        return torch.cuda.max_memory_allocated(self._device) / 2**20 if self._device.type == "cuda" else None


def filters(scale: float, config: AdaptConfig, base: Effects, files: Sequence[Effects]) -> str:
    """Which filters lie between the base's image and what is compared with it, and which ones base and file are drawn with."""
    if not config.steps:
        truth = "none, for no step is taken"
    elif scale <= 1:
        truth = config.resize
    else:
        truth = config.upsampler if enlarges(config, scale) else f"the base itself, images shrunk by {config.resize}"
        truth += f", and {config.upsampler} fused with it" if config.compare_at == "both" else ""
    of_base, *of_files = (f"{effects.screen_filter} {effects.eps2d:g} px²" for effects in (base, *files))
    return f"pseudo truth {truth}; base {of_base}; file {', '.join(dict.fromkeys(of_files))}"


def versions() -> dict[str, str]:
    try:
        own = version("mipmap-plugin")
    except PackageNotFoundError:  # run from a source tree that was not installed
        own = "source"
    return {"mipmap_plugin": own, "torch": torch.__version__}
