"""Runs of a few steps of a small model."""

from dataclasses import replace

import pytest
import tiny

from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Interrupted, wrap_model

WHITE = (1.0, 1.0, 1.0)

# A few steps in which everything happens: both ways to choose views, two views a step, points of the curve, and splats that are dropped.
BRIEF = dict(steps=7, views_per_step=2, merge_to=1.0, extra_views=2, check_every=2, prune_every=3, min_opacity=0.4, patience=None, warm_up=0)
BRIEF_PAPER = dict(steps=7, check_every=2, prune_every=3, densify_gradient=1e-9)


def wrapped(count=40, cameras=None, backend="auto", **trained):
    return wrap_model(tiny.model(count, TrainedScale(**trained)), cameras=tiny.cameras() if cameras is None else cameras, backend=backend)


def resumed(adapt, state, ctrl_c, *steps):
    """What `adapt(resume=state)` returns that was interrupted before, in each of `steps` once."""
    for nth in steps:
        ctrl_c(nth)
        with pytest.raises(Interrupted, match=f"interrupted at step .*; run the same command again to continue from .*{state.name}"):
            adapt(resume=state)
    return adapt(resume=state)


def is_finite(model) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in model.parameters().values())


def shown(adapted):
    """What the adapted model shows of the first camera, at its scale."""
    return adapted.render(tiny.cameras()[0].zoomed(adapted.report.scale)).image


def shrunk(factor):
    """The model in units so small."""
    splats = tiny.gaussians()
    return VanillaModel.from_gaussians(replace(splats, means=splats.means * factor, scales=splats.scales * factor))
