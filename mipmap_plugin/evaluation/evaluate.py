"""Evaluation against real images: rows for the base, training-free filters, supersampling and adapted models at each scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from itertools import product
from statistics import fmean
from typing import Any

import torch

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.target.disk_cache import fingerprint
from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError, some_of, unknown, warn
from mipmap_plugin.evaluation.cells import Cells, made_by
from mipmap_plugin.evaluation.judged import not_held_out, photographed_views
from mipmap_plugin.evaluation.measure import (
    FILTERS,
    Baseline,
    RenderView,
    adapt_alone,
    base_in_viewer,
    baselines,
    views_seen,
    warm_stopwatch,
    warm_up,
)  # fmt: skip
from mipmap_plugin.evaluation.metrics import psnr, ssim
from mipmap_plugin.evaluation.other_scene import of_another_scene, of_another_size
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.evaluation.protocols import PROTOCOLS, Protocol, TruthView
from mipmap_plugin.evaluation.shots import Recorder, Shot, Watcher
from mipmap_plugin.process import threads
from mipmap_plugin.progress import Bar
from mipmap_plugin.recipes import most_steps
from mipmap_plugin.recipes import recipe as make_config
from mipmap_plugin.scenes import Scene
from mipmap_plugin.splatting.viewers import viewers_for
from mipmap_plugin.wrap import Wrapped

# In the name of a row that is the worst of several viewers'.
WORST = ", worst of "


@dataclass(frozen=True)
class Row:
    """The mean quality over all test views of one way to render a scene at one scale."""

    name: str
    scale: float
    protocol: str
    psnr_db: float
    ssim: float | None  # None: the image is smaller than SSIM's window
    adapt_seconds: float
    ms_per_view: float
    gaussians: int
    adapted_on: str = "-"  # the views it was adapted to
    lpips: float | None = None  # None: not requested, or the image is too small
    lpips_label: str = ""  # which variant of LPIPS
    scene: str = ""
    ended_by: str = ""  # why an adaptation ended


@dataclass(frozen=True)
class Evaluator:
    """The views of a scene, and the comparison of images with their truth."""

    views: Sequence[TruthView]
    protocol: Protocol
    perceptual: Perceptual | None = None
    scene: str = ""
    watcher: Watcher | None = None  # is shown the first view of each row
    cells: Cells = field(default_factory=Cells)  # rows that an earlier command finished
    notes: Sequence[str] = ()  # of the scene

    def cell(self, key: dict[str, Any], measure: Callable[[Evaluator], Row]) -> Row:
        """The row `key`: measured by an evaluator like this one, or kept from before an interruption, if the truth was the same then."""
        recorder = Recorder(self.watcher)
        key = {**key, "truth": fingerprint(self.views[0].truth(key["scale"], self.protocol))}
        known = self.cells.find(key)
        if known is None:
            row = measure(replace(self, watcher=recorder))
            self.cells.keep(key, {"row": asdict(row), **recorder.taken()})
            return row
        recorder.replay(known, self.views[0].camera)
        return Row(**known["row"])

    @threads.limited(None, shared=True)  # small images take many times as long on torch's threads where the machine is busy
    def row(self, name: str, scale: float, show: RenderView, **facts: Any) -> Row:
        """The mean quality of `show(camera at the base scale)` over the views. PSNRs of views are averaged, as in the literature."""
        psnrs, similarities, distances = [], [], []
        watch = warm_stopwatch(show, self.views[0].camera)
        for view in Bar(self.views, desc=f"{name} x{scale:g}", leave=False):
            with torch.no_grad(), watch:
                image = show(view.camera)
            image, truth = self.protocol.as_saved(image), view.truth(scale, self.protocol).to(image)
            psnrs.append(psnr(image, truth))
            similarities.append(ssim(image, truth))
            with threads.lent_to_torch():  # for a network
                distances.append(self.perceptual(image, truth) if self.perceptual else None)
            if self.watcher and view is self.views[0]:
                self.watcher.shot(Shot(name, self.scene, scale, view.camera, image, truth, psnrs[0], similarities[0], distances[0]))
        label = self.perceptual.label if self.perceptual else ""
        quality = dict(psnr_db=fmean(psnrs), ssim=_mean(similarities), lpips=_mean(distances), lpips_label=label)
        facts = {"adapt_seconds": 0.0, "ms_per_view": 1000 * watch.seconds / len(self.views), **facts}
        return Row(name=name, scale=scale, protocol=self.protocol.name, scene=self.scene, **quality, **facts)  # type: ignore[arg-type]


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean, or None if any value is None."""
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def training_free_rows(
    model: Wrapped, judge: Evaluator, scale: float, upsampler: str = "bicubic", filters: Sequence[str] = FILTERS, viewer: str | None = None
) -> list[Row]:
    """Rows of the base as it is and of all training-free improvements of it (`measure.baselines`).

    `viewer`: adds a row of the base as this viewer renders it.
    """
    found = baselines(model, scale, judge.protocol.shrink_by, filters=filters, upsampler=upsampler)
    in_viewers = [base_in_viewer(name, model, scale) for name in viewers_for(viewer)] if viewer else []
    network = network_input(upsampler)

    def row(each: Baseline) -> Row:
        key = {"row": each.name, "scale": scale} | network
        return judge.cell(key, lambda judge: judge.row(each.name, scale, each.render, gaussians=each.gaussians))

    return [row(baseline) for baseline in found] + worst([row(baseline) for baseline in in_viewers])


