"""What the numbers of effects, of render settings, of packings and of viewers may be. Others draw nothing, or fail in a kernel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

from mipmap_plugin.errors import SettingsError

# What a number has to be, in words, and the test.
Rule = tuple[str, Callable[[Any], bool]]


def _number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _steps(value: Any) -> bool:
    return isinstance(value, tuple) and all(map(STEP[1], value))


def _range(value: Any) -> bool:
    numbers = isinstance(value, tuple) and len(value) == 3 and all(_number(part) and math.isfinite(part) for part in value)
    return numbers and value[0] < value[1] and 0 < value[2] <= value[1] - value[0]


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, Integral) and int(value) >= least


def _degree(value: Any) -> bool:
    return type(value) is int and 0 <= value <= 4


def _color(value: Any) -> bool:
    return isinstance(value, (tuple, list)) and len(value) == 3 and all(_number(part) and math.isfinite(part) for part in value)


BOOL: Rule = "True or False", lambda value: isinstance(value, bool)
POSITIVE: Rule = "a number above 0", lambda value: _number(value) and value > 0
SIZE: Rule = "a number of at least 0", lambda value: _number(value) and 0 <= value < math.inf
ANY_SIZE: Rule = "a number of at least 0, or infinity", lambda value: _number(value) and value >= 0
SHARE: Rule = "a number from 0 to below 1", lambda value: _number(value) and 0 <= value < 1
STEP: Rule = "a step above 0 and up to 1", lambda value: _number(value) and 0 < value <= 1
STEPS: Rule = "a tuple of steps above 0 and up to 1", _steps

# Without a least alpha a splat would be as large as the picture; with one of 1 none would be drawn.
OF_SETTINGS: Mapping[str, Rule] = {
    "min_alpha": ("a number above 0 and below 1", lambda value: _number(value) and 0 < value < 1),
    "min_transmittance": SHARE,
    "radius": POSITIVE,
    "tile": ("a whole number from 1 to 256", lambda value: type(value) is int and 1 <= value <= 256),
    "max_alpha": ("a number above 0 and up to 1", lambda value: _number(value) and 0 < value <= 1),
    "max_color": POSITIVE,
    "color_steps": ("three steps above 0 and up to 1", lambda value: _steps(value) and len(value) == 3),
    "min_variance": SIZE,
    "min_contribution": SIZE,
    "least_spread": SIZE,
    "level_below": SIZE,
    "max_half_axis": POSITIVE,
    "frozen_beyond": ANY_SIZE,
    "frame": POSITIVE,
    "linear_light": ("a power from 1 to 4", lambda value: _number(value) and 1 <= value <= 4),
    "picture_step": STEP,
    **dict.fromkeys(("fades", "radial", "bucketed", "boxed", "rooted", "fits_picture", "frozen_by_width"), BOOL),
}

# px² of the image, and world units.
OF_EFFECTS: Mapping[str, Rule] = {
    "sh_degree": ("a whole number of at least 0", lambda value: _whole(value, 0)),
    "screen_filter": ("the name of a screen filter", lambda value: isinstance(value, str)),
    "eps2d": SIZE,
    "background": ("three finite numbers", _color),
    "supersampling": ("a whole number of at least 1, of samples along each axis of a pixel", lambda value: _whole(value, 1)),
    "near_plane": SIZE,
    "exposure": BOOL,
}

# 24 bits, as many as float32 tells apart.
OF_EVEN_BUCKETS: Mapping[str, Rule] = {
    "steps": ("a whole number from 1 to 16,777,216", lambda value: type(value) is int and 1 <= value <= 1 << 24),
    "sphere_from": SIZE,
    **dict.fromkeys(("later_in_front", "largest_first"), BOOL),
}

OF_PACKING: Mapping[str, Rule] = {
    "opacity": STEPS,
    "color": STEP,
    "bands": STEPS,
    "log_scales": ("a minimum, a larger maximum, and a step between them", _range),
    "quats": ("'octahedral' or 'stereographic'", lambda value: isinstance(value, str) and value in ("octahedral", "stereographic")),
    **dict.fromkeys(("downwards", "half_means"), BOOL),
}

# px² and world units. A dilation of more than a picture shows nothing but fog.
OF_VIEWER: Mapping[str, Rule] = {
    "eps2d": ("a dilation in px² from 0 to 10,000", lambda value: _number(value) and 0 <= value <= 1e4),
    "near_plane": SIZE,
    "sh_degree": ("a whole number from 0 to 4", _degree),
    "read_degrees": ("whole numbers from 0 to 4, at least one", lambda value: isinstance(value, tuple) and value != () and all(map(_degree, value))),
}


def check(what: str, record: Any, rules: Mapping[str, Rule], optional: frozenset[str]) -> None:
    """Raise SettingsError for the first field of a record that breaks its rule; those that are `optional` may be None."""
    for name, (words, holds) in rules.items():
        value = getattr(record, name)
        if not (value is None and name in optional) and not holds(value):
            raise SettingsError(f"{what}: {name} must be {words}{', or None' if name in optional else ''}, got {value!r}")
