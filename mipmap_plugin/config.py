"""Settings: frozen, closed, documented in place. A recipe (`recipes`) is a named set of them."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from mipmap_plugin.limits import MOST_SEED

ResizeFilter = Literal["box", "area", "bilinear", "pil-bicubic", "lanczos"]
ViewPolicy = Literal["given", "train", "test", "orbit", "jittered"]
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

    recipe: str = Field("default", description="The name of the set that these settings started from.")
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
