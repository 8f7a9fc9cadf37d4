"""A scene adapted in tiles, from the cut to the file: the jobs of each stage, one stage after the other, and the concatenation of their cores."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.adaptation.report import AS_IT_IS, Report
from mipmap_plugin.adaptation.target.detail import unused_upsampler
from mipmap_plugin.adaptation.views.refusals import refuse_blind
from mipmap_plugin.adaptation.views.remarks import hints, remarks, too_far_out
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import BackendUnavailable, JobsFailed, SceneError, SettingsError, some_of
from mipmap_plugin.formats.atomic import delete, together, write_json
from mipmap_plugin.formats.here import told_from_here
from mipmap_plugin.formats.ply_rows import concatenate
from mipmap_plugin.formats.tags import with_tags
from mipmap_plugin.jobs.engines import in_this_process
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.models.inria_folder import cfg_args_for, write_folder
from mipmap_plugin.models.loaders import for_loader_of
from mipmap_plugin.models.places import REPORT, page_of
from mipmap_plugin.process import threads as thread_pool
from mipmap_plugin.process.freed_memory import return_freed_memory
from mipmap_plugin.progress import announced, counted
from mipmap_plugin.tiles.folder import START, halo_file, layer_file, part_file, run_file, steered_file, truth_file, work_folder
from mipmap_plugin.tiles.job import TileJob, Work
from mipmap_plugin.tiles.plan import alone, claim, cut_for, lock_of, refuse
from mipmap_plugin.tiles.report import JOINED, judged, make_report
from mipmap_plugin.tiles.scene import TiledScene, close_opened, opened
from mipmap_plugin.tiles.steering import Steered, open_state, result, sweep_of
from mipmap_plugin.tiles.truth import draw_base, parts
from mipmap_plugin.wrap import warn_of_others

# Does jobs, and yields the outcome of each: an engine of `mipmap_plugin.jobs`.
Engine = Callable[[Sequence[Job]], Generator[Outcome, None, None]]


@dataclass(frozen=True)
class Joined:
    """A scene that was adapted in tiles."""

    file: Path
    report: Report
    tiles: list[dict[str, Any]]  # what there is to say of each

    def facts(self) -> dict[str, Any]:
        """The content of the report's file."""
        return {**self.report.model_dump(), "tiles": self.tiles}


def adapt_in_tiles(job: Job, tiles: int, engine: Engine = in_this_process) -> Joined:
    """Adapt a checkpoint in `tiles` tiles, each a job that `engine` runs, and write it to `job.target`, a .ply or a model folder.

    What is done stays in a folder beside the target until all is: the same call goes on from there. Raises SettingsError and OutputExists before
    any work, JobsFailed if a job failed, and what loading raises.
    """
    return next(adapt_all_in_tiles([job], tiles, engine))


def adapt_all_in_tiles(jobs: Sequence[Job], tiles: int, engine: Engine = in_this_process, threads: int | None = None) -> Iterator[Joined]:
    """`adapt_in_tiles` of one base for several scales or viewers: it is cut once, and each picture of it is drawn once for all that need it.

    `threads`: for what is done between the jobs.
    """
    if not jobs:
        return
    for job in jobs:
        refuse(job, tiles)
    with alone(jobs):
        began = time.perf_counter()
        claim(jobs, tiles)
        with announced("cutting"):
            cut_for(jobs, tiles)
        return_freed_memory()
        with _uncut_if_refused(jobs):
            for job in jobs:
                _opened(job).wrapped.refuse_output(job.target, overwrite=job.overwrite, networks_move=False, viewer=job.viewer)
            _examine_views(jobs)
        for number, job in enumerate(jobs):
            stages = _Stages(job, tuple(jobs[number + 1 :]), engine, {"cutting": time.perf_counter() - began})
            yield _adapted_and_saved(_opened(job), stages, began, threads)
            began = time.perf_counter()


def _opened(job: Job) -> TiledScene:
    return opened(job.base, job.scale, job.viewer, job.config(), work_folder(job.target))


