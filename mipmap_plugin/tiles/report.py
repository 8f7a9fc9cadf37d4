"""A scene that was adapted in tiles, judged on views that nothing was adapted to, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.curve import CurvePoint
from mipmap_plugin.adaptation.optimization.amount import fewer_note
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.validation import Quality, last_of_best
from mipmap_plugin.adaptation.report import AS_IT_IS, Report, filters, simulated
from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.adaptation.worse import better_as_trained, worse_views
from mipmap_plugin.errors import plural, warn
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models.columns import in_short
from mipmap_plugin.models.loaders import unread
from mipmap_plugin.process.versions import versions
from mipmap_plugin.tiles.folder import START
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.start import errors_of
from mipmap_plugin.tiles.steering import Steered, open_state, result
from mipmap_plugin.tiles.truth import Truths

JOINED = "the joined tiles"


@dataclass(frozen=True)
class Judgment:
    """How good each state of the whole is on views that nothing was adapted to."""

    validation: dict[str, float]  # dB
    returned: str  # the name of the best, or of the last where the settings say so
    notes: list[str]  # what there is to say of splats and views, in sentences
    as_trained: float | None = None  # dB of the base as its training drew it; None at x1, and where the target draws so too


def judged(scene: TiledScene) -> Judgment:
    """Compare the base, the start and the result on whole views."""
    views, start = scene.views.choosing, load_torch(scene.folder / START)
    if not views:
        return Judgment({}, JOINED, start["notes"])
    truths = Truths(scene)
    first, last = (open_state(scene, state) for state in (Steered.before(scene.folder, 0), result(scene.folder)))
    states = {AS_IT_IS: scene.base, f"the start, {start['name']}": first, JOINED: last}
    errors = {name: errors_of(scene, splats, truths, views) for name, splats in states.items()}
    found = {name: Quality.of([each]) for name, each in errors.items()}
    validation = {name: each.psnr for name, each in found.items()}
    as_trained = None
    if scene.scale != 1 and scene.base_effects != scene.target:
        as_trained = Quality.of([errors_of(scene, scene.base, truths, views, scene.base_effects)]).psnr
    best, worse = JOINED, list[str]()
    if scene.config.returns == "best":
        best = last_of_best({name: each.visible for name, each in found.items()}, AS_IT_IS)
        before, after = ([Quality.of([[error]]).visible for error in errors[name]] for name in (AS_IT_IS, best))
        worse = worse_views(views, before, after, scene.scale, scene.base.places[:, :3], orbit=not scene.wrapped.cameras)
    better = better_as_trained(as_trained, validation[best], scene.base_effects)
    return Judgment(validation, best, [*start["notes"], *worse, *better], as_trained)


def make_report(
    scene: TiledScene,
    files: Sequence[Path],
    tiles: Sequence[Mapping[str, Any]],
    seconds: dict[str, float],
    judgment: Judgment,
) -> Report:
    """The report of the whole. `files`: what it is made of; `tiles`: what there is to say of each in each sweep."""
    after = sum(read_header(file).vertex.count for file in files)
    model, config = scene.wrapped.model, scene.config
    steps = max((tile["step"] for tile in tiles), default=0)
    lost = [f"the extra columns {in_short(scene.extras)} are dropped, since tiles hold none"] if scene.extras else []
    lost += [sentence for sentence in [unread(scene.viewer, model, files[0])] if sentence]
    for note in [*judgment.notes, *lost]:
        warn(note)
    db = judgment.validation.get(judgment.returned, 0.0)
    return Report(
        scale=scene.scale,
        base=scene.digest,
        inputs=scene.wrapped.asked | network_input(config.upsampler),
        cameras_from=scene.wrapped.cameras_from,
        orbit=scene.viewpoints.orbit,
        settings=config,
        backend=scene.backend_note,
        views=f"{scene.views.note}, in {plural(len(files), 'tile')}",
        viewer=scene.viewer,
        filters=filters(scene.scale, config, scene.base_effects, [scene.target]),
        effects=simulated(model, scene.wrapped.any_camera(), [scene.target], config, scene.scale),
        gaussians_before=sum(map(len, scene.cores)),
        gaussians_after=after,
        seconds=seconds,
        ended_by=_ended_by(scene, tiles, f"{plural(len(files), 'tile')} of {plural(steps, 'step')}"),
        returned=judgment.returned,
        validation=judgment.validation,
        as_trained=judgment.as_trained,
        curve=[CurvePoint(step=steps, seconds=seconds["total"], validation_db=db, gaussians=after)],
        versions=versions(),
        notes=[*scene.doubts, *judgment.notes, *lost],
    )


def _ended_by(scene: TiledScene, tiles: Sequence[Mapping[str, Any]], what: str) -> str:
    """Why the run ended: the whole reached its target, the time of a tile was over, or all steps were taken. `what`: its tiles and steps."""
    config, budget = scene.config, End.TIME.told(scene.config, 0)
    if tiles and config.target_db is not None and result(scene.folder).quality.psnr >= config.target_db:
        return f"{End.TARGET.told(config, 0)}, {what}"
    if any(tile["ended_by"] == budget for tile in tiles):
        return f"{budget}, {what} at most"
    return what + fewer_note(scene.asked_steps, config)
