"""`mipmap-plugin evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from mipmap_plugin.commands.common import print_facts, without_none, wrap
from mipmap_plugin.commands.types import Background, Scales, ScreenFilter, unique_scales
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import refuse_output, refuse_unwritable, write_json

if TYPE_CHECKING:
    from mipmap_plugin.evaluation.perceptual import Perceptual
    from mipmap_plugin.scenes import Scene


def evaluate(
    checkpoint: tyro.conf.Positional[tuple[Path, ...]],
    images: tuple[Path, ...],
    scale: Scales,
    recipe: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: str | None = None,
    protocol: Literal["P1", "P3", "P4"] = "P3",
    lpips: Literal["alex", "vgg", "vgg-01"] | None = None,
    lpips_weights: Path | None = None,
    published: Literal["nerf-synthetic", "mip-nerf-360"] | None = None,
    steps: int | None = None,
    upsampler: str | None = None,
    appearance: Literal["mean", "upstream"] = "mean",
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    threads: int | None = None,
    seed: int = 0,
    output: Path | None = None,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Evaluate checkpoints against real images: as they are, with training-free filters, resized, and adapted.

    Args:
        checkpoint: A PLY or a model folder with its cameras, which define the base scale. Required; the results of several are also averaged.
        images: Folder of the scene (transforms_*.json or COLMAP's sparse/0, and the images), one for each checkpoint.
        scale: Target focal length over base focal length, such as 1/4 or 4; 1 is the base itself. Required; may be given several times.
        recipe: Also adapt: default, thorough (more steps and views), instant (closed form only), paper (published method), or a registered one.
        viewer: Viewer to adapt files for, and to render them and the base as: spark, supersplat, ...; portable: the worst of all viewers.
        protocol: How photographs are resized: P1 box filter, truncated to 8 bits; P3 Pillow's bicubic on 8 bits; P4 COLMAP's folders images_2, ...
        lpips: Also measure LPIPS, with AlexNet or VGG; vgg-01 takes images in 0..1, as papers of this field do, though LPIPS is defined on -1..1.
        lpips_weights: File of the backbone's weights, as torchvision saves them; by default they are downloaded once.
        published: Also print the results that papers published for this data set.
        steps: Maximum number of optimizer steps, instead of the recipe's.
        upsampler: What makes base images larger: a registered name, or the file of a network.
        appearance: Appearance of test views, if training views have their own: mean of these, or upstream (of the view with the same number).
        background: Of the scene; by default that of the checkpoint, or else black.
        screen_filter: The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: Name of a backend; auto chooses the fastest one that can serve the request.
        threads: Maximum number of processor threads; by default as many as torch finds. With the backend cpu the result does not depend on it.
        seed: Seed of everything random.
        output: Also write the rows, and notes on missing ones, as JSON to this file.
        overwrite: Replace that file if it exists.
        json: Print JSON instead of a table.
    """
    from mipmap_plugin.evaluation import evaluate as evaluation

    _refuse(checkpoint, images, output, overwrite)
    perceptual, settings = _perceptual(lpips, lpips_weights), without_none(seed=seed, steps=steps, upsampler=upsampler, viewer=viewer)
    rows, notes = list[Any](), dict[str, None]()  # notes each once, in their order
    for path, folder in zip(checkpoint, images, strict=True):
        wrapped, scene = wrap(path, None, background, backend, screen_filter, threads), _scene(folder, appearance)
        rows += evaluation.evaluate(wrapped, scene, unique_scales(scale), recipe, protocol, perceptual, **settings)
        notes |= dict.fromkeys(evaluation.notes(wrapped, scale, appearance))
    rows += evaluation.means(rows) if len(checkpoint) > 1 else []
    facts, title = _facts(rows, [*notes]), _title(checkpoint, images, protocol)
    if output:
        write_json(output, facts, overwrite)
    print_facts(facts, json) if json else _print_tables(title, rows, [*notes], published, unique_scales(scale))


def _perceptual(network: Literal["alex", "vgg", "vgg-01"] | None, weights: Path | None) -> Perceptual | None:
    from mipmap_plugin.evaluation.perceptual import Perceptual

    return Perceptual(network, weights) if network else None


def _facts(rows: Sequence[Any], notes: Sequence[str]) -> dict[str, Any]:
    from mipmap_plugin.evaluation.report import records

    return {"rows": records(rows), "notes": list(notes)}


def _scene(folder: Path, appearance: str) -> Scene:
    from mipmap_plugin.scenes import load_scene

    scene = load_scene(folder)
    return scene.numbered_as_upstream() if appearance == "upstream" else scene


def _refuse(checkpoint: Sequence[Path], images: Sequence[Path], output: Path | None, overwrite: bool) -> None:
    if output:
        refuse_output(output, overwrite, [part for path in checkpoint for part in _parts(path)], is_file=True)
        refuse_unwritable(output)
    if len(checkpoint) != len(images):
        raise SettingsError(f"{len(checkpoint)} checkpoints and {len(images)} folders of images; give one folder for each checkpoint")


def _title(checkpoint: Sequence[Path], images: Sequence[Path], protocol: str) -> str:
    return f"{_listed(checkpoint)}; truth: {protocol} from {_listed(images)}, real dB over the test views"


def _parts(checkpoint: Path) -> list[Path]:
    from mipmap_plugin.models.outputs import parts_of

    return parts_of(None, checkpoint) if checkpoint.is_dir() else [checkpoint]


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


def _print_tables(title: str, rows: Sequence[Any], notes: Sequence[str], dataset: Any, scales: list[float]) -> None:
    from mipmap_plugin.evaluation.published import TITLE, published
    from mipmap_plugin.evaluation.report import published_table, table

    print("\n".join([title, table(rows), *notes]))
    if dataset:
        print(f"\npublished, {TITLE[dataset]}; rows of different protocols are not comparable")
        print(published_table(published(dataset, scales)))
