"""The settings of an adaptation, with their documentation. A recipe (`recipes`) is a named set of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from mipmap_plugin.errors import SettingsError, type_of
from mipmap_plugin.limits import MAX_SEED

ResizeFilter = Literal["fitting", "box", "area", "bilinear", "pil-bicubic", "lanczos"]
ViewPolicy = Literal["given", "train", "test", "orbit", "jittered"]
Factor = Annotated[float, Field(gt=0)]
Momentum = Annotated[float, Field(ge=0, lt=1)]


# What is said of a base when it is wrapped, and not of each adaptation.
OF_THE_BASE = ("backend", "threads", "background", "screen_filter", "up")

# Characters of a wrong value that a message quotes; of a longer one, such as a list of cameras, it names the type.
LONGEST = 80


class Settings(BaseModel):
    """Settings by name."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    owner: ClassVar[str] = ""  # what the names of these are behind, in messages

    def __init__(self, **settings: Any) -> None:
        """Raises SettingsError for a name that is unknown and a value out of range."""
        try:
            super().__init__(**settings)
        except ValidationError as error:
            told = dict.fromkeys(_told(type(self), each, settings) for each in error.errors())  # of a pair, whose parts may both be wrong, once
            raise SettingsError("; ".join(told)) from None


class LearningRates(Settings):
    """Adam's learning rate for each raw parameter, named as in a gsplat checkpoint. A parameter of rate 0 does not change."""

    owner = "rates."

    means: float = Field(
        default=0.0, ge=0, description="Target pixels at the median splat, so that steps on the screen are the same for scenes of any size."
    )
    scales: float = Field(default=0.005, ge=0, description="Of the log scales.")
    quats: float = Field(default=0.001, ge=0)
    opacities: float = Field(default=0.05, ge=0, description="Of the logits.")
    sh0: float = Field(default=0.0025, ge=0)
    shN: float = Field(default=0.0025 / 20, ge=0)
    offsets: float = Field(default=0.0, ge=0, description="Of the offsets of an anchor's splats, in units of the anchor's size.")
    features: float = Field(default=0.0075, ge=0, description="Of an anchor's feature vector.")
    networks: float = Field(default=0.0, ge=0, description="Of the networks that all anchors share; a deformation network never changes.")


