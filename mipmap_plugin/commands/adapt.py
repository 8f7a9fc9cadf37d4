"""`mipmap-plugin adapt`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mipmap_plugin.commands.common import print_json, scene, without_none, wrap
from mipmap_plugin.commands.many import NO_CHECKPOINT, Many, Request, adapt_many, finished_before, jobs_of
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.pages import AdaptationPage, look_at
from mipmap_plugin.commands.terminal_picture import show_before_and_after
from mipmap_plugin.commands.tiled import adapt_tiled
from mipmap_plugin.commands.types import BackendName, Background, Cameras, Checkpoints, Scale, ScreenFilter, Seed, Threads, Up, Viewer, unique_scales
from mipmap_plugin.commands.voice import detail, say
from mipmap_plugin.config import ResizeFilter, ViewPolicy
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.formats.atomic import together
from mipmap_plugin.formats.here import from_here
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.recipes import recipe as make_config

if TYPE_CHECKING:
    from mipmap_plugin.adaptation.report import Report
    from mipmap_plugin.models.base import SplatModel
    from mipmap_plugin.wrap import Wrapped

File = tuple[float, str | None, Path]  # its scale, the viewer that it is for, and where it is written
Facts = dict[str, Any]  # a report as JSON, with the path of its file


@dataclass(frozen=True)
class Changes:
    """Settings of the recipe that are changed."""

    views: ViewPolicy | None = None
    """Which views to adapt to; by default those of the recipe."""
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
        scale: Target focal length over base focal length, such as 1/4 or 4; may be given several times. Required without --splats or --bytes.
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
    settings, base = without_none(**vars(changes)) | dict(recipe=recipe, seed=seed), Base(Path(), cameras, background, backend, screen_filter, up)
    if many.tiles is not None or many.asked(checkpoints):
        _refuse_for_many(bool(checkpoints or many.list), scale, bytes, report)
        request = Request(_requests(scale, viewer), output, settings | without_none(most_splats=splats), images, overwrite)
        adapt_jobs = adapt_many if many.tiles is None else adapt_tiled
        return adapt_jobs(many, checkpoints, request, base, threads, json)
    [checkpoint] = checkpoints
    wrapped = wrap(replace(base, checkpoint=checkpoint), threads, images)
    most = _most(wrapped, (splats, bytes), (checkpoint, output), (scale, viewer), settings)
    settings, requests = settings | without_none(most_splats=most), _requests(scale or _fitting(wrapped.model, most), viewer)
    files = _files(checkpoint, output, requests)
    before = _finished(jobs_of(checkpoint, Request(requests, output, settings, images, overwrite), base, several=len(files) > 1), files, json)
    left = [file for file in files if file[2] not in before]
    _check(wrapped, left, settings, overwrite)
    page = AdaptationPage(checkpoint, [target for *_, target in files], overwrite) if report else None
    photographs = images and scene(replace(base, checkpoint=checkpoint), images)
    made = _made(wrapped, left, settings | dict(images=photographs), page, overwrite, json)
    if page and not page.of_one:
        page.write(made, [*before.values()])
    if json:
        print_json([before.get(file[2]) or made.pop(0) for file in files])
    elif page:
        say(look_at(page.path))


def _refuse_for_many(given: bool, scales: Sequence[float], size: str | None, page: bool) -> None:
    """Raise SettingsError where no checkpoint is given, and for what only one can have."""
    if not given:
        raise SettingsError(NO_CHECKPOINT)
    if not scales:
        raise SettingsError("several checkpoints, jobs and tiles need a scale; give --scale")
    if size is not None or page:
        jobs = "--tiles, --jobs, --dask, --shard, --send-files and --skip-existing"
        raise SettingsError(f"--bytes and --report are for one checkpoint at a time, without {jobs}; leave out these or those")


def _files(checkpoint: Path, output: Path | None, requests: Sequence[tuple[float, str | None]]) -> list[File]:
    """What is made for each scale and viewer. Raises SettingsError for two of them with the same path."""
    files = [(*request, adapted_path(checkpoint, output, *request, several=len(requests) > 1)) for request in requests]
    targets = [target for *_, target in files]
    if twice := [target for number, target in enumerate(targets) if target in targets[:number]]:
        raise SettingsError(f"two scales would both be written to {twice[0]}; give scales that differ more, or adapt to them one by one")
    return files


def _finished(jobs: Sequence[Job], files: Sequence[File], json: bool) -> dict[Path, Facts]:
    """The reports of files that an interrupted command has written; none of a single file, which is made or refused. `jobs`: what would make each."""
    if len(files) == 1 or jobs[0].overwrite:
        return {}
    return finished_before([replace(job, target=target) for job, (*_, target) in zip(jobs, files, strict=True)], json)


def _check(wrapped: Wrapped, files: Sequence[File], settings: dict[str, Any], overwrite: bool) -> None:
    """Raise now what adapting and saving would raise, as far as it can be predicted."""
    further = {name: value for name, value in settings.items() if name != "recipe"}
    for scale, viewer, target in files:
        config = make_config(settings["recipe"], scale, **further)
        wrapped.targets(viewer)
        wrapped.refuse_output(target, overwrite=overwrite, networks_move=config.steps > 0 and config.rates.networks > 0, viewer=viewer)


def _made(base: Wrapped, files: Sequence[File], settings: dict[str, Any], page: AdaptationPage | None, overwrite: bool, quiet: bool) -> list[Facts]:
    """Adapt to each scale and viewer, save the file, draw it for the page, and print a summary unless `quiet`; return all reports."""
    from mipmap_plugin.models.places import state_path

    base.keeps_images, reports = len(files) > 1, list[Facts]()
    for scale, viewer, target in files:
        adapted = base.adapt(scale, viewer=viewer, resume=state_path(target), **settings)
        failed: BaseException | None = None
        with together(target) if page and page.of_one else nullcontext():  # a kill leaves both or none
            saved = adapted.save(target, overwrite=overwrite)
            report = adapted.report_of(saved)
            reports.append({"file": str(saved.absolute()), **report.model_dump()})
            try:
                if page:
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


def _most(
    base: Wrapped,
    limits: tuple[int | None, str | None],
    paths: tuple[Path, Path | None],
    asked: tuple[Sequence[float], tuple[str, ...]],
    settings: dict[str, Any],
) -> int | None:
    """The smaller of a number of splats and of what fits into a size, the `limits`; None if neither is given.

    `paths`: the checkpoint and the output; `asked`: scales and viewers.
    """
    splats, size = limits
    if splats is not None and splats < 1:
        raise SettingsError(f"splats: must be at least 1, got {splats}")
    if size is None:
        return splats
    from mipmap_plugin.levels.fitting import ANY_SCALE, read_size, recorded, splats_within

    most, (scales, viewers) = read_size(size), asked
    requests = _requests(scales or [ANY_SCALE], viewers)
    record = recorded(base, requests, settings)
    targets = [adapted_path(*paths, 1.0, viewer, several=len(requests) > 1) for viewer in viewers or (None,)]  # a viewer may want another format
    within = min(splats_within(base.model, most, target.name, record) for target in {target.suffix: target for target in targets}.values())
    return within if splats is None else min(within, splats)


def _fitting(model: SplatModel, most: int | None) -> Sequence[float]:
    """The scale that suits so many splats; none if there is no limit to them."""
    from mipmap_plugin.levels.fitting import fitting_scale

    return () if most is None else (fitting_scale(most, model),)


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
