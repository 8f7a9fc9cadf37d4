"""Every family end to end: loaded, rendered, adapted, saved, loaded again and compared with true images.

    python benchmarks/families.py
    python benchmarks/families.py --only octree --only gof --output /tmp/families

Makes a small scene of each family (family_scenes.py) in a temporary folder, adapts its base to x1/4 and x4 with the `default`
recipe, and evaluates the saved file. Prints a Markdown table and writes families.md and families.json.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import torch
import tyro
from family_scenes import FAMILIES, HELD_OUT_VIEWS, SIZE, TRAIN_VIEWS, Scene, make
from torch import Tensor

from mipmap_plugin import Camera, load_model, wrap_model
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import new_file, write_json
from mipmap_plugin.wrap import Wrapped

SCALES = {"×1/4": 1 / 4, "×4": 4.0}
STEPS = ("load", "render", "adapt", "save", "evaluate")

CAPTION = f"""# Every family on a generated scene

Made by `python benchmarks/families.py`: checkpoints in the families' own formats, {SIZE[0]} x {SIZE[1]} px at x1. The dB are
PSNR against true pictures: each scene's world is known, and is drawn without any dilation, sixteen times finer than x1, and averaged (at x1/4 the
picture of x1 is resized as photographs are, by Pillow's bicubic). The base has as many splats as its world and was trained on the pictures of
x1 in the family's own filter, so that gains are larger than on photographs. An entry reads: the base as it is → what the adapted file shows,
on the {TRAIN_VIEWS} views adapted to · on {HELD_OUT_VIEWS} views that nothing was trained or adapted on. Recipe `default`; seconds on one thread of a
shared, busy machine.
"""

T = TypeVar("T")


@dataclass(frozen=True)
class Quality:
    """Mean PSNR in dB against the true pictures."""

    adapted_to: float
    held_out: float


@dataclass(frozen=True)
class Change:
    """One scale of one family."""

    base: Quality
    adapted: Quality
    against_base: list[float] | None  # zoom-out, held out: the same two against the base's own render, resized


@dataclass(frozen=True)
class Row:
    """One family."""

    family: str
    limit: str
    at_x1: Quality
    seconds: dict[str, float]  # of each of load, render, adapt, save and evaluate
    changes: dict[str, Change]  # by scale


def main(only: tyro.conf.UseAppendAction[tuple[str, ...]] = (), output: Path = Path("benchmarks/results")) -> None:
    """Measure, print the table and write it.

    Args:
        only: Which families; all by default.
        output: Where families.md and families.json go.
    """
    if unknown := set(only) - FAMILIES.keys():
        sys.exit(f"there is no family {', '.join(unknown)}; known are {', '.join(FAMILIES)}")
    rows = []
    for family in only or FAMILIES:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(family, Path(folder)))
        print(f"{rows[-1].family} done", file=sys.stderr, flush=True)
    print(table(rows))
    write_json(output / "families.json", [asdict(row) for row in rows], overwrite=True)
    with new_file(output / "families.md", overwrite=True) as temporary:
        temporary.write_text(f"{CAPTION}\n{table(rows)}\n", encoding="utf-8")


def measure(family: str, folder: Path) -> Row:
    """One family, from its file to its file."""
    scene, kind = make(family, folder), FAMILIES[family]
    load, model = timed(partial(load_model, scene.base))
    base = wrap_model(model, cameras=scene.train)
    base.render(scene.train[0])  # the first image compiles the backend's kernels
    render, _ = timed(partial(base.render, scene.train[0]))
    seconds: list[tuple[float, ...]] = []
    changes: dict[str, Change] = {}
    for name, scale in SCALES.items():
        file = folder / f"adapted_{len(changes)}"
        adapt, adapted = timed(partial(base.adapt, scale))
        save, _ = timed(partial(adapted.save, file))
        evaluate, changes[name] = timed(partial(compare, scene, base, file, scale))
        seconds.append((load, render, adapt, save, evaluate))
    means = {step: fmean(durations) for step, durations in zip(STEPS, zip(*seconds, strict=True), strict=True)}
    return Row(kind.name, kind.limit, quality(scene, lambda view: base.render(view).image, 1.0), means, changes)


def compare(scene: Scene, base: Wrapped, file: Path, scale: float) -> Change:
    """Compare the base and the adapted file with the truth, each rendered by its own convention."""
    adapted = wrap_model(file, cameras=[])
    shows = [lambda view, model=model: model.render(view.zoomed(scale)).image for model in (base, adapted)]
    qualities = [quality(scene, show, scale) for show in shows]
    against_base = None
    if scale < 1:
        targets = {view: resize(base.render(view).image.clamp(0, 1), view.zoomed(scale).size, "pil-bicubic") for view in scene.held_out}
        against_base = [fmean(psnr(show(view), target) for view, target in targets.items()) for show in shows]
    return Change(qualities[0], qualities[1], against_base)


def quality(scene: Scene, show: Callable[[Camera], Tensor], scale: float) -> Quality:
    return Quality(*(fmean(psnr(show(view), scene.pictures(view, scale)) for view in views) for views in (scene.train, scene.held_out)))


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Seconds, and the result."""
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


def table(rows: Sequence[Row]) -> str:
    head = ["family", *STEPS, *(f"{name}, dB" for name in SCALES), "limit"]
    body = [[row.family, *(_duration(seconds) for seconds in row.seconds.values()), *map(_change, row.changes.values()), row.limit] for row in rows]
    return markdown(head, body)


def _change(change: Change) -> str:
    pairs = [(getattr(change.base, views), getattr(change.adapted, views)) for views in ("adapted_to", "held_out")]
    return " · ".join(f"{before:.1f} → {after:.1f}" for before, after in pairs)


def _duration(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(main)
