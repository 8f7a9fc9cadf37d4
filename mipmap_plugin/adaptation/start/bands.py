"""SH bands that a zoom-out adds where merging has made room for them.

A viewer's dilation takes sharpness from every picture, and colors that depend on the view bring some of it back (docs/recipes_found.md). Splats of
phones and of the web's formats often have no bands, or one.
"""

from __future__ import annotations

import torch

from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.viewers import degree_for


def with_more_bands(start: SplatModel, base: SplatModel, used: int, most: int, viewer: str | None) -> tuple[SplatModel, int]:
    """The start, with SH bands of zeros where need be, and the degree up to which it has room for them: at most `most`, and at least `used`.

    So many that a PLY for the `viewer`, whose loader may read some degrees only, has no more numbers than the base, of whose bands those up to `used`
    count, as the others are 0. A checkpoint of gsplat's or nerfstudio's own keeps its bands, which are part of what its program expects.
    """
    if not isinstance(start, VanillaModel) or start.traits.placed:
        return start, used
    room = len(base.parameters()["means"]) * _numbers(used)
    fitting = [each for each in range(most + 1) if len(start) * _numbers(degree_for(viewer, each)) <= room]
    degree = max([used, *fitting])
    return start.with_degree(degree) if degree > start.sh_degree else start, degree


@torch.no_grad()
def used_degree(model: SplatModel) -> int:
    """The highest SH degree of the splats of a model that may have got bands; 0 of others."""
    return model.gaussians().used_sh_degree() if isinstance(model, VanillaModel) else 0


def _numbers(degree: int) -> int:
    """What a splat of 3DGS has: center, rotation, scales, opacity and color."""
    return 3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2
