"""Register a family that stores splats in a way of its own, and saves them so; here: means, Cholesky factors of covariances, opacities and RGB.

    python examples/register_family_files.py scene.npz --scale 1/4

Its parameters, in memory, are those of 3DGS: so its splats can be merged, optimized and written as a PLY for viewers. One whose splats are
something else is a class with the methods of `mipmap_plugin.models.SplatModel`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mipmap_plugin import Gaussians, register_model
from mipmap_plugin.cli import main
from mipmap_plugin.formats.atomic import new_file, refuse_output, sha256
from mipmap_plugin.models import API_VERSION, CERTAIN, Family, Files, Match
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import quaternions, rotations


class CholeskyModel(VanillaModel):
    family = "cholesky"  # the name that it is registered under

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool = False) -> None:
        if path.suffix != ".npz":
            return super().refuse_output(path, overwrite=overwrite)
        refuse_output(path, overwrite, [self.source] if self.source else [], is_file=True)

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False, **options: Any) -> Path:
        path, g = Path(path), self.gaussians().detach()
        self.refuse_output(path, overwrite=overwrite)
        if path.suffix != ".npz":  # a PLY, which viewers read
            return super().save(path, provenance=provenance, overwrite=overwrite, **options)
        sides = rotations(g.quats.double()) * g.scales.double()[:, None, :].clamp_min(1e-9)
        arrays = dict(means=g.means, cholesky=torch.linalg.cholesky(sides @ sides.mT), opacities=g.opacities, rgb=g.sh[:, 0] * C0 + 0.5)
        with new_file(path, overwrite) as temporary, temporary.open("wb") as file:  # it appears whole or not at all
            np.savez(file, **{name: array.cpu().numpy() for name, array in arrays.items()}, provenance=json.dumps(provenance, default=str))
        return path


def recognize(files: Files) -> Match | None:
    if files.kind != "zip" or files.path.suffix != ".npz":
        return None
    with np.load(files.path) as arrays:
        return Match(CERTAIN, "its array cholesky") if "cholesky" in arrays.files else None


def load(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    with np.load(path) as arrays:
        means, factors, opacities, rgb = (torch.from_numpy(arrays[name]).float() for name in ("means", "cholesky", "opacities", "rgb"))
    variances, axes = torch.linalg.eigh(factors.double() @ factors.double().mT)
    axes[torch.linalg.det(axes) < 0] *= -1  # rotations, not reflections
    scales = variances.clamp_min(0).sqrt().float()
    splats = Gaussians(means, quaternions(axes).float(), scales, opacities, (rgb[:, None] - 0.5) / C0)
    origin = Origin(Path(path), sha256(Path(path)), folder=Path(path).parent)  # whose cameras.json is read
    return CholeskyModel(VanillaModel.from_gaussians(splats).parameters(), origin=origin)


FAMILY = Family("cholesky", "splats as Cholesky factors", recognize, API_VERSION, load)

if __name__ == "__main__":
    register_model("cholesky", FAMILY)
    sys.exit(main(["adapt", *sys.argv[1:]]))  # the command, which knows it now
