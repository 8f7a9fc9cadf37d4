"""Rows of a table: base, training-free filters, supersampling and adapted models, against real images at one scale."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import fmean
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.camera import Camera
from mipmap_plugin.config import Recipe
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.metrics import psnr, ssim
from mipmap_plugin.evaluation.protocols import PROTOCOLS, Judged, Protocol, TestView, resized_base, test_views
from mipmap_plugin.scenes import Scene
from mipmap_plugin.wrap import Adapted, Wrapped


@dataclass(frozen=True)
class Row:
    """One way to show a scene at one scale, judged on all test views."""

    name: str
    scale: float
    psnr_db: float
    ssim: float | None  # None: the image is smaller than SSIM's window
    adapt_seconds: float
    ms_per_view: float
    gaussians: int
    adapted_on: str = "-"  # what it was adapted on


def judge(name: str, show: Callable[[Camera], Tensor], views: Sequence[Judged], scale: float, protocol: Protocol, **facts) -> Row:
    """The mean quality of `show(camera at the base scale)` over the views. PSNR per view, then the mean, as the literature does."""
    decibels, similarities, seconds = [], [], []
    for view in tqdm(views, disable=None, desc=f"{name} x{scale:g}", leave=False):
        began = time.perf_counter()
        with torch.no_grad():
            image = show(view.camera)
        seconds.append(time.perf_counter() - began)
        truth = view.truth(scale, protocol).to(image)
        decibels.append(psnr(image, truth))
        similarities.append(ssim(image, truth))
    known = [value for value in similarities if value is not None]
    similarity = fmean(known) if len(known) == len(views) else None
    return Row(name, scale, fmean(decibels), similarity, facts.pop("adapt_seconds", 0.0), 1000 * fmean(seconds), **facts)


def training_free_rows(model: Wrapped, views: Sequence[Judged], scale: float, protocol: Protocol) -> list[Row]:
    """The base as it is, each screen filter that needs no training, and the base's own render resized (for zoom-out, supersampling)."""
    count = len(model.model.gaussians(model.any_camera()))

    def filtered(screen_filter: str | None) -> Callable[[Camera], Tensor]:
        return lambda camera: model.render(camera.zoomed(scale), scale, screen_filter).image

    def resized(camera: Camera) -> Tensor:
        return resized_base(model.render(camera).image.clamp(0, 1), camera.zoomed(scale).size)

    shows = {"naive": filtered(None), "scaled": filtered("scaled"), "antialiased": filtered("antialiased"), "resized base": resized}
    if scale == 1:
        shows = {"base": filtered(None)}
    return [judge(name, show, views, scale, protocol, gaussians=count) for name, show in shows.items()]


def adapted_row(name: str, adapted: Adapted, views: Sequence[Judged], protocol: Protocol) -> Row:
    """An adapted model, rendered as any classic viewer renders its file."""
    report = adapted.report
    facts = dict(adapt_seconds=report.seconds["total"], gaussians=report.gaussians_after, adapted_on=report.views)
    return judge(name, lambda camera: adapted.render(camera.zoomed(report.scale)).image, views, report.scale, protocol, **facts)


def evaluate(model: Wrapped, scene: Scene, scales: Sequence[float], recipes: Sequence[Recipe], protocol: str, **settings: Any) -> list[Row]:
    """All rows: for each scale the training-free ones, then each recipe twice. Raises SettingsError.

    "held out": adapted on the checkpoint's training poses, and around them if the recipe says so; the honest row, for a user
    zooms to views that nobody adapted to. "scored": adapted on the very views that are judged, as the paper does.
    """
    scene = model.place(scene)
    if not model.cameras:
        raise SettingsError("the checkpoint has no cameras, so its base scale is not known; give its model folder")
    judged = test_views(scene, model.cameras[0], model.background)
    rows = []
    for scale in scales:
        rows += training_free_rows(model, judged, scale, PROTOCOLS[protocol])
        for name, on in product(recipes if scale != 1 else [], ("held out", "scored")):
            adapted = model.adapt(scale, recipe=name, **(settings | _views(name, on, judged)))
            rows.append(adapted_row(f"{name}, {on}", adapted, judged, PROTOCOLS[protocol]))
    return rows


def _views(name: Recipe, on: str, judged: Sequence[TestView]) -> dict[str, Any]:
    if on == "scored":
        return {"views": "given", "cameras": [view.camera for view in judged]}
    return {} if name == "default" else {"views": "train"}
