"""What is seen while models are evaluated: one image of each row, with its truth, for whoever wants to show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.photographs import packed, unpacked

# What is kept of a shot beside its images.
SHOT_FACTS = ("row", "scene", "scale", "psnr_db", "ssim", "lpips")


@dataclass(frozen=True, eq=False)
class Shot:
    """The first evaluated view of a row, and its quality."""

    row: str  # the row's name
    scene: str
    scale: float
    camera: Camera  # at the base scale
    image: Tensor  # [h, w, 3] at `scale`
    truth: Tensor  # [h, w, 3]
    psnr_db: float
    ssim: float | None
    lpips: float | None


class Watcher(Protocol):
    """Is told of every row while it is evaluated."""

    def shot(self, shot: Shot) -> None:
        """A row's first view was evaluated."""

    def adapted(self, row: str, adapted: Adapted) -> None:
        """The row of this name is about to be evaluated for `adapted`."""

    def restored(self, row: str, report: dict[str, Any]) -> None:
        """The row of this name was evaluated before an interruption, for an adaptation with this report."""


class Recorder:
    """A watcher that keeps what it is told about a row, for a cell (`cells`), and tells another watcher."""

    def __init__(self, other: Watcher | None) -> None:
        self._other = other
        self._shots: list[dict[str, Any]] = []
        self._reports: list[tuple[str, dict[str, Any]]] = []

    def shot(self, shot: Shot) -> None:
        if self._other:
            images = {"image": packed(shot.image.cpu()), "truth": packed(shot.truth.cpu())}
            self._shots.append({name: getattr(shot, name) for name in SHOT_FACTS} | images)
            self._other.shot(shot)

    def adapted(self, row: str, adapted: Adapted) -> None:
        self._reports.append((row, adapted.report.model_dump(mode="json")))
        if self._other:
            self._other.adapted(row, adapted)

    def restored(self, row: str, report: dict[str, Any]) -> None:
        if self._other:
            self._other.restored(row, report)

    def taken(self) -> dict[str, Any]:
        """What was kept; without images if nobody watches."""
        return {"shots": self._shots, "reports": self._reports}

    def replay(self, kept: dict[str, Any], camera: Camera) -> None:
        """Tell the other watcher what was kept of a row; `camera`: of the first view."""
        if self._other is None:
            return
        for row, report in kept["reports"]:
            self._other.restored(row, report)
        for shot in kept["shots"]:
            self._other.shot(Shot(camera=camera, **shot | {name: unpacked(shot[name]) for name in ("image", "truth")}))