def worst(rows: Sequence[Row]) -> list[Row]:
    """The row of lowest PSNR, marked as the worst of several viewers; [] without rows."""
    least = sorted(rows, key=lambda row: row.psnr_db)[:1]
    return [replace(row, name=f"{row.name}{WORST}{len(rows)}") for row in least] if len(rows) > 1 else least


def shown_as(row: Row) -> tuple[str, str]:
    """The name of the row's shot, and what the row is of several, such as "worst of 13"."""
    name, worst_of, count = row.name.partition(WORST)
    return name, f"{worst_of}{count}".removeprefix(", ")


def adapted_row(name: str, adapted: Adapted, judge: Evaluator) -> Row:
    """The row of an adapted model, rendered as the viewer that it is made for does; of several viewers, the worst."""
    report = adapted.report
    facts = dict(adapt_seconds=report.seconds["total"], gaussians=report.gaussians_after, adapted_on=report.views, ended_by=report.ended_by)

    def row(viewer: str) -> Row:
        title = f"{name} in {viewer}" if len(adapted.viewers) > 1 else name
        if judge.watcher:
            judge.watcher.adapted(title, adapted)
        return judge.row(title, report.scale, lambda camera: adapted.render(camera.zoomed(report.scale), viewer=viewer).image, **facts)

    return worst([row(viewer) for viewer in adapted.viewers])[0]


def evaluator_of(model: Wrapped, scene: Scene, protocol: str, perceptual: Perceptual | None = None, cells: Cells | None = None) -> Evaluator:
    """What compares a model with the photographs of its scene; `cells`: where finished rows are kept. Raises SettingsError."""
    if protocol not in (names := [*PROTOCOLS]):
        raise SettingsError(unknown("protocol", str(protocol), names))
    scene = model.place(scene)
    if doubt := of_another_size(model, scene):
        warn(doubt)
    views, notes = photographed_views(model, scene), [*scene.notes, *not_held_out(model, scene)]
    return Evaluator(views, PROTOCOLS[protocol], perceptual, scene.source.name, cells=cells or Cells(), notes=notes)


