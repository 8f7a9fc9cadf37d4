"""Recipes: named sets of settings. How each number was found, and what it is worth, is in docs/recipes.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import ValidationError

from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.limits import check_scale
from mipmap_plugin.registry import Registry

# The settings, by the names of AdaptConfig, at a scale; and whether a network enlarges the base's images.
Recipe = Callable[[float, bool], Mapping[str, Any]]

# Upsamplers that know nothing that the base does not.
KERNELS = frozenset({"bicubic", "lanczos"})

# Of a zoom-out's splats, times the scale, is left; nearer to the base, where fewer share a pixel, twice the scale's square.
MERGE_TO = 0.8

# Share of the base scale below which rates are whole. Nearer to the base there is less to learn, and steps are shorter by as much.
WHOLE_RATES = 0.25

# The published code of Mipmap-GS (renaissanceee/Mipmap-GS): every quirk a named setting. Its centers never move, because its loader leaves
# the rate's factor at 0.
PAPER = dict(
    returns="last", views="given", steps=1000, resize="bilinear", upsampler="bicubic", quantize_truth=True, closed_form=False, rates=LearningRates(),
    densify_gradient=2e-4, reset_opacity_at=2,
)  # fmt: skip

DEFAULT_OUT = dict(
    steps=600, loss="psnr", decay=0.02, betas=(0.8, 0.95), truth_oversampling=4, views_per_step=3, gathering=0.5, warm_up=0.1, extra_views=250,
)  # fmt: skip
RATES_OUT = LearningRates(means=0.1, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.04, offsets=0.01, networks=5e-4)
THOROUGH_OUT = dict(DEFAULT_OUT, steps=2500, views_per_step=8, warm_up=0.05, extra_views=1000, merging_costs=0.1)

DEFAULT_IN = dict(
    steps=200, crispness=0.25, compare_at="base", resize="area", patience=2, check_every=25, prune_every=1000, decay=0.3,
    rates=LearningRates(opacities=0.02, networks=5e-4),
)  # fmt: skip
DEFAULT_UPSAMPLED = dict(
    DEFAULT_IN, steps=800, crispness=0.0, compare_at="both", resize="pil-bicubic", patience=None, views="train",
    rates=LearningRates(scales=0.015, quats=0.003, opacities=0.05, sh0=0.01, shN=0.001, networks=5e-4),
)  # fmt: skip
THOROUGH_UPSAMPLED = dict(
    steps=400, compare_at="both", resize="pil-bicubic", views="train", upsampled_views=100, detail_weight=1.0,
    detail_structure=0.4, detail_contrast=3.2, views_per_step=4, decay=0.02, betas=(0.8, 0.95),
    densify_gradient=1e-4, densify_on_trial=True, most_growth=8, prune_every=50,
    rates=LearningRates(means=0.2, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.002, networks=5e-4),
)  # fmt: skip


def default(scale: float, network: bool) -> dict[str, Any]:
    """What suits most: minutes at most, and the closed form first."""
    return DEFAULT_OUT | _fitted(scale) if scale < 1 else DEFAULT_UPSAMPLED if network else DEFAULT_IN


def thorough(scale: float, network: bool) -> dict[str, Any]:
    """What more time buys; at zoom-in there is nothing to buy without a network."""
    return THOROUGH_OUT | _fitted(scale) if scale < 1 else THOROUGH_UPSAMPLED if network else DEFAULT_IN


def paper(scale: float, network: bool) -> dict[str, Any]:
    """What the published code of Mipmap-GS does, at every scale."""
    return PAPER


def instant(scale: float, network: bool) -> dict[str, Any]:
    """The closed form alone."""
    return dict(steps=0)


RECIPES = Registry("mipmap_plugin.recipes", {name: f"mipmap_plugin.recipes:{name}" for name in ("default", "thorough", "paper", "instant")})


def register_recipe(name: str, target: Recipe | str, *, replace: bool = False) -> None:
    """Add a function `(scale, network) -> settings` under `name`, or `"package.module:function"`. Raises SettingsError."""
    RECIPES.add(name, target, replace=replace)


def recipe(name: str, scale: float, **overrides: Any) -> AdaptConfig:
    """The settings of a recipe at `scale`, with `overrides`.

    Raises SettingsError for an unknown name or a value out of range, PluginError for a stranger's recipe that fails.
    """
    check_scale(scale)
    if name not in RECIPES.names():
        raise SettingsError(f"there is no recipe {name!r}; known are {', '.join(RECIPES.names())}")
    found = RECIPES.get(name)
    if not callable(found):
        raise PluginError(f"recipe {name!r} is of type {type(found).__name__}; make it a function (scale, network) -> settings")
    try:
        settings = {**found(scale, str(overrides.get("upsampler", "bicubic")) not in KERNELS)}
    except Exception as error:  # a stranger's code may fail in any way
        raise PluginError(f"recipe {name!r} gives no settings at x{scale:g}: {type(error).__name__}: {error}") from error
    try:
        return AdaptConfig(**{"recipe": name, **settings, **overrides})
    except ValidationError as error:
        raise SettingsError("; ".join(f"setting {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())) from None


def _fitted(scale: float) -> dict[str, Any]:
    """The settings of a zoom-out that follow from its scale."""
    share = min(1.0, WHOLE_RATES / scale)
    of_splats = ("means", "scales", "quats", "opacities", "sh0", "shN")  # what anchors and networks learn is not known to want it
    rates = RATES_OUT.model_copy(update={name: share * getattr(RATES_OUT, name) for name in of_splats})
    return {"merge_to": min(1.0, scale * max(MERGE_TO, 2 * scale)), "rates": rates}
