"""`mipmap-plugin adapt`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mipmap_plugin.commands.common import print_json, scene, without_none, wrap
from mipmap_plugin.commands.many import NO_CHECKPOINT, Many, Request, adapt_many, finished_before, jobs_of, refuse
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.pages import AdaptationPage, look_at
from mipmap_plugin.commands.terminal_picture import show_before_and_after
from mipmap_plugin.commands.tiled import adapt_tiled
from mipmap_plugin.commands.types import (
    BackendName,
    Background,
    Cameras,
    Checkpoints,
    Scale,
    ScreenFilter,
    Seed,
    Threads,
    Up,
    Viewer,
    read_size,
    unique_scales,
)
from mipmap_plugin.commands.voice import detail, say
from mipmap_plugin.config import ResizeFilter, ViewPolicy
from mipmap_plugin.errors import CheckpointError, SettingsError, plural
from mipmap_plugin.formats.atomic import together
from mipmap_plugin.formats.here import from_here
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.adaptation.report import Report
    from mipmap_plugin.models.base import SplatModel
    from mipmap_plugin.scenes import Scene
    from mipmap_plugin.wrap import Wrapped

Facts = dict[str, Any]  # a report as JSON, with the path of its file


@dataclass(frozen=True)
class Changes:
    """Settings of the recipe that are changed."""

    views: ViewPolicy | None = None
    """Which views to adapt to; by default those of the recipe."""
    farthest: float | None = None
    """For walking back: a third of the extra views step back, until what is nearest is this much smaller, such as 0.5; 1: none."""
    steps: int | None = None
    """Maximum number of optimizer steps."""
    time_budget_s: float | None = None
    """Maximum number of seconds for each file; with --tiles for each tile, and tiles are adapted one after the other without --jobs."""
    target_db: float | None = None
    """Stop at this PSNR against the pseudo truth (not against photographs)."""
    resize: ResizeFilter | None = None
    """Filter that makes base images smaller."""
    upsampler: str | None = None
    """What makes base images larger: a registered name, or the file of a super-resolution network."""


def adapt(
    checkpoints: Checkpoints,
    scale: tyro.conf.UseAppendAction[tuple[Scale, ...]] = (),
    output: Path | None = None,
    recipe: str = "default",
    viewer: tyro.conf.UseAppendAction[tuple[Viewer, ...]] = (),
    cameras: Cameras = None,
    up: Up = None,
    splats: int | None = None,
    bytes: str | None = None,
    images: Path | None = None,
    background: Background = None,
    screen_filter: ScreenFilter = None,
    backend: BackendName = "auto",
    threads: Threads = None,
    seed: Seed = 0,
    report: bool = False,
    overwrite: bool = False,
    json: bool = False,
    changes: tyro.conf.OmitArgPrefixes[Changes] = Changes(),
    many: tyro.conf.OmitArgPrefixes[Many] = Many(),  # noqa: B008
) -> None:
    """Make a checkpoint that looks right at another scale, in the viewer that it is opened in.

    Args:
        checkpoints: A PLY, .spz, .sog, .splat or .glb, or a model folder; or several, also as patterns such as "output/*".
        scale: Target focal length over the base's: 1/4, 4, or 1 for a viewer alone; several: a file each; required without --splats or --bytes.
        output: Where to write; by default beside the checkpoint, as NAME_x0.25. With several scales or viewers: a folder for all files.
        recipe: default; thorough (more steps and views); instant (closed form only, seconds); paper (the published method); or a registered one.
        viewer: Viewer to make the file for: classic, spark, ...; portable: all; several: a file each. By default what draws as the training did.
        splats: Maximum number of splats. Without a scale, the file is made for the zoom that so many splats suit.
        bytes: Maximum size of the file, such as 20MB, in place of a number of splats.
        images: Folder of the scene. A zoom-in is then adapted to its training images, at the base's resolution, instead of to the base's own.
        report: Also write a page that shows what came out: NAME.report.html beside the file, or in the folder of several files.
        overwrite: Replace outputs that exist.
        json: Print the reports as JSON.
    """
    size, limited = None if bytes is None else read_size(bytes), splats is not None or bytes is not None
    settings = without_none(**vars(changes), most_splats=splats) | dict(recipe=recipe, seed=seed)
    base = Base(Path(), cameras, background, backend, screen_filter, up)
    if many.tiles is not None or many.asked(checkpoints):
        _refuse_for_many(bool(checkpoints or many.list), scale, bytes, report)
        request = Request(_requests(scale, viewer), output, settings, images, overwrite)
        return (adapt_many if many.tiles is None else adapt_tiled)(many, checkpoints, request, base, threads, json)
    request = Request(_requests(scale or ([1.0] if limited else ()), viewer), output, settings, images, overwrite)
    jobs = _jobs(replace(base, checkpoint=checkpoints[0]), request)  # raises what it can before the checkpoint is read, which may take long
    base, images = jobs[0].base, jobs[0].images  # with its name in their paths
    wrapped = wrap(base, threads, images)
    if limited:
        jobs = _jobs(base, _limited(request, wrapped, jobs, size, fits=not scale))
    before = {} if overwrite or len(jobs) == 1 else finished_before(jobs, json)  # a single file is made or refused
    _check(wrapped, left := [job for job in jobs if job.target not in before])
    page = AdaptationPage(checkpoints[0], [job.target for job in jobs], overwrite, all_finished=not left) if report else None
    made = _made(wrapped, left, None if images is None else scene(base, images), page, json)
    if page and not page.of_one and not page.stays:
        page.write(made, [*before.values()])
    if json:
        print_json([before.get(job.target) or made.pop(0) for job in jobs])
    elif page:
        say(f"{look_at(page.path)}{', of an earlier command' * page.stays}")


def _refuse_for_many(given: bool, scales: Sequence[float], size: str | None, page: bool) -> None:
    """Raise SettingsError where no checkpoint is given, and for what only one can have."""
    if not given:
        raise SettingsError(NO_CHECKPOINT)
    if not scales:
        raise SettingsError("several checkpoints, jobs and tiles need a scale; give --scale")
    if size is not None or page:
        jobs = "--tiles, --jobs, --dask, --shard, --send-files and --skip-existing"
        raise SettingsError(f"--bytes and --report are for one checkpoint at a time, without {jobs}; leave out these or those")


def _jobs(base: Base, request: Request) -> list[Job]:
    """What is made for each scale and viewer. Raises the errors of settings, and SettingsError for two files with the same path, or a folder's."""
    job, *others = jobs_of(base.checkpoint, request, base)
    refuse([job, *others])
    output = None if others or request.overwrite else request.output
    if output and output.is_dir() and not _is_adapted_model(output):
        within = adapted_path(base.checkpoint, output, job.scale, job.viewer, several=True)
        raise SettingsError(f"{output} is a folder; give the path of what is to be written, such as {within}")
    return [job, *others]