def all_rows(model: Wrapped, judge: Evaluator, scales: Sequence[float], recipes: Sequence[str], **settings: Any) -> list[Row]:
    """Return all rows: for each scale the training-free ones, then each recipe twice. Raises SettingsError.

    First adapted to the checkpoint's training poses (and around them, if the recipe says so). This row shows what a user gets, who looks at other
    views. It is called "held out" only if none of the evaluated poses was adapted to; otherwise it says how many were. Then "scored": adapted
    to the evaluated views themselves, as the paper does. `settings` are those of `Wrapped.adapt`; a `viewer` adds a row of the base in it, and
    `steps` are a maximum, which a recipe without steps keeps.
    """
    viewer, rows = settings.get("viewer"), []
    model.targets(viewer)  # raise errors of the viewer, the recipes and the settings before any work
    for name, scale in product(recipes or ["default"], scales):  # settings that nothing uses may be misspelled, too
        config_of(name, scale, settings)
    model.refuse_undrawn([view.camera for view in judge.views], min(scales))
    if doubt := of_another_scene(model, judge.views):
        warn(doubt)
    for scale in scales:
        rows += training_free_rows(model, judge, scale, settings.get("upsampler", "bicubic"), viewer=viewer)
        rows += _adapted_rows(model, judge, scale, recipes, settings) if scale != 1 or viewer else []
    return rows


def config_of(name: str, scale: float, settings: dict[str, Any]) -> AdaptConfig:
    """The settings of a recipe with those of `Wrapped.adapt` that belong to it. Raises SettingsError."""
    return make_config(name, scale, **{key: value for key, value in settings.items() if key in AdaptConfig.model_fields})


def _adapted_rows(model: Wrapped, judge: Evaluator, scale: float, recipes: Sequence[str], settings: dict[str, Any]) -> list[Row]:
    """The rows of each recipe, adapted to the training poses and to the evaluated ones."""
    warm = cache(partial(warm_up, model, scale, model.cameras))

    def row(name: str, on: str, judge: Evaluator) -> Row:
        warm()  # before the first that is measured
        own = settings | _views(make_config(name, scale), on, judge.views)
        if most_steps(name, scale, own.get("steps")) is None:
            own.pop("steps", None)
        adapted = adapt_alone(model, scale, recipe=name, **own)
        return adapted_row(f"{name}, {'scored' if on == 'scored' else _unseen(judge.views, adapted)}", adapted, judge)

    made = {name: made_by(config_of(name, scale, settings)) for name in recipes}  # a registered recipe may have been edited since
    each = product(recipes, ("train", "scored"))
    return [judge.cell({"recipe": name, "made": made[name], "on": on, "scale": scale}, partial(row, name, on)) for name, on in each]


def _views(config: AdaptConfig, on: str, judged: Sequence[TruthView]) -> dict[str, Any]:
    if on == "scored":  # as the paper does: the last step, without validation
        return {"views": "given", "cameras": [view.camera for view in judged], "returns": "last"}
    return {} if config.steps and config.views != "given" else {"views": "train"}  # without steps, further views have no effect


def _unseen(judged: Sequence[TruthView], adapted: Adapted) -> str:
    """The part of a row's name that says whether the model was adapted to any of the evaluated views."""
    seen = len(views_seen([view.camera for view in judged], adapted.adapted_to))
    return f"{some_of(seen, len(judged), 'judged view')} adapted to" if seen else "held out"


def means(rows: Sequence[Row]) -> list[Row]:
    """The rows of several scenes averaged as in the papers' tables: one for each scale and name, in their order."""
    groups: dict[tuple[float, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.scale, _in_any_viewer(row)), []).append(row)
    return [_averaged(name, group) for (_, name), group in groups.items()]


def _in_any_viewer(row: Row) -> str:
    """The name of a row; of one that is the worst of several viewers', which differ from scene to scene, without that viewer."""
    name, worst_of = shown_as(row)
    return f"{name.rpartition(' in ')[0]}, {worst_of} viewers" if worst_of else name


def _averaged(name: str, group: Sequence[Row]) -> Row:
    return replace(
        group[0],
        name=name,
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
