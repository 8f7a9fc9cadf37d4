"""The command line: thin commands over the library. Exit codes: 0 done, 2 one sentence says what is wrong, 130 interrupted."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import tyro

from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.camera import Camera
from mipmap_plugin.cli_outputs import adapted_path, picture_names
from mipmap_plugin.cli_types import Background, Checkpoint, Scale, Scales, ScreenFilter, each_once
from mipmap_plugin.config import Recipe, ResizeFilter, ViewPolicy
from mipmap_plugin.effects import explain
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.files import refuse_existing, write_json
from mipmap_plugin.models import load_model
from mipmap_plugin.models.anchors import AnchorModel
from mipmap_plugin.models.health import examine
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.scenes.images import write_image
from mipmap_plugin.wrap import Wrapped, wrap_model

app = tyro.extras.SubcommandApp()


@app.command
def inspect(checkpoint: Checkpoint, iteration: int | None = None, screen_filter: ScreenFilter | None = None, json: bool = False) -> None:
    """Say what a checkpoint is, what it calls for, and what is wrong with it.

    Args:
        checkpoint: A PLY or a model folder.
        iteration: Which iteration of a model folder; the newest by default.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        json: Print JSON instead of sentences.
    """
    model = load_model(checkpoint, iteration=iteration)
    wrapped = wrap_model(model, screen_filter=screen_filter)
    view = wrapped.views()[0]
    gaussians = model.gaussians(view)
    facts = {
        "file": str(model.source),
        "family": model.family,
        "splats": len(gaussians),
        "sh degree": f"{gaussians.used_sh_degree()} in use of {gaussians.sh_degree}",
        "trained with": f"{wrapped.trained.screen_filter}, {wrapped.trained.eps2d:g} px², background {wrapped.background}",
        "cameras": _summary(wrapped.cameras),
        "effects": [f"{e.name}: {'on' if e.on else 'off'}, {e.reason}" for e in explain(wrapped.effects(), gaussians)],
        "health": examine(model.bake(view) if isinstance(model, AnchorModel) else model).sentences() or ["nothing found"],
        "notes": model.notes,
    }
    _tell(facts, json)


@app.command
def adapt(
    checkpoint: Checkpoint,
    scale: Scales,
    output: Path | None = None,
    recipe: Recipe = "default",
    views: ViewPolicy | None = None,
    cameras: Path | None = None,
    steps: int | None = None,
    time_budget_s: float | None = None,
    resize: ResizeFilter | None = None,
    upsampler: str | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    seed: int = 0,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Make a checkpoint that looks right at another scale, in any viewer.

    Args:
        checkpoint: A PLY or a model folder.
        scale: Target focal length over base focal length, such as 1/4 or 4. May be given several times.
        output: Where to write; by default beside the checkpoint, as NAME_x0.25. Several scales: a folder for all of them.
        recipe: default; paper (the published code, quirk by quirk); instant (closed form only).
        views: Which views to adapt to; by default what the recipe says.
        cameras: A cameras.json, a transforms file or a COLMAP scene, where the checkpoint has none beside it.
        steps: Optimizer steps at most.
        time_budget_s: Seconds at most.
        resize: Filter that makes the base image smaller.
        upsampler: What makes the base image larger, by name.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: A backend's name; auto takes the fastest that can do it.
        seed: Everything random follows from it.
        overwrite: Replace outputs that exist.
        json: Print the reports as JSON.
    """
    wrapped = _wrap(checkpoint, cameras, background, backend, screen_filter)
    chosen: dict[str, Any] = dict(views=views, steps=steps, time_budget_s=time_budget_s, resize=resize, upsampler=upsampler)
    settings = {name: value for name, value in chosen.items() if value is not None}
    scales = each_once(scale)
    targets = [adapted_path(checkpoint, output, each, len(scales) > 1) for each in scales]
    for target in targets:
        refuse_existing(target, overwrite)
    reports = []
    for each, target in zip(scales, targets, strict=True):
        adapted = wrapped.adapt(each, recipe=recipe, seed=seed, resume=target.with_name(target.name + ".resume"), **settings)
        saved = adapted.save(target, overwrite=overwrite)
        report = adapted.report
        reports.append({"file": str(saved), **report.model_dump()})
        if not json:
            print(f"x{each:g}: {saved}")
            print(f"  {report.seconds['total']:.1f} s, {report.gaussians_before:,} -> {report.gaussians_after:,} splats, ended by {report.ended_by}")
            print(f"  {report.views}; {report.filters}; backend {report.backend}")
    if json:
        _tell(reports, json)


@app.command
def render(
    checkpoint: Checkpoint,
    output: Path,
    scale: Scale = 1.0,
    view: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    screen_filter: Literal["trained", "scaled", "classic", "antialiased", "mip", "analytic"] = "trained",
    supersampling: int = 1,
    cameras: Path | None = None,
    background: Background | None = None,
    backend: str = "auto",
    overwrite: bool = False,
) -> None:
    """Render views of a checkpoint as PNG files.

    Args:
        checkpoint: A PLY or a model folder.
        output: The folder for the pictures.
        scale: Zoom, relative to the cameras.
        view: Name of a view; may be given several times. By default all test views, or all if there are none.
        screen_filter: trained: what the checkpoint was trained with; scaled: the training-free filter for this scale.
        supersampling: N: N x N samples a pixel.
        cameras: A cameras.json, a transforms file or a COLMAP scene, where the checkpoint has none beside it.
        background: Of the scene; by default what the checkpoint says, else black.
        backend: A backend's name; auto takes the fastest that can do it.
        overwrite: Replace pictures that exist.
    """
    wrapped = _wrap(checkpoint, cameras, background, backend)
    views = _named(wrapped, view)
    names = picture_names(views)
    for name in names:
        refuse_existing(output / name, overwrite)
    for camera, name in zip(views, names, strict=True):
        image = wrapped.render(camera.zoomed(scale), scale, None if screen_filter == "trained" else screen_filter, supersampling).image
        write_image(output / name, image, overwrite=overwrite)
    print(f"{len(views)} pictures in {output}")


