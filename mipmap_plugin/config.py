"""Settings: frozen, closed, documented in place. A recipe is a set of them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.limits import MOST_SEED

ResizeFilter = Literal["box", "area", "bilinear", "pil-bicubic", "lanczos"]
ViewPolicy = Literal["given", "train", "test", "orbit", "jittered"]
Recipe = Literal["default", "thorough", "paper", "instant"]
Momentum = Annotated[float, Field(ge=0, lt=1)]


class LearningRates(BaseModel):
    """Adam's step for each raw parameter, named as in a gsplat checkpoint. 0 keeps a parameter where it is."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    means: float = Field(0.0, ge=0, description="Target pixels at the median splat: in a scene of any size a step is as large on the screen.")
    scales: float = Field(0.005, ge=0, description="Of the log scales.")
    quats: float = Field(0.001, ge=0)
    opacities: float = Field(0.05, ge=0, description="Of the logits.")
    sh0: float = Field(0.0025, ge=0)
    shN: float = Field(0.0025 / 20, ge=0)
    offsets: float = Field(0.0, ge=0, description="Of an anchor's splats around it, in units of its own size.")
    features: float = Field(0.0075, ge=0, description="Of an anchor's feature vector.")
    networks: float = Field(0.0, ge=0, description="Of networks that all anchors share; a deformation network never moves.")


