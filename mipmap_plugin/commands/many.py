"""`mipmap-plugin adapt` with several checkpoints, or as jobs."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from os.path import realpath  # of a link to itself too, at which `Path.resolve` fails
from pathlib import Path
from typing import Any

from mipmap_plugin.commands.common import print_json, starting
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.voice import note, say
from mipmap_plugin.errors import JobsFailed, SettingsError, install, plural, warn
from mipmap_plugin.formats.here import from_here
from mipmap_plugin.formats.staging import missing_folders, remove_empty
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.listing import find_checkpoints, is_pattern, read_list, shard, without_outputs
from mipmap_plugin.jobs.summary import facts, in_order, table, totals, warned
from mipmap_plugin.progress import announced, counted

NO_CHECKPOINT = "there is no checkpoint to adapt; give a PLY or a model folder, several of them, or --list FILE"


@dataclass(frozen=True)
class Many:
    """Several checkpoints."""

    list: Path | None = None
    """A text file with a checkpoint or a pattern on each line."""
    jobs: int | None = None
    """How many to adapt at the same time, in processes that share the threads."""
    dask: str | None = None
    """Adapt on the workers of dask.distributed: tcp://HOST:8786 for a scheduler, local:4 for four workers of this machine."""
    send_files: bool = False
    """With --dask: send checkpoints to the workers and get files back, also if they see this disk; by default only if one does not."""
    shard: str | None = None
    """Do a part of the jobs only, such as 3/50: every fiftieth, from the third on."""
    skip_existing: bool = False
    """Skip outputs that were already made from the same base with the same settings. With several checkpoints this is the default."""
    tiles: int | None = None
    """Zoom-out of a large checkpoint: cut it into this many parts, each of which is adapted as a job of its own, with less memory."""

    def asked(self, checkpoints: Sequence[Path]) -> bool:
        """Whether these are jobs, rather than one checkpoint."""
        options = (self.jobs, self.dask, self.shard)
        return self.is_list(checkpoints) or self.skip_existing or self.send_files or any(each is not None for each in options)

    def is_list(self, checkpoints: Sequence[Path]) -> bool:
        """Whether there may be several checkpoints, so that an output is a folder for all."""
        return self.list is not None or len(checkpoints) != 1 or is_pattern(checkpoints[0])


@dataclass(frozen=True)
class Request:
    """What each of the checkpoints is adapted to."""

    targets: Sequence[tuple[float, str | None]]  # scale and viewer
    output: Path | None
    settings: dict[str, Any]  # the recipe's name among them
    images: Path | None
    overwrite: bool


def adapt_many(many: Many, given: Sequence[Path], request: Request, base: Base, threads: int | None, json: bool) -> None:
    """Run a job for each checkpoint, scale and viewer; print one table, or JSON.

    `given`: checkpoints and patterns; `base`: how each checkpoint is read. Raises SettingsError before any work, JobsFailed and
    KeyboardInterrupt after it.
    """
    with announced("looking for checkpoints"):
        jobs = make_jobs(many, given, request, base)
    outcomes: list[Outcome] = []
    again = "the same command" + (" with --skip-existing" if request.overwrite and not many.skip_existing else "")
    missing = {folder for job in jobs for folder in missing_folders(job.target.parent)}
    try:
        with closing(engine(many, jobs, threads)) as running:
            for outcome in counted(running, len(jobs), "adapting", "job"):
                outcomes.append(outcome)
                note(str(outcome), urgent=outcome.status == "failed")
    except KeyboardInterrupt as interrupt:
        _print(outcomes, jobs, json)
        raise KeyboardInterrupt(f"interrupted; run {again} again to go on where it stopped") from interrupt
    finally:  # a job that fails leaves a folder that another one was using
        remove_empty(sorted(missing, key=lambda folder: len(folder.parts), reverse=True))
    _print(outcomes, jobs, json)
    if failed := [outcome for outcome in outcomes if outcome.status not in ("done", "finished before")]:
        raise JobsFailed(f"{len(failed)} of {plural(len(jobs), 'job')} failed; {again} does these again, and no other")


def make_jobs(many: Many, given: Sequence[Path], request: Request, base: Base) -> list[Job]:
    """A job for each checkpoint, scale and viewer of this shard. Raises SettingsError if none of them can be right."""
    checkpoints = _checkpoints([*given, *(read_list(many.list) if many.list else [])])
    skip = many.skip_existing or not request.overwrite
    jobs = [replace(job, skip_finished=skip) for path in checkpoints for job in jobs_of(path, request, base, several=many.is_list(given))]
    refuse(jobs)
    return shard(jobs, *_part(many.shard))


def jobs_of(checkpoint: Path, request: Request, base: Base, *, several: bool = False) -> list[Job]:
    """The job of one checkpoint for each scale and viewer. The output is a folder for all if there are several, or may be `several` checkpoints."""
    several = several or len(request.targets) > 1
    own = replace(base, checkpoint=checkpoint.absolute(), cameras=_of_scene(base.cameras, checkpoint))
    settings, images = dict(request.settings), _of_scene(request.images, checkpoint)
    recipe, network, jobs = settings.pop("recipe"), Path(settings.get("upsampler", "")).absolute(), []
    for scale, viewer in request.targets:
        target = adapted_path(checkpoint, request.output, scale, viewer, several=several).absolute()
        jobs.append(Job(own, target, scale, viewer, recipe, settings, images, request.overwrite, network if network.is_file() else None))
    return jobs


