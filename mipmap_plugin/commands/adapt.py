"""`mipmap-plugin adapt`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mipmap_plugin.commands.common import print_facts, scene, without_none, wrap
from mipmap_plugin.commands.many import Many, Request, adapt_many
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.types import Background, Checkpoints, Scales, ScreenFilter, unique_scales
from mipmap_plugin.config import ResizeFilter, ViewPolicy
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.recipes import recipe as make_config

if TYPE_CHECKING:
    from mipmap_plugin.adaptation.adapted import Adapted
    from mipmap_plugin.models.base import SplatModel
    from mipmap_plugin.wrap import Wrapped


def adapt(
    checkpoints: Checkpoints,
    scale: Scales,
    output: Path | None = None,
    recipe: str = "default",
    viewer: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    views: ViewPolicy | None = None,
    cameras: Path | None = None,
    steps: int | None = None,
    time_budget_s: float | None = None,
    target_db: float | None = None,
    resize: ResizeFilter | None = None,
    upsampler: str | None = None,
    images: Path | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    threads: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
    json: bool = False,
    many: tyro.conf.OmitArgPrefixes[Many] = Many(),  # noqa: B008
) -> None:
    """Make a checkpoint that looks right at another scale, in the viewer that it is opened in.

    Args:
        checkpoints: A PLY or a model folder, or several; patterns such as 'output/*' too.
        scale: Target focal length over base focal length, such as 1/4 or 4. Required; may be given several times.
        output: Where to write; by default beside the checkpoint, as NAME_x0.25. With several scales or viewers: a folder for all files.
        recipe: default; thorough (more steps and views); instant (closed form only, seconds); paper (the published method); or a registered one.
        viewer: Viewer to make the file for: classic (the default; INRIA, gsplat, nerfstudio), spark, ...; portable: all; repeat it for a file each.
        views: Which views to adapt to; by default those of the recipe.
        cameras: A cameras.json, a transforms file or a COLMAP scene, if there are no cameras beside the checkpoint.
        steps: Maximum number of optimizer steps.
        time_budget_s: Maximum number of seconds.
        target_db: Stop at this PSNR against the pseudo truth (not against photographs).
        resize: Filter that makes base images smaller.
        upsampler: What makes base images larger: a registered name, or the file of a super-resolution network.
        images: Folder of the scene. A zoom-in is then adapted to its training images, at the resolution of the base, instead of the base's own.
        background: Of the scene; by default that of the checkpoint, or else black.
        screen_filter: The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: Name of a backend; auto chooses the fastest one that can serve the request.
        threads: Maximum number of processor threads; by default as many as torch finds. With the backend cpu the result does not depend on it.
        seed: Seed of everything random.
        overwrite: Replace outputs that exist.
        json: Print the reports as JSON.
    """
    settings = without_none(views=views, resize=resize, upsampler=upsampler, steps=steps, time_budget_s=time_budget_s, target_db=target_db)
    requests = _requests(scale, viewer)
    if many.asked(checkpoints):
        request = Request(requests, output, recipe, settings | {"seed": seed}, images, overwrite)
        return adapt_many(many, checkpoints, request, Base(Path(), cameras, background, backend, screen_filter), threads, json)
    [checkpoint] = checkpoints
    wrapped = wrap(checkpoint, cameras, background, backend, screen_filter, threads)
    targets = [adapted_path(checkpoint, output, *request, several=len(requests) > 1) for request in requests]
    _refuse(wrapped, requests, targets, settings | dict(name=recipe, seed=seed), overwrite)
    settings |= dict(recipe=recipe, seed=seed, images=images and scene(images))
    reports = [_saved(adapted, target, overwrite, quiet=json) for adapted, target in _adapted(wrapped, requests, targets, settings)]
    if json:
        print_facts(reports, json)


def _refuse(
    wrapped: Wrapped, requests: Sequence[tuple[float, str | None]], targets: Sequence[Path], settings: dict[str, Any], overwrite: bool
) -> None:
    """Raise now the errors that adapting or saving would raise, as far as they can be predicted."""
    for (factor, name), target in zip(requests, targets, strict=True):
        config = make_config(scale=factor, **settings)
        wrapped.targets(name)
        wrapped.refuse_output(target, overwrite=overwrite, networks_move=config.steps > 0 and config.rates.networks > 0, viewer=name)


def _adapted(
    wrapped: Wrapped, requests: Sequence[tuple[float, str | None]], targets: Sequence[Path], settings: dict[str, Any]
) -> Iterator[tuple[Adapted, Path]]:
    """Yield each model as soon as it is adapted, and the path to save it to."""
    from mipmap_plugin.wrap import state_path

    for (scale, viewer), target in zip(requests, targets, strict=True):
        yield wrapped.adapt(scale, viewer=viewer, resume=state_path(target), **settings), target


def _saved(adapted: Adapted, target: Path, overwrite: bool, *, quiet: bool) -> dict[str, Any]:
    """Save an adapted model, print a summary unless `quiet`, and return its report."""
    saved = adapted.save(target, overwrite=overwrite)
    if not quiet:
        _print(saved, adapted)
    return {"file": str(saved), **adapted.report.model_dump()}


def _requests(scales: list[float], viewers: tuple[str, ...]) -> list[tuple[float, str | None]]:
    """Each scale with each viewer, without repetitions."""
    names: list[str | None] = [*dict.fromkeys(viewers)] or [None]
    return [(scale, name) for scale in unique_scales(scales) for name in names]


def _made_for(model: SplatModel) -> str:
    """What a file is made for if no viewer was requested."""
    from mipmap_plugin.models.base import why_no_viewer

    classic, advice = "made for renderers that draw as 3DGS does (INRIA, gsplat, nerfstudio)", "; for others give --viewer spark, supersplat, ..."
    if why_no_viewer(model):
        return "made for its own project"
    return f"made for its own project, whose filter it keeps{advice}" if model.trained.keeps_filter else f"{classic}{advice}"


def _print(saved: Path, adapted: Adapted) -> None:
    report = adapted.report
    print(f"x{report.scale:g}{f' in {report.viewer}' if report.viewer else ''}: {saved}")
    db = ", ".join(f"{name} {psnr:.2f}" for name, psnr in report.validation.items())
    print(f"  holds {report.returned}{f' (dB on views that nothing was adapted to: {db})' if db else ''}")
    if report.viewers:
        print(f"  in each viewer: {', '.join(f'{name} {psnr:.1f}' for name, psnr in report.viewers.items())} dB")
    if report.viewer is None:
        print(f"  {_made_for(adapted.model)}")
    print(f"  {report.seconds['total']:.1f} s, {report.gaussians_before:,} -> {report.gaussians_after:,} splats, ended by {report.ended_by}")
    if report.peak_memory_mib is not None:
        print(f"  at most {report.peak_memory_mib:,.0f} MiB on the GPU")
    print(f"  {report.views}; {report.filters}; backend {report.backend}")