class AdaptConfig(BaseModel):
    """How one checkpoint is adapted to one scale."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    recipe: Recipe = Field("default", description="The name of the set that these settings started from.")
    steps: int = Field(1000, ge=0, description="Optimizer steps at most.")
    time_budget_s: float | None = Field(None, gt=0, description="Seconds after which adapting ends, whatever the step.")
    target_db: float | None = Field(None, description="Stop at the first check whose PSNR against the pseudo truth (not photographs) is this high.")
    patience: int | None = Field(None, gt=0, description="Stop at the knee: after this many checks in a row that gained less than `min_gain_db`.")
    min_gain_db: float = Field(0.05, ge=0, description="Gain in dB between two checks that still pays.")
    check_every: int = Field(50, gt=0, description="Steps between two points of the curve.")
    seed: int = Field(0, ge=0, le=MOST_SEED, description="Everything random follows from it.")

    resize: ResizeFilter = Field("pil-bicubic", description="How the base image is made smaller; the filter of the protocol that is aimed at.")
    upsampler: str = Field("bicubic", description="How the base image is made larger, by name in the registry.")
    compare_at: Literal["target", "base", "both"] = Field("target", description="Zoom-in: with the upsampled base, with the base itself, or both.")
    detail_weight: float = Field(0.1, ge=0, description="`both`: of the difference from the upsampled base, beside the square from the base.")
    detail_structure: float = Field(0.0, ge=0, le=1, description="`both`: how much of that difference is one of structure, 1 - SSIM.")
    detail_contrast: float = Field(0.0, ge=0, description="`both`: weight in that difference of how strong local contrasts are, wherever they are.")
    upsampled_views: int = Field(50, gt=0, description="`both`: views at most, spread over those of the policy; each is upsampled.")
    quantize_truth: bool = Field(False, description="Round the pseudo truth to 8 bits, as files of PNG do.")
    truth_oversampling: int | None = Field(None, gt=0, description="Render the base at most this many times finer than the target; None: at its own.")

    views: ViewPolicy = Field("jittered", description="Which views are adapted to; `jittered`: the train views and others around them.")
    extra_views: int = Field(100, ge=0, description="How many views `jittered` adds, or an orbit has.")

    closed_form: bool = Field(True, description="Start from the closed form instead of from the base.")
    crispness: float = Field(0.0, ge=0, le=1, description="Zoom-in: from 0, most dB, to 1, splats as small as the base's own and more opaque.")
    merge_to: float = Field(1.0, gt=0, le=1, description="Share of the splats that is left when like ones that share pixels are merged.")
    merging_costs: float = Field(0.3, ge=0, description="dB on validation views that merging may cost before the first step; else fewer are merged.")
    rates: LearningRates = LearningRates()
    loss: Literal["psnr", "l2", "l1"] = Field("l2", description="Of an image: log of the mean square difference, that itself, or the mean absolute.")
    decay: float = Field(1.0, gt=0, le=1, description="Every rate ends at this share of itself, falling along half a cosine.")
    betas: tuple[Momentum, Momentum] = Field((0.9, 0.999), description="Adam's: how long it remembers gradients and their squares.")
    views_per_step: int = Field(1, gt=0, description="Views whose gradients are summed for one step.")
    warm_up: float = Field(0.0, ge=0, le=1, description="Fraction of the steps during which rates rise, as far as validation views allow.")
    gathering: float = Field(0.0, ge=0, le=1, description="Fraction of the run during which new views are introduced; each costs a render.")
    validation_views: int = Field(16, ge=2, description="Views not adapted to, at most: half steer the run, half choose what it returns.")
    returns: Literal["best", "last"] = Field("best", description="The best state on validation views, base and start included, or the last.")
    prune_every: int = Field(100, gt=0, description="Steps between two prunings.")
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Splats below it are pruned.")
    densify_gradient: float | None = Field(None, gt=0, description="Screen gradient, NDC units, above which a splat is cloned or split; None: never.")
    densify_keeps_image: bool = Field(False, description="Split splats into two that show almost what one did, instead of the published clones.")
    densify_on_trial: bool = Field(False, description="Undo growth that leaves views farther from the base than at the start.")
    most_growth: float | None = Field(None, ge=1, description="How many times its splats densifying may leave at most; None: no end.")
    reset_opacity_at: int | None = Field(None, ge=0, description="Step before which all opacities are cut to 0.01, on a white background only.")

    @property
    def warm_up_steps(self) -> int:
        return math.ceil(self.warm_up * self.steps)


# The published code (renaissanceee/Mipmap-GS): every quirk a named setting. Its centres never move, because its loader leaves the
# rate's factor at 0; its zoom-out target is a bilinear resize without a prefilter, stored in 8 bits; on white it resets
# all opacities at step 2; its zoom-in and zoom-out both take 1000 steps.
_PAPER = dict(
    returns="last", views="given", steps=1000, resize="bilinear", upsampler="bicubic", quantize_truth=True, closed_form=False, rates=LearningRates(),
    densify_gradient=2e-4, reset_opacity_at=2,
)  # fmt: skip

_INSTANT = dict(steps=0)

# A classic file dilates by more than an image filter does, so sharpness has to come from colors that depend on the view: bands
# above 0 move as fast as the base color, towards hundreds of views, or held-out views gain nothing by it. Rates are so bold that
# most is gained while they fall; a memory for the last twenty squares instead of a thousand lets so short a run follow. There is no
# knee to stop at before they have fallen. What is bold follows from the scene: rates rise during the warm-up until validation views say that
# steps do harm (`validation`): never on lego and chair, sooner or later on real captures. The loss is PSNR's, so that a few views that are
# far off, next to floaters, do not decide for all.
_DEFAULT_OUT = dict(
    steps=600, loss="psnr", decay=0.02, betas=(0.8, 0.95), truth_oversampling=4, views_per_step=3, gathering=0.5, warm_up=0.1, extra_views=250,
)  # fmt: skip
_RATES_OUT = LearningRates(means=0.1, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.04, offsets=0.01, networks=5e-4)

# What more time buys at zoom-out: four times the steps, of eight views each, four times the views, and more splats, for what merging costs
# at the start so many steps do not win back (flowers at x1/8: 0.14 dB then, 2 dB in the end). At zoom-in there is nothing to buy without
# a network.
_THOROUGH_OUT = dict(_DEFAULT_OUT, steps=2500, views_per_step=8, warm_up=0.05, extra_views=1000, merging_costs=0.1)

# Of a zoom-out's splats, times the scale: at x1/8 a tenth is left, at x1/4 a fifth. Nearer to the base, where fewer share a pixel, twice
# the scale's square: half at x1/2.
MERGE_TO = 0.8

# Share of the base scale below which rates are whole. Nearer to the base there is less to learn, and steps are shorter by as much: at x1/2
# a tenth of `paper`'s time has 0.4 dB more with half the rates (chair; lego 0.3), and the end is the same.
WHOLE_RATES = 0.25

# Towards a bicubic or Lanczos target every step loses real dB against the closed form: the target knows nothing that the
# base does not, and adds the kernel's ringing. So the image is shrunk and compared with the base itself, at gentle rates. Centers
# stay: moving them gains 0.02 dB on lego, and steps of a third of a pixel cost 5 dB on flowers. What no image of the base's size tells stays as
# it was at the start, and so a crisp start, which has less dB, ends with better LPIPS: with as many dB at a crispness of 0.5, and at 0.25 with more
# on lego, on chair and on small scenes of known truth (benchmarks/results/zoom_in.md).
_DEFAULT_IN = dict(
    steps=200, crispness=0.25, compare_at="base", resize="area", patience=2, check_every=25, prune_every=1000, decay=0.3,
    rates=LearningRates(opacities=0.02, networks=5e-4),
)  # fmt: skip

# With a super-resolution network there is something to learn at the new scale too: more steps and bolder rates pay, LPIPS above all. How crisp
# it is follows from the network.
_DEFAULT_UPSAMPLED = dict(
    _DEFAULT_IN, steps=800, crispness=0.0, compare_at="both", resize="pil-bicubic", patience=None, views="train",
    rates=LearningRates(scales=0.015, quats=0.003, opacities=0.05, sh0=0.01, shN=0.001, networks=5e-4),
)  # fmt: skip

# And finer things than the base's splats can show: they are split and cloned to the end, to as many as eight times, and centers
# move to part them. Colors that depend on the view learn little, for what a network makes up differs from view to view; the mean of
# that is soft, and so contrasts have to be as strong as the network's. Splats split by `densify_keeps_image` are softer but truer. All
# this suits objects. On flowers, an unbounded scene, 400 steps of it end 32 dB from the base, where the closed form has 39; on trial the
# first growth is undone, and they end at 43 (benchmarks/results/unbounded.md).
_THOROUGH_UPSAMPLED = dict(
    steps=400, compare_at="both", resize="pil-bicubic", views="train", upsampled_views=100, detail_weight=1.0,
    detail_structure=0.4, detail_contrast=3.2, views_per_step=4, decay=0.02, betas=(0.8, 0.95),
    densify_gradient=1e-4, densify_on_trial=True, most_growth=8, prune_every=50,
    rates=LearningRates(means=0.2, scales=0.04, quats=0.008, opacities=0.1, sh0=0.03, shN=0.002, networks=5e-4),
)  # fmt: skip

# What knows nothing that the base does not: kernels.
KERNELS = frozenset({"bicubic", "lanczos"})


def _slower(rates: LearningRates, share: float) -> LearningRates:
    """Those of splats; what anchors and networks learn is not known to want it."""
    of_splats = ("means", "scales", "quats", "opacities", "sh0", "shN")
    return rates.model_copy(update={name: share * getattr(rates, name) for name in of_splats})


def recipe(name: Recipe, scale: float, **overrides: Any) -> AdaptConfig:
    """The settings of a recipe at `scale`, with `overrides`. Raises SettingsError for an unknown name or a value out of range."""
    if scale < 1:
        fitted = {"merge_to": min(1.0, scale * max(MERGE_TO, 2 * scale)), "rates": _slower(_RATES_OUT, min(1.0, WHOLE_RATES / scale))}
        default, thorough = _DEFAULT_OUT | fitted, _THOROUGH_OUT | fitted
    elif overrides.get("upsampler", "bicubic") in KERNELS:
        default = thorough = _DEFAULT_IN
    else:
        default, thorough = _DEFAULT_UPSAMPLED, _THOROUGH_UPSAMPLED
    known: dict[str, dict[str, Any]] = {"default": default, "thorough": thorough, "paper": _PAPER, "instant": _INSTANT}
    if name not in known:
        raise SettingsError(f"there is no recipe {name!r}; known are {', '.join(known)}")
    try:
        return AdaptConfig(**{"recipe": name, **known[name], **overrides})
    except ValidationError as error:
        raise SettingsError("; ".join(f"setting {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())) from None