def finished_before(jobs: Iterable[Job], json: bool, *, may_load: bool = True) -> dict[Path, dict[str, Any]]:
    """The reports of outputs that an earlier command has made, by the job's target; each output is named unless JSON is printed.

    `may_load`: whether a base may be loaded to find that out (`jobs.finished`).
    """
    from mipmap_plugin.jobs.finished import finished

    found = {job.target: before for job in jobs if (before := finished(job, may_load=may_load))}
    for file, _ in found.values() if not json else ():
        say(f"{from_here(file)}: finished before")
    return {target: {"file": str(file), **report} for target, (file, report) in found.items()}


def _checkpoints(given: Sequence[Path]) -> list[Path]:
    """The checkpoints of the command and of its list, without lists of cameras and outputs of earlier runs, which output/* finds too."""
    found = find_checkpoints(given)
    cameras = [path for path in found if path.name == "cameras.json"]
    if len(cameras) == len(found):
        raise SettingsError(NO_CHECKPOINT)
    if cameras:
        note(f"left out, because they list cameras: {', '.join(map(str, cameras))}")
    checkpoints, outputs = without_outputs(path for path in found if path not in cameras)
    if outputs and not checkpoints:
        raise SettingsError(f"{outputs[0]}: this was adapted already; give the checkpoint that it was made of")
    if outputs:
        note(f"left out, because an adaptation made them: {', '.join(path.name for path in outputs)}")
    return checkpoints


def _of_scene(path: Path | None, checkpoint: Path) -> Path | None:
    """A path in which {name} stands for the checkpoint's name."""
    from mipmap_plugin.formats.atomic import named

    place = named(checkpoint)
    name = place.stem if place.is_file() else place.name
    return path and Path(str(path).replace("{name}", name)).absolute()


def refuse(jobs: Sequence[Job]) -> None:
    """Raise the errors of settings that are wrong for every checkpoint, and SettingsError for two jobs with one output."""
    with starting():
        from mipmap_plugin.backends import BACKENDS
        from mipmap_plugin.splatting.viewers import viewers_for

    if jobs[0].base.backend != "auto":
        BACKENDS.get(jobs[0].base.backend)
    makers: dict[Path, Job] = {}
    bases = {folder: job.base.checkpoint for job in jobs for folder in Path(realpath(job.base.checkpoint), "x").parents}
    for job in jobs:
        job.config()
        if job.overwrite and (base := bases.get(Path(realpath(job.target)), job.base.checkpoint)) != job.base.checkpoint:
            raise SettingsError(f"{from_here(job.target)} holds a checkpoint that is to be adapted too ({from_here(base)}); choose another --output")
        if job.viewer is not None:
            viewers_for(job.viewer)
        if (other := makers.setdefault(job.target, job)) is not job:
            one, two = (from_here(each.base.checkpoint) for each in (other, job))
            both, remedy = f"{one} and {two}", "leave --output out"
            if one == two:
                both, remedy = f"two scales of {one}", "give scales that differ more"
            raise SettingsError(f"{both} would both be written to {from_here(job.target)}; {remedy}, or adapt them one by one")


def _part(text: str | None) -> tuple[int, int]:
    """Parse a shard, such as 3/50. Raises SettingsError."""
    match = re.fullmatch(r"(\d+)/(\d+)", text or "1/1")
    if match is None:
        raise SettingsError(f"--shard {text}: give the part and the number of parts, such as 3/50")
    return int(match[1]), int(match[2])


def engine(many: Many, jobs: Sequence[Job], threads: int | None) -> Generator[Outcome, None, None]:
    """The outcomes of the jobs, from where they are to run. Raises SettingsError."""
    from mipmap_plugin.jobs.engines import in_this_process, in_workers

    count = 1 if many.jobs is None else many.jobs
    if count < 1 or (threads is not None and threads < 1):
        raise SettingsError(f"--jobs must be at least 1, got {count}" if count < 1 else f"--threads must be at least 1, got {threads}")
    if many.dask is None and many.send_files:
        raise SettingsError("--send-files sends them to the workers of --dask, which is not given; give it too, or leave --send-files out")
    if many.dask is None:
        return in_this_process(jobs, threads) if count == 1 else in_workers(jobs, count, threads)
    if many.jobs is not None:
        raise SettingsError("--jobs are processes of this machine, and --dask has workers of its own; leave one of them out")
    try:
        from mipmap_plugin.jobs.farm import on_dask
    except ModuleNotFoundError as error:
        raise SettingsError(f"--dask needs dask.distributed ({error}); {install('farm')}") from None
    return on_dask(jobs, many.dask, threads, send_files=many.send_files)


def _print(outcomes: Sequence[Outcome], jobs: Sequence[Job], json: bool) -> None:
    """The outcomes in the order of their jobs, whatever the order in which they ended."""
    sorted_outcomes = in_order(outcomes, jobs)
    if json:
        print_json(facts(sorted_outcomes))
    else:
        say(table(sorted_outcomes))
        say(totals(outcomes, len(jobs)))
    for text in warned(sorted_outcomes):
        warn(text)
