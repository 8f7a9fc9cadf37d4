"""`mipmap-plugin evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from mipmap_plugin.commands.common import given, tell, wrap
from mipmap_plugin.commands.types import Background, Scales, ScreenFilter, each_once
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
    """Judge checkpoints against real images: as they are, with training-free filters, resized, and adapted.

    Args:
        checkpoint: A PLY or a model folder, whose cameras tell the base scale; or several, which are also averaged.
        images: Folder of the scene (transforms_*.json or COLMAP's sparse/0, and the images), one for each checkpoint.
        scale: Target over base, such as 1/4 or 4; 1 is the base itself. May be given several times.
        recipe: Adapt with it (default, thorough, instant, paper), on the checkpoint's training views and on those that are judged. Several: each.
        viewer: What files are adapted for, and draws them and the base: spark, supersplat, ...; portable: the viewer that shows each worst.
        protocol: The truth at another scale: P1 box, cut off; P3 Pillow's bicubic on 8 bits; P4 the folders images_2, images_4, ... of COLMAP.
        lpips: Also measure LPIPS, with AlexNet or VGG; vgg-01 feeds images in 0..1, which is not LPIPS' definition but what the papers do.
        lpips_weights: The backbone's weights, as torchvision saves them; by default they are downloaded, once.
        published: Also print what papers published for this data set.
        steps: Optimizer steps at most, instead of the recipe's.
        upsampler: What makes the base image larger, by name or the file of a network.
        appearance: Of test views, where each training view has one: their mean, or upstream's, which is that of the view with the same number.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: A backend's name; auto takes the fastest that can do it.
        threads: Processor threads at most; by default as many as torch finds. The result does not depend on it.
        seed: Everything random follows from it.
        output: Also write the rows, and notes on what they lack, as JSON to this file.
        overwrite: Replace that file if it exists.
        json: Print JSON instead of a table.
    """
    from mipmap_plugin.evaluation import evaluate as evaluation

    _refuse(checkpoint, images, output, overwrite)
    perceptual = _perceptual(lpips, lpips_weights)
    settings = given(seed=seed, steps=steps, upsampler=upsampler, viewer=viewer)
    rows, notes = list[Any](), dict[str, None]()  # notes each once, in their order
    for each, folder in zip(checkpoint, images, strict=True):
        wrapped, scene = wrap(each, None, background, backend, screen_filter, threads), _scene(folder, appearance)
        rows += evaluation.evaluate(wrapped, scene, each_once(scale), recipe, protocol, perceptual, **settings)
        notes |= dict.fromkeys(evaluation.notes(wrapped, scale, appearance))
    rows += evaluation.means(rows) if len(checkpoint) > 1 else []
    if output:
        write_json(output, _facts(rows, [*notes]), overwrite)
    tell(_facts(rows, [*notes]), json) if json else _print_tables(_title(checkpoint, images, protocol), rows, [*notes], published, each_once(scale))


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
        refuse_output(output, overwrite, [part for each in checkpoint for part in _parts(each)], is_file=True)
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
