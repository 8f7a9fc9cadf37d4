"""Recipes: named sets of settings. How each number was found, and what it is worth, is in docs/recipes_found.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.errors import PluginError, SettingsError, type_of, with_type
from mipmap_plugin.limits import check_scale
from mipmap_plugin.registry import Registry

# (scale, whether the upsampler is a network) -> settings, by the names of AdaptConfig.
Recipe = Callable[[float, bool], Mapping[str, Any]]

# Upsamplers that interpolate, and add no detail to the base's images.
INTERPOLATIONS = frozenset({"bicubic", "lanczos"})

# A zoom-out keeps this fraction of the splats, times the scale; at scales near 1, where fewer share a pixel, twice the square of the scale.
MERGE_TO = 0.8

# The scale up to which a zoom-out uses its full learning rates. Above it there is less to learn, and rates fall as 1 / scale.
FULL_RATES_SCALE = 0.25

# A band ends at the base's scale, up to rounding.
HIGHEST = 1 + 1e-6

# The published code of Mipmap-GS (renaissanceee/Mipmap-GS), with a named setting for each of its quirks. Its means never move, because its
# loader leaves the factor of their learning rate at 0.
PAPER = dict(
    returns="last", views="given", steps=1000, resize="bilinear", upsampler="bicubic", quantize_truth=True, closed_form=False, rates=LearningRates(),
    densify_gradient=2e-4, reset_opacity_at=2, moments=None,
)  # fmt: skip

# Splats drawn by all steps of `default` together: about a minute on two cores. 360 steps of four views draw as many where a view shows 125,000.
MOST_DRAWS = 1.8e8

# The zoom from which on a picture shows more than the base's own. Below it steps only learn to undo the filter that shrinks their picture: on
# photographs of chair they lose 0.6 dB against the closed form at x1.02, 0.2 dB at x1.05, nothing at x1.1, and from there on they gain.
LEAST_ZOOM_IN = 1.1

# What a run ends by at the user's wish: then `most_draws` does not, and there are steps at any zoom.
ENDS = ("steps", "time_budget_s", "target_db")

# In a time budget with room for more, 720 steps gain 0.6 dB on lego at x1/4, and 1440 1.2 dB.
DEFAULT_OUT = dict(
    steps=360, most_steps=2500, most_draws=MOST_DRAWS, loss="psnr", decay=0.02, betas=(0.9, 0.95), nesterov=True, truth_oversampling=4,
    views_per_step=4, order="spread", gathering=0.25, warm_up=0.1, extra_views=150, resize="fitting", most_sh_degree=3,
)  # fmt: skip
RATES_OUT = LearningRates(
    means=0.1, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.04, offsets=0.1, features=0.05, networks=5e-3
)  # fmt: skip
THOROUGH_OUT = dict(
    DEFAULT_OUT, steps=2500, most_draws=None, views_per_step=8, warm_up=0.05, extra_views=1000, merging_costs=0.1, moments=48
)  # fmt: skip

# Without the steps at x1, one view a step is too little to learn another way to draw, where each view shows few of the splats: for spark at x2 a
# board that a tenth of the views shows gains 5 dB by 90 of them, 8 by 180, 11 by 360. Objects gain nothing, and take longer by each.
DEFAULT_IN = dict(
    conversion_steps=180, steps=200, crispness=0.75, compare_at="base", resize="fitting", patience=2, check_every=25, prune_every=1000, decay=0.3,
    least_zoom_in=LEAST_ZOOM_IN, rates=LearningRates(opacities=0.02, networks=5e-4),
)  # fmt: skip
DEFAULT_UPSAMPLED = dict(
    DEFAULT_IN, conversion_steps=0, least_zoom_in=1.0, steps=800, crispness=0.0, compare_at="both", resize="pil-bicubic", patience=None,
    views="train", rates=LearningRates(scales=0.015, quats=0.003, opacities=0.05, sh0=0.01, shN=0.001, networks=5e-4),
)  # fmt: skip
THOROUGH_UPSAMPLED = dict(
    steps=400, compare_at="both", resize="pil-bicubic", views="train", upsampled_views=100, detail_weight=1.0,
    detail_structure=0.4, detail_contrast=3.2, views_per_step=4, decay=0.02, betas=(0.8, 0.95),
    densify_gradient=1e-4, densify_on_trial=True, most_growth=8, prune_every=50,
    rates=LearningRates(means=0.2, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.002, networks=5e-4),
)  # fmt: skip


def default(scale: float, network: bool) -> dict[str, Any]:
    """For most uses: closed form, merging and a short optimization, minutes at most."""
    return DEFAULT_OUT | _zoom_out_settings(scale) if scale <= 1 else dict(DEFAULT_UPSAMPLED if network else DEFAULT_IN)


def thorough(scale: float, network: bool) -> dict[str, Any]:
    """Better quality in ten to twenty times the time; at zoom-in without a network the same as `default`."""
    return THOROUGH_OUT | _zoom_out_settings(scale) if scale <= 1 else dict(THOROUGH_UPSAMPLED if network else DEFAULT_IN)


def paper(scale: float, network: bool) -> dict[str, Any]:
    """The published method of Mipmap-GS with its settings, at every scale, for comparison."""
    return dict(PAPER)


def instant(scale: float, network: bool) -> dict[str, Any]:
    """The closed form alone, without optimization: seconds."""
    return dict(steps=0, resize="fitting") if scale <= 1 else dict(steps=0, crispness=0.5)


RECIPES = Registry("mipmap_plugin.recipes", {name: f"mipmap_plugin.recipes:{name}" for name in ("default", "thorough", "paper", "instant")})


def register_recipe(name: str, target: Recipe | str, *, replace: bool = False) -> None:
    """Register a function `(scale, network) -> settings`, or `"package.module:function"`, under `name`. Raises SettingsError."""
    RECIPES.add(name, target, replace=replace)


def recipe(name: str, scale: float, **overrides: Any) -> AdaptConfig:
    """Return the settings of a recipe at `scale`, with `overrides`.

    Raises SettingsError for an unknown name or a value out of range, PluginError for a third-party recipe that fails.
    """
    scale = check_scale(scale)
    function = RECIPES.get(name)
    if not callable(function):
        raise PluginError(f"recipe {name!r} is of type {type(function).__name__}; make it a function (scale, network) -> settings")
    try:
        made = function(scale, str(overrides.get("upsampler", "bicubic")) not in INTERPOLATIONS)
    except (Exception, SystemExit) as error:  # third-party code may fail in any way
        raise PluginError(f"recipe {name!r} failed at x{scale:g}: {with_type(error)}") from error
    if not isinstance(made, Mapping) or not all(isinstance(key, str) for key in made):
        got = "other keys than texts" if isinstance(made, Mapping) else type_of(made)
        raise PluginError(f"recipe {name!r} has to return a dict of settings by name; at x{scale:g} it returned {got}")
    settings = {"recipe": name, **made}
    try:
        AdaptConfig(**settings)
    except SettingsError as error:
        raise SettingsError(f"recipe {name}: {error}") from None
    if any(overrides.get(end) is not None for end in ENDS):
        settings |= {"most_draws": None, "least_zoom_in": 1.0}
    if overrides.get("steps") is not None:
        settings.pop("most_steps", None)
    config = AdaptConfig(**(settings | overrides))
    if config.band != (1, 1) and (highest := scale * max(1.0, config.band[1])) > HIGHEST:
        raise SettingsError(f"band: x{scale:g} would be shown up to x{highest:g}, but a band ends at the base's scale, x1")
    return config


def most_steps(name: str, scale: float, steps: int | None) -> int | None:
    """A maximum of steps of several recipes that are compared, as the setting of one: None where it has no steps, for a maximum adds none."""
    return None if steps is None or recipe(name, scale).steps == 0 else steps


def scale_of_fraction(kept: float) -> float:
    """The scale at which a zoom-out keeps this fraction of the splats, the inverse of `_zoom_out_settings`; 1 where it keeps all."""
    if kept >= 1:
        return 1.0
    return kept / MERGE_TO if kept < MERGE_TO**2 / 2 else (kept / 2) ** 0.5


def _zoom_out_settings(scale: float) -> dict[str, Any]:
    """The settings that depend on the scale, of a zoom-out or of a conversion to a viewer at the base's own scale."""
    factor = min(1.0, FULL_RATES_SCALE / scale)
    splat_rates = ("means", "scales", "quats", "opacities", "sh0", "shN")  # not those of anchors and networks, which were not tested with it
    rates = RATES_OUT.model_copy(update={name: factor * getattr(RATES_OUT, name) for name in splat_rates})
    return {"merge_to": min(1.0, scale * max(MERGE_TO, 2 * scale)), "rates": rates}
