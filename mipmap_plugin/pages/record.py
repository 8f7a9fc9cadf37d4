"""What a report page shows, as data. Every command that writes a page fills one `Page`; `html.write_page` writes it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Literal

from torch import Tensor

from mipmap_plugin.formats.images import data_uri

Role = Literal["base", "adapted", "supersampled", "truth", "other"]

# What a picture may be judged by: psnr_db, ssim, lpips. None: not measured.
Quality = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Picture:
    """One image of one view, and its quality."""

    name: str
    role: Role
    image: Tensor  # [h, w, 3]
    view: Quality = field(default_factory=dict)  # of this image
    mean: Quality = field(default_factory=dict)  # of all judged views, as the command's JSON has it
    note: str = ""

    def facts(self, side: int) -> dict[str, Any]:
        """As JSON, the middle of the image as a PNG of at most `side` x `side` px."""
        return {
            "name": self.name, "role": self.role, "view": self.view, "mean": self.mean, "note": self.note, "src": data_uri(self.image, side)
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class ViewerPictures:
    """One viewer's picture of the base, and of the adapted file."""

    name: str
    title: str
    base: Picture
    adapted: Picture
    made_for: bool  # whether the adapted file was made for this viewer


@dataclass(frozen=True, eq=False)
class Zoom:
    """The pictures of one zoom, all of the same view and size, in the order in which they are offered."""

    label: str
    scale: float
    pictures: Sequence[Picture]
    view: str = ""  # which view this is
    truth: str = ""  # what dB are measured against
    mean_of: str = ""  # what `Picture.mean` is the mean of
    viewers: Sequence[ViewerPictures] = ()
    no_viewers: str = ""  # why there are no pictures of viewers
    in_viewers: str = ""  # what the adapted file in `viewers` is called: its row or its recipe

    def facts(self, side: int) -> dict[str, Any]:
        """As JSON, with the middle of each image, at most `side` px wide and high."""
        height, width = self.pictures[0].image.shape[:2]
        viewers = [
            {"name": each.name, "title": each.title, "made_for": each.made_for, "base": each.base.facts(side), "adapted": each.adapted.facts(side)}
            for each in self.viewers
        ]
        return {
            "label": self.label, "scale": self.scale, "view": self.view, "truth": self.truth, "mean_of": self.mean_of, "size": [width, height],
            "shown": [min(width, side), min(height, side)], "pictures": [picture.facts(side) for picture in self.pictures], "viewers": viewers,
            "no_viewers": self.no_viewers, "in_viewers": self.in_viewers,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Page:
    """A report page."""

    title: str
    lead: str  # what came out, in a sentence or two
    commands: Sequence[str]  # that make it again
    zooms: Sequence[Zoom] = ()
    rows: Sequence[dict[str, Any]] = ()  # of a table, as the command's JSON has them
    adaptations: Sequence[dict[str, Any]] = ()  # reports (`adaptation.report`), each with a "title"
    tradeoffs: Sequence[dict[str, Any]] = ()  # scales of a tradeoff.json
    ladder: dict[str, Any] | None = None  # a levels.json
    effects: Sequence[dict[str, Any]] = ()
    provenance: dict[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()

    def facts(self, side: int) -> dict[str, Any]:
        """As JSON, with the middle of each image, at most `side` px wide and high."""
        return vars(self) | {"zooms": [zoom.facts(side) for zoom in self.zooms]}


def zoom_name(scale: float) -> str:
    """A scale as people write it: ×1/4, ×4, ×0.3."""
    fraction = Fraction(scale).limit_denominator(64)
    return f"×{fraction}" if math.isclose(float(fraction), scale, rel_tol=1e-9) and min(fraction.as_integer_ratio()) == 1 else f"×{scale:g}"
