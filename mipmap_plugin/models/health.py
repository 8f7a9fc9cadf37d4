"""What is wrong with a checkpoint's splats, counted; nothing is changed unless it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

from torch import Tensor

from mipmap_plugin.models.base import SplatModel

Splats = TypeVar("Splats", bound="HasRows")


class HasRows(Protocol):
    """A model that can be made smaller."""

    notes: list[str]

    def keep_rows(self: Splats, keep: Tensor) -> Splats:
        """A new model of the rows where `keep` [N] is True."""


# Below one 8-bit step no rasterizer of the field draws a splat (diff-gaussian-rasterization, forward.cu).
MIN_VISIBLE = 1 / 255

# An axis shorter than a millionth of the scene is resolved by no image that shows the scene: the splat is a sheet or a needle.
TINY_SHARE = 1e-6

# The scene's size leaves out this share of the splats at either end of each axis, so that a few strays do not set it.
STRAYS = 0.01

# Positions, lengths and colors above it are no scene's, and float32 has no room for the products of several of them that gradients are.
LARGEST = 1e12

# Fewer splats than this say nothing about how a parameter is distributed.
MIN_DISTRIBUTION = 100


@dataclass(frozen=True, eq=False)
class Health:
    """Counts of splats, of N. A splat may be in several."""

    splats: int
    nan: dict[str, int]  # by parameter: rows with a NaN
    infinite: dict[str, int]  # by parameter: rows with an infinity
    zero_quaternions: int  # drawn unrotated
    extent: float  # world units: the longest side of the box around the scene, strays left out
    huge: int  # longest axis above `extent`: one standard deviation covers the whole scene
    tiny: int  # shortest axis below TINY_SHARE · extent
    invisible: int  # opacity below MIN_VISIBLE
    scales_look_linear: bool  # stored scales are log lengths; all positive and mostly below 1, they look like lengths
    opacities_look_activated: bool  # stored opacities are logits; all within 0..1, they look like opacities
    poisonous: Tensor  # [N] bool: activated, not finite or above LARGEST, so that one row may turn a whole image or gradient into NaN

    def sentences(self) -> list[str]:
        """What a person should know; empty for a healthy checkpoint."""
        counts = [
            (int(self.poisonous.sum()), f"are not finite once activated, or above {LARGEST:g}, and would spoil images"),
            (self.zero_quaternions, "have a zero quaternion and are drawn unrotated"),
            (self.huge, f"are longer than the scene ({self.extent:.3g} units)"),
            (self.tiny, f"have an axis below {TINY_SHARE:g} of the scene: sheets or needles"),
            (self.invisible, "have an opacity below 1/255 and are never drawn"),
        ]
        told = [*self.non_finite(), *(f"{count:,} of {self.splats:,} splats {what}" for count, what in counts if count)]
        if self.scales_look_linear:
            told.append("the scales look like lengths, not like their logarithms; if the image is a fog, export the file again with log scales")
        if self.opacities_look_activated:
            told.append("the opacities look like 0..1, not like logits; if the image is too transparent, export the file again with logits")
        return told

    def non_finite(self) -> list[str]:
        """The sentences on NaN and infinity."""
        found = [("a NaN", name, count) for name, count in self.nan.items()] + [("an infinity", name, count) for name, count in self.infinite.items()]
        return [f"{count:,} of {self.splats:,} splats hold {kind} in {name}" for kind, name, count in found if count]


def examine(model: SplatModel) -> Health:
    """Count what is unusual in a model whose parameters are named as gsplat's (means, scales, quats, opacities, sh0, shN)."""
    raw = {name: tensor.detach() for name, tensor in model.parameters().items()}
    scales, opacities = raw["scales"].exp(), raw["opacities"].sigmoid()
    extent = _extent(raw["means"])
    return Health(
        splats=len(scales),
        nan={name: _rows(tensor.isnan()) for name, tensor in raw.items()},
        infinite={name: _rows(tensor.isinf()) for name, tensor in raw.items()},
        zero_quaternions=int((raw["quats"] == 0).all(1).sum()),
        extent=extent,
        huge=_rows(scales > extent) if extent > 0 else 0,
        tiny=_rows(scales < TINY_SHARE * extent),
        invisible=_rows(opacities < MIN_VISIBLE),
        scales_look_linear=_look_linear(raw["scales"]),
        opacities_look_activated=_look_activated(raw["opacities"]),
        poisonous=_poisonous(raw, scales, opacities),
    )


def drop(model: Splats, mask: Tensor) -> Splats:
    """A new model without the rows where `mask` [N] is True, with a note of how many they were."""
    kept = model.keep_rows(~mask)
    kept.notes.append(f"{int(mask.sum()):,} of {len(mask):,} splats were dropped")
    return kept


def _poisonous(raw: dict[str, Tensor], scales: Tensor, opacities: Tensor) -> Tensor:
    """Legal extremes stay: a logit of infinity is opacity 1, a log scale of -infinity is length 0, a quaternion may have any length."""
    sound = raw["quats"].isfinite().all(1) & opacities.isfinite()
    for values in (raw["means"], scales, raw["sh0"], raw["shN"]):
        sound &= (values.abs() <= LARGEST).flatten(1).all(1)  # not so for NaN
    return ~sound


def _rows(marked: Tensor) -> int:
    return int(marked.flatten(1).any(1).sum()) if marked.dim() > 1 else int(marked.sum())


def _extent(means: Tensor) -> float:
    means = means[means.isfinite().all(1)]
    if len(means) < 2:
        return 0.0
    low = max(1, round(STRAYS * len(means)))
    sides = means.kthvalue(len(means) + 1 - low, dim=0).values - means.kthvalue(low, dim=0).values
    return float(sides.max())


def _look_linear(scales: Tensor) -> bool:
    return len(scales) >= MIN_DISTRIBUTION and bool((scales > 0).all()) and float(scales.median()) < 1


def _look_activated(opacities: Tensor) -> bool:
    return len(opacities) >= MIN_DISTRIBUTION and bool(((opacities >= 0) & (opacities <= 1)).all())