class AdaptConfig(Settings):
    """How one checkpoint is adapted to one scale."""

    recipe: str = Field(default="default", description="The name of the recipe that these settings started from.")
    steps: int = Field(default=1000, ge=0, description="Maximum number of optimizer steps.")
    most_steps: int | None = Field(default=None, ge=0, description="Maximum number of steps in a time budget that has room for more than `steps`.")
    most_draws: float | None = Field(
        default=None,
        gt=0,
        description="Maximum number of splats that all steps draw; a run that would draw more takes fewer steps, a quarter of them at least.",
    )
    time_budget_s: float | None = Field(default=None, gt=0, description="Stop after this many seconds.")
    target_db: float | None = Field(
        default=None, description="Stop at the first check whose PSNR against the pseudo truth (not photographs) is this high."
    )
    patience: int | None = Field(
        default=None, gt=0, description="Stop at the knee: after this many checks in a row that gained less than `min_gain_db`."
    )
    min_gain_db: float = Field(default=0.05, ge=0, description="Minimum gain in dB between checks, for `patience`.")
    check_every: int = Field(default=50, gt=0, description="Steps between two points of the curve.")
    seed: int = Field(default=0, ge=0, le=MAX_SEED, description="Seed of everything random.")

    band: tuple[Factor, Factor] = Field(
        default=(1.0, 1.0), description="Zoom-out: the file is shown at zooms from the first to the second of these multiples of its scale."
    )
    resize: ResizeFilter = Field(
        default="pil-bicubic",
        description="Filter that shrinks images, such as a protocol's; `fitting`: the one that fits the base's own filter and the pictures' width.",
    )
    upsampler: str = Field(default="bicubic", description="What makes base images larger: a registered name, or the file of a network.")
    compare_at: Literal["target", "base", "both"] = Field(
        default="target", description="Zoom-in: compare with the upsampled base, the base itself, or both."
    )
    detail_weight: float = Field(
        default=0.1, ge=0, description="`both`: weight of the difference from the upsampled base, relative to the difference from the base itself."
    )
    detail_structure: float = Field(
        default=0.0, ge=0, le=1, description="`both`: fraction of the difference from the upsampled base that is one of structure, 1 - SSIM."
    )
    detail_contrast: float = Field(
        default=0.0, ge=0, description="`both`: weight, in the same difference, of how much the strength of local contrasts differs."
    )
    upsampled_views: int = Field(default=50, gt=0, description="`both`: maximum number of views, because each is upsampled.")
    quantize_truth: bool = Field(default=False, description="Round the pseudo truth to 8 bits, as in PNG files.")
    truth_oversampling: int | None = Field(
        default=None, gt=0, description="Render the base at most this many times finer than the target; None: at its full size."
    )

    views: ViewPolicy = Field(default="jittered", description="Which views to adapt to; `jittered`: the train views and random views around them.")
    moments: int | None = Field(
        default=24,
        gt=0,
        description="Moving scenes: maximum number of moments at which views are adapted. None: each view at its own, as always with photographs.",
    )
    extra_views: int = Field(default=100, ge=0, description="Number of views that `jittered` adds, or that an orbit has.")
    farthest: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="A third of the extra views step back, until what is nearest is this much smaller. None: 0.5 at x1 of unbounded scenes, else 1.",
    )

    closed_form: bool = Field(default=True, description="Start from the closed form instead of from the base.")
    crispness: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Zoom-in: from 0 (wider splats) to 1 (thin ones more opaque instead, if they can be); the least tried below x2 without steps.",
    )
    merge_to: float = Field(default=1.0, gt=0, le=1, description="Fraction of the splats to keep when similar splats that share pixels are merged.")
    merging_costs: float = Field(
        default=0.3,
        ge=0,
        description="Maximum loss by merging, in dB on validation views before the first step; at least 0.6, unless 0, for another renderer.",
    )
    most_sh_degree: int = Field(
        default=0, ge=0, le=3, description="Zoom-out: add SH bands up to this degree, as far as merging has made room: no PLY gets larger by it."
    )
    most_splats: int | None = Field(default=None, gt=0, description="Merge to at most this many splats, whatever it costs, in place of `merge_to`.")
    rates: LearningRates = LearningRates()
    loss: Literal["psnr", "l2", "l1"] = Field(
        default="l2", description="Logarithm of the mean square error, mean square error, or mean absolute error."
    )
    decay: float = Field(default=1.0, gt=0, le=1, description="Fraction of itself that every learning rate decays to, along half a cosine.")
    betas: tuple[Momentum, Momentum] = Field(default=(0.9, 0.999), description="Adam's decay rates of the moments.")
    nesterov: bool = Field(default=False, description="Adam with Nesterov's momentum.")
    conversion_steps: int = Field(
        default=0, ge=0, description="Zoom-in for a viewer that draws otherwise than the training did: maximum number of steps at x1 that come first."
    )
    least_zoom_in: float = Field(
        default=1.0, ge=1, description="Zoom-in: no steps are taken below this scale, unless the viewer draws otherwise than the training did."
    )
    views_per_step: int = Field(default=1, gt=0, description="Views whose gradients are summed for one step.")
    order: Literal["shuffled", "spread"] = Field(
        default="shuffled", description="Order of the views in each round; `spread`: consecutive views look from different sides."
    )
    warm_up: float = Field(
        default=0.0, ge=0, le=1, description="Fraction of the steps during which learning rates rise, until validation shows harm."
    )
    gathering: float = Field(default=0.0, ge=0, le=1, description="Fraction of the run during which new views are introduced; each costs a render.")
    validation_views: int = Field(
        default=16, ge=2, description="Maximum number of views for validation: half steer the run, half choose what it returns."
    )
    returns: Literal["best", "last"] = Field(
        default="best", description="Return the best state on validation views, base and start included, or the last."
    )
    prune_every: int = Field(default=100, gt=0, description="Steps between two prunings.")
    min_opacity: float = Field(default=0.005, ge=0, lt=1, description="Splats of lower opacity are pruned.")
    densify_gradient: float | None = Field(
        default=None, gt=0, description="Screen gradient (NDC units) above which splats are cloned or split; None: never."
    )
    densify_keeps_image: bool = Field(
        default=False, description="Split splats in two with little change of the image, instead of the published cloning."
    )
    densify_on_trial: bool = Field(default=False, description="Undo growth that leaves views farther from the base than at the start.")
    most_growth: float | None = Field(default=None, ge=1, description="Maximum ratio of splats after densifying to splats before; None: unlimited.")
    reset_opacity_at: int | None = Field(
        default=None, ge=0, description="Step before which all opacities are cut to 0.01, on a white background only."
    )

    @field_validator("upsampler", mode="before")
    @classmethod
    def _upsampler_is_named(cls, upsampler: Any) -> Any:
        if callable(upsampler):
            raise ValueError("must be the name of an upsampler, which register_upsampler gives to a function")
        return str(upsampler) if isinstance(upsampler, Path) else upsampler

    @field_validator("rates", mode="before")
    @classmethod
    def _rates_are_named(cls, rates: Any) -> Any:
        if isinstance(rates, Mapping) and not all(isinstance(name, str) for name in rates):  # which Python itself refuses as keywords
            raise ValueError(f"must be {WORDS[LearningRates]}")
        return rates

    @field_validator("band")
    @classmethod
    def _band_rises(cls, band: tuple[float, float]) -> tuple[float, float]:
        if band[0] > band[1]:
            raise ValueError("must rise")
        return band

    @property
    def warm_up_steps(self) -> int:
        """The number of steps of the warm-up."""
        return math.ceil(self.warm_up * self.steps)