def _is_adapted_model(folder: Path) -> bool:
    """Whether an adaptation has made a folder itself, and not only files in it."""
    from mipmap_plugin.models import detect
    from mipmap_plugin.models.outputs import is_adapted

    try:
        found = detect(folder)
    except (CheckpointError, OSError):
        return False
    return found.folder is not None and is_adapted(found.path)


def _check(base: Wrapped, jobs: Sequence[Job]) -> None:
    """Raise now what making the files would raise, as far as it can be predicted."""
    from mipmap_plugin.jobs.run import check

    for job in jobs:
        check(base, job)


def _made(base: Wrapped, jobs: Sequence[Job], photographs: Scene | None, page: AdaptationPage | None, quiet: bool) -> list[Facts]:
    """Adapt to each scale and viewer, save the file, draw it for the page, and print a summary unless `quiet`; return all reports."""
    from mipmap_plugin.models.places import state_path

    base.keeps_images, reports = len(jobs) > 1, list[Facts]()
    for job in jobs:
        resume = state_path(job.target)
        adapted = base.adapt(job.scale, recipe=job.recipe, viewer=job.viewer, resume=resume, images=photographs, **job.settings)
        failed: BaseException | None = None
        with together(job.target) if page and page.of_one else nullcontext():  # a kill leaves both or none
            saved = adapted.save(job.target, overwrite=job.overwrite)
            report = adapted.report_of(saved)
            reports.append({"file": str(saved.absolute()), **report.model_dump()})
            try:
                if page:
                    with announced("drawing the page"):
                        page.add(base, adapted.as_written(saved))
                if page and page.of_one:
                    page.write(reports, ())
            except BaseException as error:  # Ctrl-C too: the file is worth more than its page
                failed = error
        if failed:
            raise failed
        if not quiet:
            _say(saved, report, adapted.model)
            show_before_and_after(base, adapted)
        del adapted  # before the next is made: its splats, and the truths that its file was measured by, take memory
    return reports


