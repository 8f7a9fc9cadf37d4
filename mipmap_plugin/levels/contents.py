"""The contents of a ladder: its levels, the zooms at which a viewer changes between them, and how good they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.request import Band, LadderRequest


@dataclass(frozen=True, eq=False)
class Level:
    """One level of a ladder."""

    adapted: Adapted
    band: Band

    @property
    def splats(self) -> int:
        return len(self.adapted.model.parameters()["means"])


@dataclass(frozen=True)
class LeftOut:
    """A level that was made, but is not in the ladder: its neighbors are shown at its zooms."""

    scale: float
    splats: int
    reason: str


@dataclass(frozen=True)
class Switch:
    """The zoom at which a viewer should change between two levels, and how little it shows."""

    zoom: float
    psnr_db: float  # of the finer level there, against the base
    step_db: float  # dB of the finer level there minus those of the coarser
    likeness_db: float  # PSNR between the images of both levels there


@dataclass(frozen=True)
class ZoomPoint:
    """The quality of the level that is shown at a zoom."""

    zoom: float
    level: int
    psnr_db: float
    base_db: float  # of the base itself, as the viewer draws it


@dataclass(frozen=True, eq=False)
class Contents:
    """Levels from the finest to the coarsest, and how good they are."""

    request: LadderRequest
    base: FrozenBase
    levels: list[Level]
    switches: list[Switch]  # between a level and the next: falling zooms
    curve: list[ZoomPoint]  # by falling zoom
    left_out: Sequence[LeftOut] = ()  # by falling scale