@contextmanager
def _uncut_if_refused(jobs: Sequence[Job]) -> Iterator[None]:
    """Delete the tiles of a request that is refused, if they were only cut: other settings or cameras need other ones."""
    try:
        yield
    except (SettingsError, SceneError, BackendUnavailable):
        close_opened()
        for folder in (work_folder(job.target) for job in jobs):
            if not truth_file(folder, 0).exists():
                delete(folder)
        raise


def _examine_views(jobs: Sequence[Job]) -> None:
    """Warn of what is wrong with views, as without tiles, but by a sample of the splats. Raises SettingsError for views that show nothing."""
    if (first := _opened(jobs[0])).photographed:  # all jobs have one base
        warn_of_others(first.wrapped, first.photographed, partial(_rendered, first))
    for scene in map(_opened, jobs):
        model, views, near = scene.wrapped.model, scene.views.adapted, scene.base_effects.near_plane
        refuse_blind(views, model, near, partial(draw_base, scene), scene.scale)
        orbit = not scene.wrapped.cameras or scene.config.views == "orbit"
        found = *hints(views, model, near), too_far_out(model, views, {str(scene.viewer): scene.target}), unused_upsampler(scene.config, scene.scale)
        for remark in filter(None, [*remarks(views, model, near, orbit=orbit), *found]):
            warn(remark)


def _rendered(scene: TiledScene, camera: Camera, fraction: float, _: str) -> Rendered:
    """The base's picture of a view at a fraction of its size, as of `FrozenBase.render` with the filter "scaled"."""
    layer = scene.base_painter(fraction).draw(scene.base, camera)
    return Rendered(layer.over(torch.tensor(scene.base_effects.background)), 1 - layer.transmittance[..., 0])


def _adapted_and_saved(scene: TiledScene, stages: _Stages, began: float, threads: int | None) -> Joined:
    """Adapt a scene that is cut, and write it. `began`: when its time began to count."""
    facts = _adapted(scene, stages)
    last = time.perf_counter()
    with announced("measuring the whole"), thread_pool.limited_for(scene.backend, threads):
        judgment = judged(scene)
    stages.seconds["validation"] = time.perf_counter() - last
    stages.seconds["total"] = time.perf_counter() - began
    with announced(f"writing {stages.job.target.name}"):
        files = _write_parts(scene, judgment.returned)
        report = make_report(scene, files, facts, stages.seconds, judgment)
        saved = _save(scene, stages.job, files, Joined(stages.job.target, report, facts))
    close_opened()
    return saved


@dataclass(frozen=True)
class _Stages:
    """Does the jobs of one stage after the other."""

    job: Job  # of the whole
    others: tuple[Job, ...]  # of the same base, which are adapted after it
    engine: Engine
    seconds: dict[str, float]  # by what they were spent on

    def __call__(self, work: Work, targets: list[Path], sweep: int = 0) -> list[dict[str, Any]]:
        """Do one job for each target, and return what there is to say of each. Raises JobsFailed, KeyboardInterrupt."""
        began, job = time.perf_counter(), self.job
        others = self.others if work == "truth" else ()
        jobs = [
            TileJob(job.base, target, job.scale, job.viewer, job.recipe, job.settings, work=work, number=number, sweep=sweep, others=others)
            for number, target in enumerate(targets)
        ]
        outcomes = _done(jobs, self.engine, work)
        name = {"truth": "pseudo truth", "start": "start", "tile": "optimization"}.get(work, "halo")
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        return [outcome.report for outcome in sorted(outcomes, key=lambda outcome: outcome.job.number)]  # type: ignore[attr-defined]


def _adapted(scene: TiledScene, do: _Stages) -> list[dict[str, Any]]:
    """Adapt all tiles; return what there is to say of each in each sweep."""
    tiles, folder = range(len(scene.cores)), scene.folder
    do("truth", [truth_file(folder, part) for part in range(parts(scene.used_views))])
    do("start", [folder / START])
    facts: list[dict[str, Any]] = []
    number, target = 0, math.inf if scene.config.target_db is None else scene.config.target_db
    while sweep := sweep_of(scene, number):
        runs = [run_file(folder, tile, number) for tile in tiles]
        if not sweep.repeats and not all(file.exists() for file in runs):
            do("layer", [layer_file(folder, tile, number) for tile in tiles], number)
            do("halo", [halo_file(folder, part, number) for part in range(parts(scene.sweep_views(sweep)))], number)
        facts += do("tile", runs, number)
        do("steering", [steered_file(folder, number)], number)
        number += 1
        _forget(scene, number)
        if Steered.before(folder, number).quality.psnr >= target:
            break
    return facts


