"""Collects the pictures of a page while models are evaluated (`evaluation.shots.Watcher`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.effects import explain
from mipmap_plugin.evaluation.evaluate import Row, shown_as
from mipmap_plugin.evaluation.measure import BASE
from mipmap_plugin.evaluation.shots import Shot
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.models.base import effects_of
from mipmap_plugin.pages.in_viewers import viewer_pictures, why_not
from mipmap_plugin.pages.record import Picture, Quality, Role, ViewerPictures, Zoom, zoom_name
from mipmap_plugin.wrap import Wrapped

# How rows of the base in a viewer begin (`measure.base_in_viewer`).
IN_VIEWER = f"{BASE} in "

# The recipe that a page tells of first.
DEFAULT = "default"


class Gallery:
    """The first view of each row of one scene, by scale, and what viewers show of one adapted file of each scale."""

    def __init__(self, base: Wrapped, truth: str, recipes: Sequence[str] = ()) -> None:
        """`truth`: what the images are compared with, in a few words. `recipes`: by which the base will be adapted, as far as that is known."""
        self._base, self._truth, self._awaits_default = base, truth, DEFAULT in recipes
        self._shots: dict[float, list[Shot]] = {}
        self._adapted: set[tuple[str, float]] = set()
        self._viewers: dict[float, tuple[str, list[ViewerPictures]]] = {}  # with the row of the adapted file
        self._last: Adapted | None = None
        self.adaptations: list[dict[str, Any]] = []

    def shot(self, shot: Shot) -> None:
        """Keep a row's first view."""
        self._shots.setdefault(shot.scale, []).append(shot)

    def adapted(self, row: str, adapted: Adapted) -> None:
        """Keep an adaptation's report, and draw the first of each scale as viewers do, or of the default recipe if it is to come."""
        scale = adapted.report.scale
        self._adapted.add((row, scale))
        if adapted is self._last:  # the same file in another viewer
            return
        self._last = adapted
        self.adaptations.append({"title": f"{zoom_name(scale)}, {row}", **adapted.report.model_dump()})
        is_told_of = is_default(row) or not self._awaits_default
        if is_told_of and scale not in self._viewers and scale in self._shots and not why_not(self._base):
            seen = self._shots[scale][0]
            self._viewers[scale] = row, viewer_pictures(self._base, adapted, seen.camera.zoomed(scale), seen.truth)

    def restored(self, row: str, report: dict[str, Any]) -> None:
        """Keep the report of an adaptation from before an interruption; its file is no longer there to be drawn as viewers do."""
        self._adapted.add((row, report["scale"]))
        self.adaptations.append({"title": f"{zoom_name(report['scale'])}, {row}", **report})

    def effects(self) -> list[dict[str, Any]]:
        """The effects of the base."""
        return effects_of_base(self._base)

    def own(self, rows: Sequence[Row]) -> list[Row]:
        """The rows of this scene."""
        scenes = {shot.scene for shots in self._shots.values() for shot in shots}
        return [row for row in rows if row.scene in scenes]

    def zooms(self, rows: Sequence[Row], *, named: bool = False) -> list[Zoom]:
        """The pictures of each scale, with the means that `rows` have, by rising scale; `named`: with the scene in their labels."""
        own = self.own(rows)
        return [self._zoom(scale, self._shots[scale], own, named) for scale in sorted(self._shots)]

    def _zoom(self, scale: float, shots: Sequence[Shot], rows: Sequence[Row], named: bool) -> Zoom:
        means = {name: (_quality(row), note) for row in rows if row.scale == scale for name, note in (shown_as(row),)}
        in_viewer = any(shot.row.startswith(IN_VIEWER) for shot in shots)
        pictures = [Picture(shot.row, self._role(shot, in_viewer), shot.image, _quality(shot), *means.get(shot.row, ({},))) for shot in shots]
        pictures.append(Picture("truth", "truth", shots[0].truth, note=self._truth))
        label = f"{shots[0].scene} {zoom_name(scale)}" if named else zoom_name(scale)
        reason = "Nothing was adapted: give --recipe default."
        if any(each == scale for _, each in self._adapted):
            reason = why_not(self._base) or "It was adapted before an interruption, after which viewers' pictures are not drawn again."
        row, viewers = self._viewers.get(scale, ("", ()))
        told = "" if row == "adapted" else row  # of the demo, whose only file it is
        return Zoom(
            label, scale, in_order(pictures), shots[0].camera.name, self._truth, "all judged views", viewers, "" if viewers else reason, told
        )  # fmt: skip

    def _role(self, shot: Shot, in_viewer: bool) -> Role:
        """`in_viewer`: the file was made for a viewer, and is compared with the base in that viewer."""
        if (shot.row, shot.scale) in self._adapted:  # what was adapted to the very views that judge it is a figure for the literature
            return "other" if shot.row.endswith("scored") else "adapted"
        if shot.row.startswith(IN_VIEWER) if in_viewer else shot.row == BASE:
            return "base"
        return "supersampled" if shot.row.startswith("supersampling") else "other"


def _quality(of: Row | Shot) -> Quality:
    return {"psnr_db": of.psnr_db, "ssim": of.ssim, "lpips": of.lpips}


def effects_of_base(base: FrozenBase) -> list[dict[str, Any]]:
    """What drawing the base simulates, and what it does not, with reasons."""
    gaussians = base.model.gaussians(base.any_camera())
    return [asdict(effect) for effect in explain(base.effects(), gaussians, effects_of(base.model))]


def recipe_of(row: str) -> str:
    """The recipe in the name of an adapted row of `evaluate`, such as "default, held out"; "" in that of another."""
    recipe, comma, _ = row.partition(",")
    return recipe if comma else ""


def is_default(row: str) -> bool:
    """Whether an adapted row is that of the default recipe, which a page tells of first, in whatever order recipes were asked for."""
    return recipe_of(row) == DEFAULT


def in_order(pictures: Sequence[Picture]) -> list[Picture]:
    """Sort pictures by role: base, adapted, supersampled, truth, then the rest. Within a role those that have means of a row come first, and among
    these the default recipe.
    """
    order: tuple[Role, ...] = ("base", "adapted", "supersampled", "truth", "other")
    return sorted(pictures, key=lambda picture: (order.index(picture.role), not picture.mean, not is_default(picture.name)))
