"""Families of a stranger, and models of them that lack or change a part."""

from dataclasses import replace

import tiny

from mipmap_plugin import wrap_model
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import rotations

BRIEF = dict(steps=1, extra_views=2, validation_views=2, merge_to=1.0)


class Theirs(VanillaModel):
    family = "theirs"


class Ellipsoids(Theirs):
    """Its splats are told by covariances."""

    def gaussians(self, camera=None):
        splats = super().gaussians(camera)
        axes = rotations(splats.quats) * splats.scales[:, None, :]
        return replace(splats, covariances=axes @ axes.mT)


def model(**members):
    return type("Odd", (Theirs,), members)(tiny.model().parameters())


def wrapped(**members):
    return wrap_model(model(**members), cameras=tiny.cameras(2), backend="reference")


def save_as_text(self, path, *, provenance, overwrite=False):
    with new_file(path, overwrite) as temporary:
        temporary.write_text("splats")
    return path