@app.command
def evaluate(
    checkpoint: Checkpoint,
    images: Path,
    scale: Scales,
    recipe: tyro.conf.UseAppendAction[tuple[Recipe, ...]] = (),
    protocol: Literal["P1", "P2", "P3"] = "P3",
    steps: int | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    seed: int = 0,
    output: Path | None = None,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Judge a checkpoint against real images: as it is, with training-free filters, resized, and adapted.

    Args:
        checkpoint: A PLY or a model folder; its cameras tell the base scale.
        images: Folder of the scene (transforms_*.json or COLMAP's sparse/0, and the images).
        scale: Target over base, such as 1/4 or 4; 1 is the base itself. May be given several times.
        recipe: Adapt with this recipe, once on views that are not judged on and once on those that are; may be given several times.
        protocol: How a photograph becomes the truth at another scale: P1 box, truncated; P2, P3 Pillow's bicubic.
        steps: Optimizer steps at most, instead of the recipe's.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: A backend's name; auto takes the fastest that can do it.
        seed: Everything random follows from it.
        output: Also write the rows as JSON to this file.
        overwrite: Replace that file if it exists.
        json: Print JSON instead of a table.
    """
    from mipmap_plugin.evaluation.evaluate import evaluate as rows_of
    from mipmap_plugin.evaluation.report import records, table

    if output:
        refuse_existing(output, overwrite)
    wrapped = _wrap(checkpoint, None, background, backend, screen_filter)
    overrides: dict[str, Any] = {"seed": seed} | ({} if steps is None else {"steps": steps})
    rows = rows_of(wrapped, load_scene(images), each_once(scale), recipe, protocol, **overrides)
    if output:
        write_json(output, records(rows), overwrite)
    if json:
        _tell(records(rows), json)
    else:
        print(f"{checkpoint}, truth: {protocol} from {images}, real dB over the test views")
        print(table(rows))


@app.command
def backends(check: str | None = None, json: bool = False) -> None:
    """List the backends and what each lacks for this machine's usual work, or check one against the reference.

    Args:
        check: Run the conformance suite on this backend and print a table.
        json: Print JSON.
    """
    from mipmap_plugin.evaluation import backends as shown

    if check is None:
        listed = shown.listing()
        print(shown.listing_table(listed)) if not json else _tell([asdict(row) for row in listed], json)
        return
    outcomes = shown.check(check)
    print(shown.check_table(outcomes)) if not json else _tell([asdict(row) for row in outcomes], json)
    failed = [row.case for row in outcomes if not row.passed]
    if failed:
        raise SettingsError(f"backend {check!r} fails {len(failed)} of {len(outcomes)} cases: {', '.join(failed[:5])}")


@app.command
def demo(output: Path = Path("mipmap-demo"), scale: tyro.conf.UseAppendAction[tuple[Scale, ...]] = (), overwrite: bool = False) -> None:
    """Adapt the embedded scene at x1/4 and x4, write before/after pictures and print a table.

    Args:
        scale: Other scales, instead of 1/4 and 4; may be given several times.
        output: The folder for the pictures.
        overwrite: Replace files that exist there.
    """
    from mipmap_plugin.demo.run import run_demo

    print(run_demo(output, scale or (0.25, 4.0), overwrite=overwrite))


def _wrap(
    checkpoint: Path, cameras: Path | None, background: Background | None, backend: str, screen_filter: ScreenFilter | None = None
) -> Wrapped:
    if backend != "auto":
        BACKENDS.get(backend)
    given = None if cameras is None else load_scene(cameras, read_options(checkpoint)[0])
    color = {None: None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}[background]
    return wrap_model(checkpoint, cameras=given, backend=backend, background=color, screen_filter=screen_filter)


def _summary(cameras: Sequence[Camera]) -> str:
    if not cameras:
        return "none beside the checkpoint"
    return f"{len(cameras)}, {cameras[0].width} x {cameras[0].height} px, {sum(c.split == 'test' for c in cameras)} of them test views"


def _named(wrapped: Wrapped, names: Sequence[str]) -> list[Camera]:
    cameras = wrapped.views()
    if not names:
        return [c for c in cameras if c.split == "test"] or cameras
    found = [c for c in cameras if c.name in names]
    if missing := set(names) - {c.name for c in found}:
        some = ", ".join(c.name for c in cameras[:5])
        raise SettingsError(f"there is no view {', '.join(sorted(missing))}; the first of {len(cameras)} are {some}")
    return found


def _tell(facts: Any, as_json: bool) -> None:
    if as_json:
        print(json.dumps(facts, indent=2, default=str))
        return
    for name, value in facts.items():
        lines = value if isinstance(value, list) else [value]
        for line in lines:
            print(f"{name + ':' if name else '':14}{line}")
            name = ""


def main(arguments: Sequence[str] | None = None) -> int:
    """The entry point; returns the exit code."""
    try:
        app.cli(prog="mipmap-plugin", description="Make a Gaussian-splatting checkpoint look right at another zoom.", args=arguments)
    except (MipmapPluginError, OSError) as error:
        print(f"mipmap-plugin: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"\nmipmap-plugin: {str(interrupt) or 'interrupted'}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
