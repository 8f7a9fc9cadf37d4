"""What each measurement on a GPU gives, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from mipmap_plugin.backends.conformance import Outcome


@dataclass(frozen=True)
class Bandwidth:
    """Of a copy within the device's memory, read and written."""

    bytes_a_second: float


@dataclass(frozen=True)
class Speed:
    """One backend on one scene."""

    backend: str
    mode: str  # of the viewer whose filter is drawn
    splats: int
    width: int  # px
    height: int  # px
    forward_ms: float
    both_ms: float  # forward and backward
    peak_mib: float  # over what was held before
    forward_bytes: int  # the least that has to move
    both_bytes: int


@dataclass(frozen=True)
class Views:
    """Milliseconds per view: forward and backward, and of a whole step."""

    backend: str
    width: int  # px
    views: int
    alone_ms: float  # one after the other
    together_ms: float | None  # in one call; None: the backend has none
    step_ms: float  # in the quickest way that the backend has, and Adam's step


class Kernel(NamedTuple):
    """One kernel in one image and its gradients."""

    name: str
    us: float
    launches: float
    occupancy: float | None  # %, as the profiler estimates it from registers, shared memory and the grid
    registers: int | None  # per thread
    least_bytes: int | None  # that have to move; None: not known


@dataclass(frozen=True)
class Profile:
    """The kernels of one backend on one case that take most of the time, forward and backward."""

    backend: str
    splats: int
    width: int  # px
    height: int  # px
    all_us: float
    kernels: list[Kernel]


@dataclass(frozen=True)
class Checked:
    """What the hard cases have shown of one backend so far."""

    backend: str
    cases: int
    skipped: int
    failed: dict[str, str]  # case -> what is wrong
    unchecked: int = 0

    @classmethod
    def of(cls, backend: str, outcomes: Sequence[Outcome], unchecked: int = 0) -> Checked:
        failed = {outcome.case: outcome.message for outcome in outcomes if not outcome.passed}
        return cls(backend, len(outcomes), sum(outcome.skipped for outcome in outcomes), failed, unchecked)


@dataclass(frozen=True)
class Adaptation:
    """One base adapted to one scale by the default recipe."""

    base: str
    scale: float
    backend: str
    seconds: float  # as the report counts: without loading
    again_seconds: float  # of a second adaptation to the same scale
    wall_seconds: float  # of the first, all in all
    steps: int
    ended_by: str
    peak_mib: float | None  # of tensors on the GPU
    psnr_db: float  # on real test images that nothing was adapted to, or on held-out views of the base's own
    processor_db: float | None  # the same on a processor; None: not measured
    phases: dict[str, float] = field(default_factory=dict)
    viewer: str = ""  # "": as the base was trained


@dataclass(frozen=True)
class FirstUse:
    """Seconds of a command that adapts a base with few steps."""

    backend: str
    viewer: str
    first_s: float
    compilation_s: float  # of the first
    again_s: float
    again_compilation_s: float


@dataclass(frozen=True)
class Failure:
    """What was not measured, and why."""

    backend: str
    what: str
    reason: str
    late: bool = False  # no time was left

    @classmethod
    def of(cls, backend: str, what: str, error: Exception) -> Failure:
        return cls(backend, what, f"{type(error).__name__}: {error}".splitlines()[0])
