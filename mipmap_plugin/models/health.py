"""Counts of unusual or invalid splats in a checkpoint; nothing is changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, some_of, warn
from mipmap_plugin.models.base import OF_3DGS, SplatModel

# Below one 8-bit step no 3DGS rasterizer draws a splat (diff-gaussian-rasterization, forward.cu).
MIN_VISIBLE = 1 / 255

# Trainings reset opacities to 0.01 every few thousand steps (INRIA's, gsplat's): a scene that is saved right after that is hardly visible.
FAINT = 0.02

# No image of the whole scene resolves an axis shorter than this fraction of it: the splat is a sheet or a needle.
TINY_SHARE = 1e-6

# Fraction of the splats at either end of each axis that the scene's extent leaves out, so that a few outliers do not determine it.
STRAYS = 0.01

# No scene has larger positions, lengths or colors, and products of several of them, as in gradients, overflow float32.
LARGEST = 1e12

# Rows that are examined together, so that there is no second copy of all.
CHUNK = 1 << 17

# Steps of float32 at a splat's place, as a fraction of its longest standard deviation, above which rounding moves it visibly; and the fraction of
# such splats that is worth a word: floaters lie anywhere.
COARSE_STEP, COARSE_SHARE = 0.5, 0.1

# The word in notes on rows that are left out.
DROPPED = "dropped"

# A file of which this fraction of the splats or more would be left out is no scene. A training or an export that failed in places leaves most of
# them; of real files that are read in the wrong byte order, 0.03 % (SH degree 3) to 10 % (degree 0) are finite, by chance, and lie anywhere.
MOST_DROPPED = 0.8

# What is said of splats whose places float32 does not hold.
ROUNDED = "so far from the origin that float32 rounds their positions"

# What is said of splats whose stored values look like those of another convention.
LINEAR = "the scales look like lengths, not like their logarithms; if the image is a fog, export the file again with log scales"
ACTIVATED = "the opacities look like 0..1, not like logits; if the image is too transparent, export the file again with logits"

# With fewer splats than this, the distribution of a parameter is not judged.
MIN_DISTRIBUTION = 100


@dataclass(frozen=True, eq=False)
class Health:
    """Counts among N splats. A splat may be in several."""

    splats: int
    nan: dict[str, int]  # by parameter: rows with a NaN
    infinite: dict[str, int]  # by parameter: rows with an infinity
    zero_quaternions: int  # drawn unrotated
    extent: float  # world units: the longest side of the box around the scene, outliers left out
    huge: int  # longest axis above `extent`: one standard deviation covers the whole scene
    tiny: int  # shortest axis below TINY_SHARE · extent
    invisible: int  # opacity below MIN_VISIBLE
    faint: bool  # all opacities are below FAINT, some not below MIN_VISIBLE; so may be those of a file that was adapted to x1/64
    sizeless: int  # longest axis below TINY_SHARE · extent
    unseen: int  # invisible or sizeless
    rounded: int  # steps between the numbers that hold its place are above COARSE_STEP of its size, and seen in an image of the whole scene
    step: float  # world units: the median of these steps, of the `rounded` splats; 0 without any
    scales_look_linear: bool  # stored scales should be log lengths, but all are positive and most below 1, as lengths are
    opacities_look_activated: bool  # stored opacities should be logits, but all lie within 0..1, as opacities do
    invalid: Tensor  # [N] bool: not finite or above LARGEST once activated; one such row may turn a whole image or gradient into NaN

    def sentences(self) -> list[str]:
        """Remarks for the user; empty for a healthy checkpoint."""
        counts = [
            (int(self.invalid.sum()), f"are not finite once activated, or above {LARGEST:g}, and would spoil images"),
            (self.zero_quaternions, "have a zero quaternion: drawn unrotated"),
            (self.huge, f"are longer than the scene ({units(self.extent, 3)} units)"),
            (self.tiny, f"have an axis below {TINY_SHARE:g} of the scene: sheets or needles"),
            (self.sizeless, "have no size: drawn as a dot where splats are dilated without compensation, and nowhere else"),
            (self.invisible, "have an opacity below 1/255: never drawn"),
            (self.splats * self.faint, "have an opacity below 2 %, as right after training resets them; give a later checkpoint if it is faint"),
        ]
        remarks = [some_of(count, self.splats, "splat", what) for count, what in counts if count]
        return [*_non_finite(self.splats, self.nan, self.infinite), *remarks, *self.doubts()]

    def spoilt(self) -> bool:
        """Whether some splats spoil images, none is drawn, places are lost, or stored values look like those of another convention."""
        return bool(self.invalid.any()) or 0 < self.splats == self.invisible or bool(self.doubts())

    def mostly_unseen(self) -> str:
        """That most splats show nothing, in a clause; "" if most do."""
        if 2 * self.unseen <= self.splats:
            return ""
        return f"{self.unseen / self.splats:.0%} of its splats show nothing, for their opacity is below 1/255 or their size is 0"

    def doubts(self) -> list[str]:
        """That places are lost, or that stored values look like those of another convention, in sentences."""
        return doubts(self.splats, self.rounded, self.step, self.scales_look_linear, self.opacities_look_activated)


def doubts(splats: int, rounded: int, step: float, linear: bool, activated: bool) -> list[str]:
    """`Health.doubts`, of what it counts."""
    why = f"lie {ROUNDED} to steps of {step:.2g} units, which is much for their size"
    lost = f"{some_of(rounded, splats, 'splat', why)}; export the scene again, moved near the origin together with its cameras"
    found = {lost: rounded > COARSE_SHARE * splats, LINEAR: linear, ACTIVATED: activated}
    return [sentence for sentence, doubtful in found.items() if doubtful]


def _non_finite(splats: int, nan: Mapping[str, int], infinite: Mapping[str, int]) -> list[str]:
    """The sentences on NaN and infinity: so many of the `splats`, by parameter."""
    found = {"a NaN": nan, "an infinity": infinite}
    counts = [(kind, name, count) for kind, by_name in found.items() for name, count in by_name.items() if count]
    return [some_of(count, splats, "splat", f"hold {kind} in {name}") for kind, name, count in counts]


def units(length: float, digits: int) -> str:
    """A length as people write it: so many digits, but large lengths whole, and without a power of ten."""
    return f"{length:.{digits}g}" if length < 10**digits - 0.5 else f"{length:,.0f}"


def holds_splats(model: SplatModel) -> bool:
    """Whether the rows of a model's parameters are splats, which `examine` counts; those of anchors, for one, are not."""
    return set(OF_3DGS) <= model.parameters().keys()