def _requests(scales: Sequence[float], viewers: tuple[str, ...]) -> list[tuple[float, str | None]]:
    """Each scale with each viewer, without repetitions."""
    names: list[str | None] = [*dict.fromkeys(viewers)] or [None]
    return [(scale, name) for scale in unique_scales(scales) for name in names]


def _limited(request: Request, base: Wrapped, jobs: Sequence[Job], size: int | None, *, fits: bool) -> Request:
    """The request with no more splats than fit into a size in bytes, too; `fits`: at the scale that so many splats suit.

    `jobs`: those of the request as it is. Raises SettingsError.
    """
    from mipmap_plugin.levels.fitting import ANY_SCALE, fitting_scale, recorded, splats_within

    counts = [request.settings["most_splats"]] if "most_splats" in request.settings else []
    if size is not None:
        record = recorded(base, [(ANY_SCALE if fits else scale, viewer) for scale, viewer in request.targets], request.settings)
        files = {job.target.suffix: job.target.name for job in jobs}  # a viewer may want another format
        with announced("trying how large a file is"):
            counts += [splats_within(base.model, size, name, record) for name in files.values()]
    most = min(counts)
    targets = [(fitting_scale(most, base.model) if fits else scale, viewer) for scale, viewer in request.targets]
    return replace(request, targets=targets, settings={**request.settings, "most_splats": most})


def _made_for(report: Report, model: SplatModel, saved: Path) -> str:
    """What a file is made for, and how to have one made for something else."""
    from mipmap_plugin.effects import NEAR_PLANE
    from mipmap_plugin.models.base import why_no_viewer
    from mipmap_plugin.plugin_errors import is_third_party

    if report.viewer:
        return f"made for {report.viewer}"
    if why_no_viewer(model):
        return "made for its own project"
    advice = "; for others give --viewer spark, supersplat, ..."
    if is_third_party(model) and saved.suffix.lower() != ".ply":  # which no other program reads
        return f"made for its own project{advice}"
    if (trained := model.trained).keeps_filter:
        return f"made for its own project, whose filter it keeps{advice}"
    if trained.screen_filter != "classic":
        return f"made for renderers that draw as its training did ({trained.told()}){advice}"
    first, then = ("INRIA", "gsplat and nerfstudio") if trained.near_plane == NEAR_PLANE else ("gsplat, nerfstudio", "INRIA")
    return f"made for renderers that draw as 3DGS does ({first}, and {then} where no splat is nearer than {NEAR_PLANE:g} units){advice}"


def _say(saved: Path, report: Report, model: SplatModel) -> None:
    """Two lines, what and where; the rest goes to the log."""
    splats = f"{report.gaussians_before:,} -> {plural(report.gaussians_after, 'splat')}, {report.seconds['total']:.1f} s"
    say(f"x{report.scale:g}{f' in {report.viewer}' if report.viewer else ''}: {report.gain()}, {splats}")
    say(f"{from_here(saved)}, {_made_for(report, model, saved)}")
    for line in _details(report):
        detail(f"  {line}")


def _details(report: Report) -> Iterator[str]:
    psnrs = ", ".join(f"{name} {psnr:.2f}" for name, psnr in report.validation.items())
    yield f"holds {report.returned}{f' (dB on views that nothing was adapted to: {psnrs})' if psnrs else ''}; ended by {report.ended_by}"
    if report.written is not None:
        yield f"the file as its format rounds it: {report.written:.2f} dB on the same views"
    if report.viewers:
        yield f"in each viewer: {', '.join(f'{name} {psnr:.1f}' for name, psnr in report.viewers.items())} dB"
    if report.as_trained is not None:
        yield f"the base itself, drawn as its training drew it: {report.as_trained:.2f} dB on the same views"
    if report.peak_memory_mib is not None:
        yield f"at most {report.peak_memory_mib:,.0f} MiB on the GPU"
    yield f"{report.views}; {report.filters}; backend {report.backend}"
    yield from report.notes
    yield f"seconds: {', '.join(f'{phase} {seconds:.2f}' for phase, seconds in report.seconds.items())}"