def _forget(scene: TiledScene, made: int) -> None:
    """Make room on the disk: of what `made` sweeps left, only what the next one goes on with is needed."""
    tiles, folder = range(len(scene.cores)), scene.folder
    sweep, state = sweep_of(scene, made), Steered.before(folder, made)
    kept = {state.file(folder, tile) for tile in tiles}
    for number in range(made):  # and nothing of later sweeps, which an interrupted run has begun
        unneeded = {*folder.glob(f"tile_{number}_*.splats")} - kept
        if sweep is None or number < sweep.halos:
            unneeded |= {*folder.glob(f"layer_{number}_*.pictures"), *folder.glob(f"halo_{number}_*.pictures")}
        for file in unneeded:
            file.unlink()
    for number in set(range(made - 1)) - {state.sweep}:
        for tile in tiles:
            run_file(folder, tile, number).write_bytes(b"")  # which still says that the tile was done


def _write_parts(scene: TiledScene, returned: str) -> list[Path]:
    """Write the splats of each tile to a PLY of its own."""
    files = [part_file(scene.folder, number) for number in range(len(scene.cores))]
    state = result(scene.folder) if returned == JOINED else Steered.before(scene.folder, 0)
    splats = scene.base if returned == AS_IT_IS else open_state(scene, state)
    cores = scene.cores if returned == AS_IT_IS else torch.arange(len(splats)).split([*map(len, splats.parts)])
    for file, core in zip(files, cores, strict=True):
        for_loader_of(scene.viewer, scene.for_target(splats.parameters(core)), file).save(file, provenance={}, overwrite=True)
    return files


def _done(jobs: Sequence[Job], engine: Engine, what: str) -> list[Outcome]:
    """The outcomes of jobs that all succeeded. Raises JobsFailed, KeyboardInterrupt."""
    outcomes = []
    running = engine(jobs)
    try:
        for outcome in counted(running, len(jobs), f"tiles: {what}", "job"):
            outcomes.append(outcome)
            for text in outcome.warnings:
                warn(text)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("interrupted; run the same command again to go on where it stopped") from interrupt
    finally:
        running.close()
    if failed := [outcome for outcome in outcomes if outcome.status not in ("done", "finished before")]:
        reasons = told_from_here("; ".join(dict.fromkeys(outcome.reason for outcome in failed)))
        raise JobsFailed(f"{some_of(len(failed), len(jobs), 'job')} ({what}) failed: {reasons}; the same command does these again, and no other")
    return outcomes


def _save(scene: TiledScene, job: Job, files: Sequence[Path], joined: Joined) -> Joined:
    """Write the cores one after the other, as a .ply or within a model folder, and the report beside it."""
    provenance = {**joined.report.provenance(), "tiles": len(files)}
    comments = with_tags(scene.comments, scene.target.screen_filter, provenance, scene.target.eps2d)
    write = partial(concatenate, files=files, comments=comments)
    with together(job.target, [scene.folder, lock_of(scene.folder), *page_of(job.target)]):
        if job.target.suffix.lower() == ".ply":
            saved = write(job.target, overwrite=job.overwrite)
        else:
            trained = scene.wrapped.model.trained.drawn_with(scene.target)
            degree = scene.wrapped.model.gaussians(scene.wrapped.any_camera()).sh_degree
            folder, iteration = scene.checkpoint.folder, scene.checkpoint.iteration
            saved = write_folder(job.target, folder, cfg_args_for(folder, job.target, trained, degree), iteration, job.overwrite, write)
        write_json(saved.with_name(saved.name + REPORT), joined.facts(), overwrite=job.overwrite)
    return replace(joined, file=saved)
