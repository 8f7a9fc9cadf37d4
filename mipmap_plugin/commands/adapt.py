"""`mipmap-plugin adapt`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mipmap_plugin.commands.common import given, scene, tell, wrap
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.types import Background, Checkpoint, Scales, ScreenFilter, each_once
from mipmap_plugin.config import ResizeFilter, ViewPolicy
from mipmap_plugin.recipes import recipe as make_config

if TYPE_CHECKING:
    from mipmap_plugin.models.base import SplatModel
    from mipmap_plugin.wrap import Adapted, Wrapped


def adapt(
    checkpoint: Checkpoint,
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
) -> None:
    """Make a checkpoint that looks right at another scale, in the viewer that it is opened in.

    Args:
        checkpoint: A PLY or a model folder.
        scale: Target focal length over base focal length, such as 1/4 or 4. May be given several times.
        output: Where to write; by default beside the checkpoint, as NAME_x0.25. Several scales or viewers: a folder for all of them.
        recipe: default; thorough (more steps and views); instant (closed form only); paper (the published code, quirk by quirk).
        viewer: What the file is for: classic (INRIA, gsplat, nerfstudio; the default), spark, ...; portable: all at once; several: a file each.
        views: Which views to adapt to; by default what the recipe says.
        cameras: A cameras.json, a transforms file or a COLMAP scene, where the checkpoint has none beside it.
        steps: Optimizer steps at most.
        time_budget_s: Seconds at most.
        target_db: Stop at this PSNR against the pseudo truth, which is what adapting aims at, and not real photographs.
        resize: Filter that makes the base image smaller.
        upsampler: What makes the base image larger, by name or the file of a super-resolution network.
        images: Folder of the scene; a zoom-in then aims at its training images, made as small as the base's, instead of at the base's own.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: A backend's name; auto takes the fastest that can do it.
        threads: Processor threads at most; by default as many as torch finds. The result does not depend on it.
        seed: Everything random follows from it.
        overwrite: Replace outputs that exist.
        json: Print the reports as JSON.
    """
    wrapped = wrap(checkpoint, cameras, background, backend, screen_filter, threads)
    settings = given(views=views, resize=resize, upsampler=upsampler, steps=steps, time_budget_s=time_budget_s, target_db=target_db)
    wanted = _wanted(scale, viewer)
    targets = [adapted_path(checkpoint, output, *each, several=len(wanted) > 1) for each in wanted]
    for (each, name), target in zip(wanted, targets, strict=True):
        config = make_config(recipe, each, seed=seed, **settings)
        wrapped.targets(name)
        wrapped.refuse_output(target, overwrite=overwrite, networks_move=config.steps > 0 and config.rates.networks > 0, viewer=name)
    settings |= dict(recipe=recipe, seed=seed, images=images and scene(images))
    reports = [_saved(adapted, target, overwrite, quiet=json) for adapted, target in _adapted(wrapped, wanted, targets, settings)]
    if json:
        tell(reports, json)


def _adapted(
    wrapped: Wrapped, wanted: Sequence[tuple[float, str | None]], targets: Sequence[Path], settings: dict[str, Any]
) -> Iterator[tuple[Adapted, Path]]:
    """Each model as soon as it is adapted, and where it is to be saved."""
    from mipmap_plugin.wrap import state_path

    for (scale, viewer), target in zip(wanted, targets, strict=True):
        yield wrapped.adapt(scale, viewer=viewer, resume=state_path(target), **settings), target


def _saved(adapted: Adapted, target: Path, overwrite: bool, *, quiet: bool) -> dict[str, Any]:
    """The report of an adapted model that is saved, and told of unless `quiet`."""
    saved = adapted.save(target, overwrite=overwrite)
    if not quiet:
        _print(saved, adapted)
    return {"file": str(saved), **adapted.report.model_dump()}


def _wanted(scales: list[float], viewers: tuple[str, ...]) -> list[tuple[float, str | None]]:
    """Each scale with each viewer, none twice."""
    names: list[str | None] = [*dict.fromkeys(viewers)] or [None]
    return [(scale, name) for scale in each_once(scales) for name in names]


def _made_for(model: SplatModel) -> str:
    """Whom a file is for that no viewer was asked for."""
    from mipmap_plugin.models.base import why_no_viewer

    made, others = "made for renderers that draw as 3DGS does (INRIA, gsplat, nerfstudio)", "; for others give --viewer spark, supersplat, ..."
    if why_no_viewer(model):
        return "made for its own project"
    return f"made for its own project, whose filter it keeps{others}" if model.trained.keeps_filter else f"{made}{others}"


def _print(saved: Path, adapted: Adapted) -> None:
    report = adapted.report
    print(f"x{report.scale:g}{f' in {report.viewer}' if report.viewer else ''}: {saved}")
    db = ", ".join(f"{name} {found:.2f}" for name, found in report.validation.items())
    print(f"  holds {report.returned}{f' (dB on views that nothing was adapted to: {db})' if db else ''}")
    if report.viewers:
        print(f"  in each viewer: {', '.join(f'{name} {found:.1f}' for name, found in report.viewers.items())} dB")
    if report.viewer is None:
        print(f"  {_made_for(adapted.model)}")
    print(f"  {report.seconds['total']:.1f} s, {report.gaussians_before:,} -> {report.gaussians_after:,} splats, ended by {report.ended_by}")
    if report.peak_memory_mib is not None:
        print(f"  at most {report.peak_memory_mib:,.0f} MiB on the GPU")
    print(f"  {report.views}; {report.filters}; backend {report.backend}")