def _told(kind: type[Settings], error: Any, given: Mapping[str, Any]) -> str:
    """One error of pydantic's in settings that were given, in a sentence."""
    name = str(error["loc"][0])
    if error["type"] == "extra_forbidden":
        if name in OF_THE_BASE:
            return f"{name} is no setting of an adaptation; give it to wrap_model"
        meant = get_close_matches(name, kind.model_fields, 1)
        return f"there is no setting {kind.owner}{name}; {f'did you mean {meant[0]}? ' if meant else ''}mipmap_plugin.config has all of them"
    own = error["ctx"]["error"] if error["type"] == "value_error" else f"must be {allowed(kind.owner + name)}"
    if isinstance(own, SettingsError):  # of settings within these
        return str(own)
    said = repr(given[name])
    return f"setting {kind.owner}{name}: {own}, got {said if len(said) <= LONGEST else type_of(given[name])}"


# What a value of each type is in words.
WORDS: dict[Any, str] = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", LearningRates: "rates by name"}


def allowed(name: str) -> str:
    """What the setting of that name, such as "merge_to" or "rates.means", may be: "a number above 0 and up to 1"."""
    owner, _, within = name.rpartition(".")
    field = (LearningRates if owner else AdaptConfig).model_fields[within]
    return _of_type(field.annotation, field.metadata)


def _of_type(kind: Any, bounds: Sequence[Any]) -> str:
    """In words: values of this type within these bounds, which are pydantic's."""
    first, *others = get_args(kind) or (kind,)
    if get_origin(kind) is UnionType:
        return f"{_of_type(first, bounds)}, or None"
    if get_origin(kind) is Annotated:
        return _of_type(first, others[0].metadata)
    if get_origin(kind) is tuple:
        return f"a pair, each {_of_type(first, bounds)}"
    if get_origin(kind) is Literal:
        return f"{', '.join(map(repr, (first, *others[:-1])))} or {others[-1]!r}"
    return WORDS[kind] + _between({key: getattr(bound, key) for bound in bounds for key in ("gt", "ge", "lt", "le") if hasattr(bound, key)})


def _between(bounds: Mapping[str, float]) -> str:
    """Bounds in words, of which gt and lt are not themselves allowed; there is no upper one without a lower one."""
    most = next((f"{word}{bounds[key]}" for key, word in {"le": "", "lt": "below "}.items() if key in bounds), "")
    if "ge" in bounds:
        return f" from {bounds['ge']} to {most}" if most else f" of at least {bounds['ge']}"
    if "gt" in bounds:
        return f" above {bounds['gt']}" + (f" and {'' if 'lt' in bounds else 'up to '}{most}" if most else "")
    return ""
