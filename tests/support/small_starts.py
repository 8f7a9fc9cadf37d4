"""Small adaptations that end with their start."""

import tiny

from mipmap_plugin.wrap import wrap_model

SCALE, COUNT = 1 / 4, 80


def adapted(count=COUNT, scale=SCALE, **settings):
    model = wrap_model(tiny.model(count), cameras=tiny.cameras())
    return model.adapt(scale, **{"steps": 0, "merge_to": 1.0, "extra_views": 4, **settings})


def start_of(report) -> str:
    return next(name for name in report.validation if name.startswith("the start, ")).removeprefix("the start, ")
