"""Every built-in family passes the suite for third-party families, and a broken one does not."""

from dataclasses import replace
from functools import partial

import anchor_checkpoints
import gltf_files
import mip_checkpoints
import moving
import pytest
import test_surfels
import tiny
import torch_checkpoints

from mipmap_plugin import wrap_model
from mipmap_plugin.models import Traits
from mipmap_plugin.models.conformance import ModelSuite
from mipmap_plugin.models.families import BUILT_IN
from mipmap_plugin.models.vanilla import VanillaModel

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


class Drifting(VanillaModel):
    """Its splats move, but those of a copy do not."""

    velocity = 0.0

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.traits = Traits(moves=True)

    def gaussians(self, camera=None):
        splats, time = super().gaussians(camera), camera.time if camera else None
        return replace(splats, means=splats.means + self.velocity * (time or 0))


@pytest.mark.parametrize("check", [ModelSuite.test_shapes_that_stay_keep_the_picture, ModelSuite.test_goes_to_another_device])
def test_the_suite_looks_at_later_moments_of_what_moves(check):
    still, drifting = (wrap_model(Drifting(tiny.model(40).parameters()), cameras=tiny.cameras(), backend="reference") for _ in range(2))
    drifting.model.velocity = 0.5
    check(ModelSuite(), still)
    with pytest.raises(AssertionError, match="a picture changes by up to"):
        check(ModelSuite(), drifting)
