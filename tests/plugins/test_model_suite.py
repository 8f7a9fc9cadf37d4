"""Every built-in family passes the suite for third-party families, and a broken one does not."""

from dataclasses import replace
from functools import partial

import anchor_checkpoints
import gltf_files
import mip_checkpoints
import moving
import pytest
import surfel_checkpoints
import tiny
import torch_checkpoints
from their_families import Ellipsoids, Theirs, save_as_text, wrapped

from mipmap_plugin import wrap_model
from mipmap_plugin.errors import PluginError
from mipmap_plugin.models import Traits
from mipmap_plugin.models.conformance import ModelSuite
from mipmap_plugin.models.families import BUILT_IN
from mipmap_plugin.models.vanilla import VanillaModel

WRITERS = {
    "3dgs": partial(tiny.folder, views=tiny.cameras()),
    "2dgs": surfel_checkpoints.folder,
    **{family: partial(mip_checkpoints.folder, family=family) for family in ("mip", "gof", "analytic")},
    "scaffold": anchor_checkpoints.write,
    "octree": partial(anchor_checkpoints.write, layout=anchor_checkpoints.Layout("octree", level=True)),
    "deformable": moving.write_deformable,
    "4dgs": moving.write_hexplane,
    "gsplat": lambda path: torch_checkpoints.gsplat_folder(path, torch_checkpoints.splats()),
    "gltf": lambda path: gltf_files.glb(path, tiny.gaussians()),
    "splatfacto": lambda path: torch_checkpoints.splatfacto_folder(path, torch_checkpoints.splats()),
}

# The first needs splat-transform, which is no Python package; tests/exchange tests it with a stand-in. The second is in tests/formats/test_zipped.py.
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


class Faint(Theirs):
    """It says that backends may activate its parameters, and does so otherwise."""

    def gaussians(self, camera=None):
        splats = VanillaModel.gaussians(self, camera)
        return replace(splats, opacities=splats.opacities / 2)

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.traits = replace(self.traits, plain=True)


class Full(Theirs):
    """It says that rows can be left out, and keeps them."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.traits = replace(self.traits, thins=True)

    def thin(self, keep):
        pass


class Forgetful(Theirs):
    def reshape(self, form, views=()):
        VanillaModel.reshape(self, lambda gaussians: (2 * form(gaussians)[0], form(gaussians)[1]), views)


@pytest.mark.parametrize(
    ("kind", "test"),
    [
        (Faint, "test_keeps_what_its_traits_promise"), (Full, "test_rows_can_be_left_out"),
        (Forgetful, "test_shapes_that_stay_keep_the_picture"),
    ],
)  # fmt: skip
def test_the_suite_sees_models_that_break_a_promise(kind, test):
    with pytest.raises(AssertionError):
        getattr(ModelSuite(), test)(wrap_model(kind(tiny.model().parameters()), cameras=tiny.cameras(2)))


def test_the_suite_rebuilds_splats_of_covariances_as_adaptation_does():
    """It hands over quaternions and scales alone."""

    class Wanting(Ellipsoids):
        def rebuild(self, form):
            super().rebuild(lambda gaussians: replace(form(gaussians), covariances=form(gaussians).covariances.clone()))

    suite, raw, views = ModelSuite(), tiny.model().parameters(), tiny.cameras(2)
    suite.test_keeps_what_its_traits_promise(wrap_model(Ellipsoids(raw), cameras=views))
    with pytest.raises(AttributeError, match="'clone'"):
        suite.test_keeps_what_its_traits_promise(wrap_model(Wanting(raw), cameras=views))


def test_the_suite_wants_a_ply_for_viewers(tmp_path):
    with pytest.raises(PluginError, match="save"):
        ModelSuite().test_writes_a_ply_for_viewers(wrapped(save=save_as_text), tmp_path)
    moving = wrapped(save=save_as_text)
    moving.model.traits = Traits(moves=True)
    ModelSuite().test_writes_a_ply_for_viewers(moving, tmp_path)  # as no viewer draws it
