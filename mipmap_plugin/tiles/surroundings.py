"""What a tile's core is drawn with: the halo, which is all other tiles as the run begins. It is frozen, neither merged nor moved.

A renderer blends splats by rising depth. So of the halo in a view, all that is nearer than every splat of the core is one picture in
front of it, and all that is farther is one picture behind it; both are drawn once. Only splats of depths between are drawn together with
the core in each step, and only within the core's box. The image is the one that drawing all splats would give, as long as the core keeps
its range of depths: for that the range is a little wider than the core's.

Memory: 22 bytes for each pixel of the boxes with its truth, 4 for each splat and view that is drawn with the core, and those splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.progress import counted
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.tiles.crops import Crop
from mipmap_plugin.tiles.slabs import BLACK, Painter
from mipmap_plugin.tiles.splats import Splats

# The range of depths is wider than the core's by this fraction of it at both ends.
SPARE = 0.02

# Blend weights of a pixel that are too small to be seen.
INVISIBLE = 1 / 255


@dataclass(frozen=True, eq=False)
class _Surrounding:
    """The halo in one view."""

    front: Tensor  # [h, w, 3] half, on black
    through: Tensor  # [h, w, 1] half, the transmittance of the front
    back: Tensor  # [h, w, 3] half, background included
    beside: Tensor  # [B] int32, rows of the halo's splats that are drawn with the core
    clear: Tensor  # [h, w, 1] half, the transmittance of the back


class Surroundings:
    """The halo of one core in its views; called with splats of the core and a crop's camera, it renders both together."""

    def __init__(self, splats: Splats, core: Tensor, crops: Sequence[Crop], painter: Painter) -> None:
        """`splats`: what all tiles begin with; `core` [M]: rows of one of them. Draws the halo of each crop."""
        self._painter = painter
        is_halo = torch.ones(len(splats), dtype=torch.bool)
        is_halo[core] = False
        self._views = {crop.camera.name: self._surrounding(splats, core, crop.camera, is_halo) for crop in counted(crops, len(crops), "halo", "view")}
        rows, beside = torch.cat([torch.empty(0, dtype=torch.int32), *(view.beside for view in self._views.values())]).unique(return_inverse=True)
        self._halo = splats.gaussians(rows.long())
        splats.release()
        places = beside.to(torch.int32).split([len(view.beside) for view in self._views.values()])
        self._views = {name: replace(view, beside=own) for (name, view), own in zip(self._views.items(), places, strict=True)}

    def _surrounding(self, splats: Splats, core: Tensor, camera: Camera, is_halo: Tensor) -> _Surrounding:
        near = self._painter.effects.near_plane
        _, depths = splats.seen_by(camera, near, core)
        spare = SPARE * float(depths[-1] - depths[0])
        rows, halo_depths = splats.seen_by(camera, near)
        halo = is_halo[rows]
        rows, halo_depths = rows[halo], halo_depths[halo]
        ends = torch.tensor([float(depths[0]) - spare, float(depths[-1]) + spare])
        first, last = torch.searchsorted(halo_depths, ends).tolist()
        front = self._painter.draw(splats, camera, rows[:first])
        back = self._painter.draw(splats, camera, rows[last:])
        splats.release()
        behind = back.over(torch.tensor(self._painter.effects.background))
        beside = rows[first:last].to(torch.int32)
        return _Surrounding(front.image.half(), front.transmittance.half(), behind.half(), beside, back.transmittance.half())

    @property
    def beside(self) -> float:
        """The mean number of splats that are drawn with the core."""
        return sum(len(view.beside) for view in self._views.values()) / len(self._views)

    def render(self, core: Gaussians, camera: Camera) -> Tensor:
        """The image [h, w, 3] of a crop, differentiable in the core's splats."""
        view = self._views[camera.name]
        both = _joined(core, self._halo[view.beside.long()])
        rendered = self._painter.backend.render(both, camera, replace(self._painter.effects, background=BLACK))
        inner = rendered.image + (1 - rendered.alpha)[..., None] * view.back.float()
        return view.front.float() + view.through.float() * inner


    @torch.no_grad()
    def wanted(self, core: Gaussians, camera: Camera, truth: Tensor) -> Tensor:
        """[h, w, 3] half: what the core should look like in front of, behind and among a halo that is not right yet either.

        The other tiles learn too, and each pixel's error must not be mended once by every tile that it shows: a tile mends the fraction
        of the error that it has of the pixel's blend weights. All tiles together then mend all of it, to first order.
        """
        error = self.render(core, camera) - truth
        return (truth + (1 - self._share(core, camera)) * error).half()

    def _share(self, core: Gaussians, camera: Camera) -> Tensor:
        """[h, w, 1]: the core's fraction of the blend weights of all splats in each pixel of a crop."""
        view, settings = self._views[camera.name], self._painter.effects.settings.without_color_rounding()
        halo = self._halo[view.beside.long()]
        white, black = (torch.full((len(splats), 1, 3), (color - 0.5) / C0) for splats, color in ((core, 1.0), (halo, 0.0)))
        effects = replace(self._painter.effects, background=BLACK, sh_degree=0, settings=settings)
        rendered = self._painter.backend.render(_joined(replace(core, sh=white), replace(halo, sh=black)), camera, effects)
        through = view.through.float()
        all_weights = 1 - through * (1 - rendered.alpha)[..., None] * view.clear.float()
        return through * rendered.image[..., :1] / all_weights.clamp_min(INVISIBLE)


def _joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """The splats of both; they have no covariances."""
    names = [field.name for field in fields(Gaussians) if field.name != "covariances"]
    return Gaussians(*(torch.cat([getattr(first, name), getattr(second, name)]) for name in names))
