"""Rows of a table: base, training-free filters, supersampling and adapted models, against real images at one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from statistics import fmean
from typing import Any

import torch
from tqdm import tqdm

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.measure import FILTERS, Show, base_in, rivals, seen_before, warm_up, warm_watch
from mipmap_plugin.evaluation.metrics import psnr, ssim
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.evaluation.protocols import PROTOCOLS, Judged, Protocol, TestView, not_exposed, test_views
from mipmap_plugin.models.base import SplatModel, effects_of
from mipmap_plugin.recipes import recipe as make_config
from mipmap_plugin.scenes import Scene
from mipmap_plugin.splatting.viewers import viewers_for
from mipmap_plugin.wrap import Adapted, Wrapped


@dataclass(frozen=True)
class Row:
    """One way to show a scene at one scale, judged on all test views."""

    name: str
    scale: float
    protocol: str
    psnr_db: float
    ssim: float | None  # None: the image is smaller than SSIM's window
    adapt_seconds: float
    ms_per_view: float
    gaussians: int
    adapted_on: str = "-"  # what it was adapted on
    lpips: float | None = None  # None: not asked for, or the image is too small
    lpips_label: str = ""  # which LPIPS
    scene: str = ""
    ended_by: str = ""  # of an adaptation


@dataclass(frozen=True)
class Judge:
    """The views of a scene, and how an image of them is compared with the truth."""

    views: Sequence[Judged]
    protocol: Protocol
    perceptual: Perceptual | None = None
    scene: str = ""

    def row(self, name: str, scale: float, show: Show, **facts: Any) -> Row:
        """The mean quality of `show(camera at the base scale)` over the views. PSNR per view, then the mean, as the literature does."""
        decibels, similarities, distances = [], [], []
        watch = warm_watch(show, self.views[0].camera)
        for view in tqdm(self.views, disable=None, desc=f"{name} x{scale:g}", leave=False):
            with torch.no_grad(), watch:
                image = show(view.camera)
            image, truth = self.protocol.judged(image), view.truth(scale, self.protocol).to(image)
            decibels.append(psnr(image, truth))
            similarities.append(ssim(image, truth))
            distances.append(self.perceptual(image, truth) if self.perceptual else None)
        label = self.perceptual.label if self.perceptual else ""
        quality = dict(psnr_db=fmean(decibels), ssim=_mean(similarities), lpips=_mean(distances), lpips_label=label)
        facts = {"adapt_seconds": 0.0, "ms_per_view": 1000 * watch.seconds / len(self.views), **facts}
        return Row(name=name, scale=scale, protocol=self.protocol.name, scene=self.scene, **quality, **facts)  # type: ignore[arg-type]


def _mean(values: Sequence[float | None]) -> float | None:
    """None where one of them is not known."""
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def training_free_rows(
    model: Wrapped, judge: Judge, scale: float, upsampler: str = "bicubic", without: Sequence[str] = (), viewer: str | None = None
) -> list[Row]:
    """The base as it is, and everything that shows it better without adapting (`measure.rivals`).

    `without`: filters that are left out. `viewer`: whose picture of the base has a row too.
    """
    count = len(model.model.gaussians(model.any_camera()))
    filters = [name for name in FILTERS if name not in without]
    found = rivals(model, scale, judge.protocol.shrink_by, filters=filters, upsampler=upsampler)
    rows = [judge.row(rival.name, scale, rival.show, gaussians=count) for rival in found]
    shown = [base_in(name, model, scale) for name in viewers_for(viewer)] if viewer else []
    return rows + worst([judge.row(rival.name, scale, rival.show, gaussians=count) for rival in shown])


def worst(rows: Sequence[Row]) -> list[Row]:
    """Of rows of several viewers the one of least PSNR, which says so; no row without rows."""
    least = sorted(rows, key=lambda row: row.psnr_db)[:1]
    return [replace(row, name=f"{row.name}, worst of {len(rows)}") for row in least] if len(rows) > 1 else least


def notes(model: Wrapped, scales: Sequence[float], appearance: str = "mean") -> list[str]:
    """What the rows of these scales do not have, in sentences; and which `appearance` test views have."""
    missing = {name: model.lacks(name) for name in FILTERS if any(scale != 1 for scale in scales)}
    told = [f"there is no row {name!r}, since {why}" for name, why in missing.items() if why]
    return told + not_exposed(model.model) + _of_appearance(model.model, appearance)


def _of_appearance(model: SplatModel, appearance: str) -> list[str]:
    """By which appearance test views were drawn, in a sentence, where the model has any; `appearance`: "mean" or "upstream"."""
    if not any(effect.name == "appearance embedding" and effect.on for effect in effects_of(model)):
        return []
    if appearance == "upstream":
        return ["test views have the appearance of the training view with the same number, as in the original, whatever that view looked like"]
    return ["test views have the mean appearance of all training views; the original has that of the same number (--appearance upstream)"]


def adapted_row(name: str, adapted: Adapted, judge: Judge) -> Row:
    """An adapted model, rendered as the viewer that it was made for renders its file; of several as the one that shows it worst."""
    report = adapted.report
    facts = dict(adapt_seconds=report.seconds["total"], gaussians=report.gaussians_after, adapted_on=report.views, ended_by=report.ended_by)
    names = {each: f"{name} in {each}" if len(adapted.viewers) > 1 else name for each in adapted.viewers}
    shows = {each: lambda camera, each=each: adapted.render(camera.zoomed(report.scale), viewer=each).image for each in names}
    return worst([judge.row(names[each], report.scale, show, **facts) for each, show in shows.items()])[0]


def evaluate(
    model: Wrapped,
    scene: Scene,
    scales: Sequence[float],
    recipes: Sequence[str],
    protocol: str,
    perceptual: Perceptual | None = None,
    **settings: Any,
) -> list[Row]:
    """All rows: for each scale the training-free ones, then each recipe twice. Raises SettingsError.

    Once on the checkpoint's training poses, and around them if the recipe says so; the honest row, for a user zooms to views that nobody adapted
    to. It is called "held out" only if none of the judged poses was among them, else it says how many were. And once "scored": adapted on the very
    views that are judged, as the paper does. `settings` are those of `Wrapped.adapt`; with a `viewer` its picture of the base has a row too.
    """
    scene = model.place(scene)
    if not model.cameras:
        raise SettingsError("the checkpoint has no cameras, so its base scale is not known; give its model folder")
    judged = test_views(scene, model.cameras[0], model.background)
    judge = Judge(judged, PROTOCOLS[protocol], perceptual, scene.source.name)
    viewer, rows = settings.get("viewer"), []
    model.targets(viewer)  # what cannot be adapted for it, or with a recipe, is refused before anything is drawn
    for name, each in product(recipes, scales):
        make_config(name, each)
    for scale in scales:
        rows += training_free_rows(model, judge, scale, settings.get("upsampler", "bicubic"), viewer=viewer)
        if recipes and (scale != 1 or viewer):
            warm_up(model, scale, model.cameras)
        for name, on in product(recipes if scale != 1 or viewer else [], ("train", "scored")):
            adapted = model.adapt(scale, recipe=name, **(settings | _views(make_config(name, scale), on, judged)))
            rows.append(adapted_row(f"{name}, {'scored' if on == 'scored' else _unseen(judged, adapted)}", adapted, judge))
    return rows


def _views(config: AdaptConfig, on: str, judged: Sequence[TestView]) -> dict[str, Any]:
    if on == "scored":  # as the paper does, to the last step: what other views show of it does not count
        return {"views": "given", "cameras": [view.camera for view in judged], "returns": "last"}
    return {} if config.steps and config.views != "given" else {"views": "train"}  # without steps, further views say nothing


def _unseen(judged: Sequence[TestView], adapted: Adapted) -> str:
    """Whether the judged views are new to an adapted model, as its row says it."""
    seen = len(seen_before([view.camera for view in judged], adapted.views))
    return f"{seen} of {len(judged)} judged views adapted to" if seen else "held out"


def means(rows: Sequence[Row]) -> list[Row]:
    """The rows of several scenes, averaged over them as the papers' tables are: one for each scale and way, in their order."""
    groups: dict[tuple[float, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.scale, row.name), []).append(row)
    return [_averaged(group) for group in groups.values()]


def _averaged(group: Sequence[Row]) -> Row:
    return replace(
        group[0],
        scene=f"mean of {len(group)}",
        adapted_on=group[0].adapted_on if len({row.adapted_on for row in group}) == 1 else "each scene's own",
        ended_by="; ".join(dict.fromkeys(row.ended_by for row in group if row.ended_by)),
        psnr_db=fmean(row.psnr_db for row in group),
        ssim=_mean([row.ssim for row in group]),
        lpips=_mean([row.lpips for row in group]),
        adapt_seconds=fmean(row.adapt_seconds for row in group),
        ms_per_view=fmean(row.ms_per_view for row in group),
        gaussians=round(fmean(row.gaussians for row in group)),
    )
