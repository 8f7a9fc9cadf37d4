"""Splats that stay on the disk: in one file or in several, one after the other. Only their places and sizes are in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles.store import SHAPE, Store, as_parameters

# Rows that are read at a time.
CHUNK = 1 << 16

# A splat may reach into a picture from outside by so many standard deviations and pixels: it ends at 3.3 deviations, and oblique ones are longer.
REACH, MARGIN = 5.0, 4.0


@dataclass(eq=False)
class Splats:
    """N splats in files."""

    kind: type[VanillaModel]  # what their raw parameters mean
    parts: Sequence[Store]
    places: Tensor  # [N, 4]: the mean of each, and its largest scale, in world units
    opacities: Tensor | None = None  # [N], 0..1, in place of those in the files

    def __len__(self) -> int:
        return len(self.places)

    @classmethod
    def of(cls, kind: type[VanillaModel], parts: Sequence[Store]) -> Splats:
        """The splats of these files, whose places are read once."""
        return cls(kind, parts, torch.cat([_places(shapes) for part in parts for shapes in part.mapped()[0].split(CHUNK)]))

    def parameters(self, rows: Tensor, *, colored: bool = True) -> dict[str, Tensor]:
        """The raw parameters of rows [M], in their order; without colors: of SH degree 0, and gray."""
        order = rows.argsort()
        sorted_rows, coefficients = rows[order], self.parts[0].coefficients if colored else 1
        shapes, sh = torch.empty(len(rows), SHAPE), (torch.empty if colored else torch.zeros)(len(rows), coefficients, 3)
        first = 0
        for part in self.parts:
            end = first + len(part)
            for start in range(first, end, CHUNK):  # so that little of a file is in memory at a time
                low, high = torch.searchsorted(sorted_rows, torch.tensor([start, min(start + CHUNK, end)])).tolist()
                part.read(sorted_rows[low:high] - first, shapes[low:high], sh[low:high] if colored else None)
            first = end
        if not torch.equal(rows, sorted_rows):
            shapes, sh = (torch.empty_like(part).index_copy_(0, order, part) for part in (shapes, sh))
        return as_parameters(shapes, sh)

    @torch.no_grad()
    def gaussians(self, rows: Tensor, *, colored: bool = True) -> Gaussians:
        """The activated splats of rows [M], in their order; without colors: of SH degree 0, and gray."""
        splats = self.kind(self.parameters(rows, colored=colored)).gaussians()
        if self.opacities is not None:
            splats = replace(splats, opacities=self.opacities[rows])
        return splats

    def seen_by(self, camera: Camera, near: float) -> tuple[Tensor, Tensor]:
        """The rows that may reach into a view, and the depth of each."""
        found = [_seen(part, camera, near) for part in self.places.split(CHUNK)]  # some at a time, which stay in the cache
        rows = torch.cat([each + number * CHUNK for number, (each, _) in enumerate(found)])
        return rows, torch.cat([depths for _, depths in found])


def _places(shapes: Tensor) -> Tensor:
    return torch.cat([shapes[:, :3], shapes[:, 3:6].amax(dim=1, keepdim=True).exp()], dim=1)


def _seen(places: Tensor, camera: Camera, near: float) -> tuple[Tensor, Tensor]:
    """The rows of places [M, 4] that may reach into a view, and the depth of each."""
    x, y, z = camera.to_camera(places[:, :3]).unbind(1)
    before = (z > near).nonzero()[:, 0]
    x, y, z = x[before], y[before], z[before]
    reach = REACH * places[before, 3] * max(camera.fx, camera.fy) / z + MARGIN
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = ((u > -reach) & (u < camera.width + reach) & (v > -reach) & (v < camera.height + reach)).nonzero()[:, 0]
    return before[inside], z[inside]
