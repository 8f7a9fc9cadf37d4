"""Ladders of a small model that are made in a moment."""

import tiny

from mipmap_plugin import wrap_model
from mipmap_plugin.levels.request import LadderRequest

BRIEF = dict(steps=1, extra_views=1, validation_views=2, warm_up=0, views_per_step=1)


def wrapped(count=12):
    return wrap_model(tiny.model(count, degree=0), cameras=tiny.cameras(2, width=16, height=12))


def request(viewer="antialiased", **options):
    return LadderRequest.of(viewer, **{"coarsest": 1 / 4, "ratio": 2.0, **BRIEF, **options})
