"""What is seen while models are evaluated: one image of each row, with its truth, for whoever wants to show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.camera import Camera


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
