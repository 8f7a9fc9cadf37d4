"""A job: one checkpoint, adapted to one scale for one viewer. It can be sent to any process, and done again without harm."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.formats.here import from_here, told_from_here
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.recipes import recipe

Status = Literal["done", "finished before", "failed", "interrupted"]


@dataclass(frozen=True)
class Job:
    """What to adapt and where to save it: paths and settings, no tensors."""

    base: Base
    target: Path  # where the adapted model is saved; the state of an interrupted run lies beside it
    scale: float
    viewer: str | None = None
    recipe: str = "default"
    settings: dict[str, Any] = field(default_factory=dict)  # that override those of the recipe: seed, steps, ...
    images: Path | None = None  # a scene whose photographs are the truth of a zoom-in
    overwrite: bool = False
    network: Path | None = None  # where the network's file lies that the settings name as `upsampler`
    skip_finished: bool = True  # do nothing if the target was made from the same base with the same settings

    needs_folder: ClassVar[str] = ""  # why the files of such a job cannot be sent, in a sentence

    def config(self) -> AdaptConfig:
        """The settings to adapt with, unless the model calls for others. Raises SettingsError."""
        return recipe(self.recipe, self.scale, **self.settings)

    def own_work(self, threads: int | None) -> Outcome | None:
        """What a kind of job does in place of adapting a checkpoint, such as a tile's; None for a job that adapts one."""
        return None

    def __str__(self) -> str:
        return f"{from_here(self.base.checkpoint)} x{self.scale:g}{f' in {self.viewer}' if self.viewer else ''}"


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    job: Job
    status: Status
    file: Path | None = None  # the adapted checkpoint
    report: dict[str, Any] = field(default_factory=dict)  # of the adaptation
    reason: str = ""  # why it failed or was interrupted, in a sentence
    trace: str = ""  # of a failure that is a bug
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        said = self.reason if self.reason.startswith(self.status) else ", ".join(filter(None, (self.status, self.reason)))
        return f"{self.job}: {told_from_here(said)}"
