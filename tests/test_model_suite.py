"""Every built-in family passes the suite for third-party families."""

from functools import partial

import anchor_checkpoints
import gltf_files
import mip_checkpoints
import moving
import pytest
import test_surfels
import tiny
import torch_checkpoints

from mipmap_plugin.models.conformance import ModelSuite
from mipmap_plugin.models.families import BUILT_IN

WRITERS = {
    "3dgs": partial(tiny.folder, views=tiny.cameras()),
    "2dgs": test_surfels.folder,
    **{family: partial(mip_checkpoints.folder, family=family) for family in ("mip", "gof", "analytic")},
    "scaffold": anchor_checkpoints.write,
    "octree": partial(anchor_checkpoints.write, layout=anchor_checkpoints.Layout("octree", level=True)),
    "deformable": moving.write_deformable,
    "4dgs": moving.write_hexplane,
    "gsplat": lambda path: torch_checkpoints.gsplat_folder(path, torch_checkpoints.splats()),
    "gltf": lambda path: gltf_files.glb(path, tiny.gaussians()),
    "splatfacto": lambda path: torch_checkpoints.splatfacto_folder(path, torch_checkpoints.splats()),
}

# The first needs splat-transform, which is no Python package; tests/exchange tests it with a stand-in. The second is in tests/test_zipped.py.
ELSEWHERE = {"exchange", "zipped"}


def suite_of(name):
    """A suite for pytest to find."""

    class Suite(ModelSuite):
        family = name
        cameras = tuple(tiny.cameras())

        @pytest.fixture
        def checkpoint(self, tmp_path):
            WRITERS[name](tmp_path / "base")
            return tmp_path / "base"

    return Suite


for family in WRITERS:
    globals()[f"Test_{family}"] = suite_of(family)


def test_every_family_that_is_loaded_is_in_the_suite():
    assert {family.name for family in BUILT_IN if family.load} - ELSEWHERE == set(WRITERS)