def examine(model: SplatModel) -> Health:
    """Examine a model whose parameters have gsplat's names (means, scales, quats, opacities, sh0, shN)."""
    raw = {name: tensor.detach() for name, tensor in model.parameters().items()}
    scales, opacities = raw["scales"].exp(), raw["opacities"].sigmoid()
    extent = extent_of(raw["means"])
    steps = _coarse_steps(raw["means"], scales, extent)
    thin = scales < TINY_SHARE * extent
    sizeless, invisible = thin.all(1), opacities < MIN_VISIBLE
    if thin.all(0).sum() == 1:  # surfels, which have no third axis
        thin = thin[:, ~thin.all(0)]
    return Health(
        splats=len(scales),
        nan={name: rows_where(torch.isnan, tensor) for name, tensor in raw.items()},
        infinite={name: rows_where(torch.isinf, tensor) for name, tensor in raw.items()},
        zero_quaternions=int((raw["quats"] == 0).all(1).sum()),
        extent=extent,
        huge=_rows(scales > extent) if extent > 0 else 0,
        tiny=_rows(thin),
        invisible=_rows(invisible),
        faint=bool((opacities < FAINT).all()) and not invisible.all(),
        sizeless=_rows(sizeless),
        unseen=_rows(invisible | sizeless),
        rounded=len(steps),
        step=float(steps.median()) if len(steps) else 0.0,
        scales_look_linear=_look_linear(raw["scales"]),
        opacities_look_activated=_look_activated(raw["opacities"]),
        invalid=_invalid(raw, scales, opacities),
    )


