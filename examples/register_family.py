"""Register your own family of checkpoints; here: splats in a NumPy archive, whose adapted files are PLYs.

    python examples/register_family.py scene.npz --scale 1/4

A package registers it without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.models"]
    npz = "my_package.npz:FAMILY"

and tests it in one file, test_npz.py, where everything that a family has to do becomes a pytest test:

    import pytest

    from mipmap_plugin.models.conformance import ModelSuite

    class TestNpz(ModelSuite):
        family = "npz"

        @pytest.fixture
        def checkpoint(self, tmp_path):
            return write_a_small_one(tmp_path / "scene.npz")
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from mipmap_plugin import register_model
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models import CERTAIN, Family, Files, Match
from mipmap_plugin.models.vanilla import Origin, VanillaModel

NAMES = ("means", "scales", "quats", "opacities", "sh0", "shN")


def recognize(files: Files) -> Match | None:
    return Match(CERTAIN, "its arrays") if files.kind == "zip" and files.path.suffix == ".npz" else None


def load(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    with np.load(path) as arrays:  # an adapted model is saved as a PLY
        if missing := set(NAMES) - set(arrays.files):
            raise CheckpointError(f"{path} lacks the arrays {', '.join(sorted(missing))}; export it again")
        tensors = {name: torch.from_numpy(arrays[name]).float() for name in NAMES}
    return VanillaModel(tensors, origin=Origin(Path(path), folder=Path(path).parent))  # whose cameras.json is read


FAMILY = Family("npz", "splats in a NumPy archive", recognize, api_version=1, load=load, saves=".ply")

if __name__ == "__main__":
    register_model("npz", FAMILY)
    sys.exit(main(["adapt", *sys.argv[1:]]))  # the command, which knows it now
