"""Splats that stay on the disk: in one PLY or in several, one after the other. Only their places and sizes are in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.formats.ply_rows import PlyRows
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.vanilla import VanillaModel

# Rows that are read at a time.
CHUNK = 1 << 17

# Standard deviations, and pixels, by which a splat may reach into a picture from outside. It ends at 3.3 deviations, and oblique ones are longer.
REACH, MARGIN = 5.0, 4.0


@dataclass(eq=False)
class Splats:
    """N splats in files."""

    kind: type[VanillaModel]  # what reads their columns
    parts: Sequence[PlyRows]
    places: Tensor  # [N, 4]: the mean of each, and its largest scale, in world units
    opacities: Tensor | None = None  # [N], 0..1, in place of those in the files

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def starts(self) -> list[int]:
        """The first row of each part, and the number of all rows."""
        counts = torch.tensor([0, *(len(part) for part in self.parts)])
        return [int(start) for start in counts.cumsum(0)]

    @classmethod
    def of(cls, kind: type[VanillaModel], parts: Sequence[PlyRows]) -> Splats:
        """The splats of these files, all of which are read once."""
        places = torch.empty(sum(map(len, parts)), 4)
        splats = cls(kind, parts, places)
        for start in range(0, len(places), CHUNK):
            rows = torch.arange(start, min(start + CHUNK, len(places)))
            parameters = splats.parameters(rows)
            places[rows] = torch.cat([parameters["means"], parameters["scales"].amax(dim=1, keepdim=True).exp()], dim=1)
        splats.release()
        return splats

    def parameters(self, rows: Tensor) -> dict[str, Tensor]:
        """The raw parameters of rows [M], in their order."""
        order = rows.argsort()
        sorted_rows = rows[order]
        pieces = []
        for part, first, end in zip(self.parts, self.starts, self.starts[1:], strict=False):
            low, high = torch.searchsorted(sorted_rows, torch.tensor([first, end])).tolist()
            if high > low:
                pieces.append(self.kind.parameters_of(part.columns((sorted_rows[low:high] - first).numpy()), part.path))
        if not pieces:
            pieces = [self.kind.parameters_of(self.parts[0].columns(slice(0, 0)), self.parts[0].path)]
        back = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order)))
        return {name: torch.cat([piece[name] for piece in pieces])[back] for name in pieces[0]}

    @torch.no_grad()
    def gaussians(self, rows: Tensor) -> Gaussians:
        """The activated splats of rows [M], in their order."""
        splats = self.kind(self.parameters(rows)).gaussians()
        if self.opacities is not None:
            splats = Gaussians(splats.means, splats.quats, splats.scales, self.opacities[rows], splats.sh)
        return splats

    def release(self) -> None:
        """Give the memory of what was read back to the system."""
        for part in self.parts:
            part.release()

    def seen_by(self, camera: Camera, near: float, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The rows (of `rows`; None: of all) that may reach into a view, and the depth of each, by rising depth."""
        places = self.places if rows is None else self.places[rows]
        x, y, z = camera.to_camera(places[:, :3]).unbind(1)
        reach = REACH * places[:, 3] * max(camera.fx, camera.fy) / z + MARGIN
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > near) & (u > -reach) & (u < camera.width + reach) & (v > -reach) & (v < camera.height + reach)
        found = inside.nonzero()[:, 0]
        found = found[z[found].argsort(stable=True)]
        return found if rows is None else rows[found], z[found]