def why_invalid(model: SplatModel, invalid: Tensor) -> list[str]:
    """What is wrong with the rows where `invalid` [N] is True, in sentences; what other rows hold, or what these may hold, is not told."""
    rows = {name: tensor.detach()[invalid] for name, tensor in model.parameters().items()}
    nan = {name: _each_row(tensor.isnan()) for name, tensor in rows.items()}
    # An opacity of 0 or 1 and a length of 0 are stored as infinities.
    infinite = {name: _each_row(tensor == math.inf if name == "scales" else tensor.isinf()) for name, tensor in rows.items() if name != "opacities"}
    told = torch.stack([*nan.values(), *infinite.values()]).any(0)
    sentences = _non_finite(len(invalid), *({name: _rows(each) for name, each in found.items()} for found in (nan, infinite)))
    return sentences + ([some_of(n, len(invalid), "splat", f"are above {LARGEST:g} once activated")] if (n := _rows(~told)) else [])


def refuse_few(invalid: Tensor, source: Path | str | None) -> None:
    """Raise CheckpointError if the splats that are not `invalid` [N] are too few to be a scene. `source`: where they come from."""
    count, lost = len(invalid), int(invalid.sum())
    if count and lost >= MOST_DROPPED * count:
        left = count - lost
        few = "only " * bool(left) + some_of(left, count, "splat", "are")
        order = "its header may name the wrong byte order, or " if str(source).lower().endswith(".ply") else ""
        why = f"{order}the training or the export failed; export it again"
        raise CheckpointError(f"{source or 'this model'}: {few} finite once activated, and below {LARGEST:g}; {why}")


def doubts_in(notes: Iterable[str]) -> list[str]:
    """Which of a model's notes are doubts about the splats of its file: those of `Health.doubts`, and on splats that were left out."""
    return [note for note in notes if note in (LINEAR, ACTIVATED) or DROPPED in note or ROUNDED in note]


def dropped(mask: Tensor, row: str, why: str, source: Path | str | None) -> str:
    """The note that each `row` where `mask` [N] is True is left out, which is also a warning: what is drawn is not all of the file."""
    note = f"{some_of(int(mask.sum()), len(mask), row, 'were')} {DROPPED}: {why}"
    warn(f"{source or 'this model'}: {note}")
    return note


def _invalid(raw: dict[str, Tensor], scales: Tensor, opacities: Tensor) -> Tensor:
    """Which splats are invalid, [N] bool. Valid are a logit of infinity (opacity 1), a log scale of -infinity (length 0), any quaternion norm."""
    valid = raw["quats"].isfinite().all(1) & opacities.isfinite()
    for values in (raw["means"], scales, raw["sh0"], raw["shN"]):
        for rows, part in zip(valid.split(CHUNK), values.split(CHUNK), strict=True):
            rows &= (part.abs() <= LARGEST).flatten(1).all(1)  # False for NaN
    return ~valid


def rows_where(test: Callable[[Tensor], Tensor], values: Tensor) -> int:
    """The number of rows with a value for which `test` is True."""
    return sum(_rows(test(part)) for part in values.split(CHUNK))


def _each_row(marked: Tensor) -> Tensor:
    """Which rows hold a True, [N] bool."""
    return marked.flatten(1).any(1) if marked.dim() > 1 else marked


def _rows(marked: Tensor) -> int:
    return int(_each_row(marked).sum())


def _coarse_steps(means: Tensor, scales: Tensor, extent: float) -> Tensor:
    """The steps between the numbers that hold the places of splats [M], world units, where they are too large (`Health.rounded`)."""
    farthest = means.abs().amax(1)
    steps = torch.finfo(means.dtype).eps * torch.ldexp(torch.ones_like(farthest), torch.frexp(farthest).exponent - 1)
    return steps[farthest.isfinite() & (steps > COARSE_STEP * scales.amax(1)) & (steps > TINY_SHARE * extent)]


def extent_of(means: Tensor) -> float:
    """World units: the longest side of the box around the scene, outliers left out; 0 for fewer than two finite splats. `means`: [N, 3]."""
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
