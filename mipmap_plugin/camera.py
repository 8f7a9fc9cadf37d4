"""Camera: a pinhole view. Pixel centers lie at +0.5, axes are OpenCV's (x right, y down, z forward)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError, ShapeError
from mipmap_plugin.limits import check_scale

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Camera:
    """One view. Compared and hashed by identity, so that a cache keyed by a camera is exact."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px, continuous: the left edge of the image is 0
    cy: float  # px
    viewmat: Tensor  # [4, 4] float64 on the CPU, world to camera
    name: str = ""
    split: Literal["train", "test"] = "train"
    time: float | None = None  # 0..1, for moving scenes
    zoom: float = 1.0  # how much finer than in training this view is sampled, for models with levels of detail
    index: int | None = None  # the number of a training view, for models with an appearance for each

    def __post_init__(self) -> None:
        if tuple(self.viewmat.shape) != (4, 4):
            raise ShapeError(f"viewmat: expected shape [4, 4], got {list(self.viewmat.shape)}")
        is_lens = min(self.fx, self.fy) > 0 and all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy)))
        if min(self.width, self.height) < 1 or not is_lens:
            raise SettingsError(f"camera {self.name!r}: {self.width}x{self.height} px with focal lengths {self.fx}, {self.fy} is not a view")
        object.__setattr__(self, "viewmat", self.viewmat.detach().to("cpu", torch.float64))
        if not self.viewmat.isfinite().all():
            raise SettingsError(f"camera {self.name!r}: its pose holds NaN or infinity, so that it is nowhere")

    @property
    def center(self) -> Tensor:
        """[3] float64, the eye in world space."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -torch.linalg.solve(rotation, translation)

    def to_camera(self, points: Tensor) -> Tensor:
        """[N, 3] world units -> [N, 3] in camera space, x right, y down, z forward.

        Eye first: in a world far from its origin the rounding of rotation · point + translation is larger than a pixel.
        """
        return (points - self.center.to(points)) @ self.viewmat[:3, :3].to(points).T

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), as images are indexed."""
        return self.height, self.width

    def zoomed(self, factor: float) -> Camera:
        """The same view sampled `factor` times more densely per axis.

        Width and height are rounded as Pillow users do, and the focal lengths follow each axis' true factor, so
        that the field of view is exactly kept. Raises SettingsError for a factor that is no zoom.
        """
        check_scale(factor)
        resized = self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))
        return replace(resized, zoom=self.zoom * factor)

    def resized(self, width: int, height: int) -> Camera:
        """The same field of view at `width` x `height` px; what the model is asked for (`zoom`) stays."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def window(self, width: int, height: int) -> Camera:
        """The middle `width` x `height` px of the same view, or as much of it as there is."""
        width, height = min(width, self.width), min(height, self.height)
        left, top = (self.width - width) // 2, (self.height - height) // 2
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def moved(self, similarity: Tensor) -> Camera:
        """The same view after all of the world, this camera included, was moved by `similarity` [4, 4]: turned, sized and shifted."""
        turned_and_sized = similarity[:3, :3].to("cpu", torch.float64)
        rotation = turned_and_sized / torch.linalg.det(turned_and_sized).pow(1 / 3)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = self.viewmat[:3, :3] @ rotation.T
        viewmat[:3, 3] = -viewmat[:3, :3] @ (turned_and_sized @ self.center + similarity[:3, 3].to("cpu", torch.float64))
        return replace(self, viewmat=viewmat)

    def looking_from(self, viewmat: Tensor, name: str) -> Camera:
        """The same lens at another pose."""
        return replace(self, viewmat=viewmat, name=name)


def evenly(views: Sequence[Item], most: int | None) -> list[Item]:
    """At most `most` of the views, spread over their order; all of them for None."""
    return [views[place * len(views) // most] for place in range(most)] if most is not None and len(views) > most else list(views)


def every_nth(views: Sequence[Item], most: int) -> Sequence[Item]:
    """Every n-th of the views, the first among them, where n is the least that leaves at most `most`."""
    return views[:: -(-len(views) // most)]
