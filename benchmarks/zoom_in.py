"""Zoom-in, dB against LPIPS: crispness, and what super-resolution networks add, against real test images.

    python benchmarks/zoom_in.py DATA --only lego_100 --output benchmarks/results
    python benchmarks/zoom_in.py DATA --no-networks    # the rows with networks are kept as they are

DATA holds `checkpoints/bases/<scene>_<px>` (3DGS model folders), `images/<scene>` (NeRF-Synthetic folders), `upsamplers/*` (networks that
spandrel loads) and `lpips/alexnet_features_fp16.pth`. Writes zoom_in/<base>.json for each base, and zoom_in.md and zoom_in.png
from all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
import tyro
from bases import judge_of
from rows import earlier, write_page, write_rows
from zoom_in_plot import draw

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation.evaluate import Evaluator, Row, adapted_row
from mipmap_plugin.evaluation.measure import BASE, adapt_alone, resized_base, splats_shown, warm_up
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.wrap import Wrapped

INTRO = """# Zoom-in: dB against LPIPS

Made by `python benchmarks/zoom_in.py DATA`. Protocol P3, mean of the test views, nothing adapted to any of them. X2.pt and X4.pt are DCTLSA
transformers, realesr-animevideov3.pth is a GAN that is worse in dB than bicubic. *Enlarged by* is the network's image of the base's,
no splat touched. Seconds on one thread of a shared machine, those to enlarge the views among them (about 1 s a view with a transformer,
and an empty cache).

The *base* as it is has 6 to 7.5 dB less than `default`. Its needles are crisp: at x4 nothing without a network has its LPIPS (the shaded
side). The setting `crispness` leads from wider splats (0) to more opaque ones (1), as far as their opacity can rise; steps that start there
keep their crispness. `instant` has 0.5 and `default` 0.75, the most dB or 0.02 less; the more, the better LPIPS. Rows with networks, which
begin at 0, are of a version that widened splats for their closest view; by hand `thorough + X2.pt` of lego and chair is within 0.1 dB and
0.001 of LPIPS of it.

![dB against LPIPS](zoom_in.png)

`thorough` clones and splits splats to the end and asks for contrasts as strong as the network's, which is what LPIPS asks for. It runs
after `default`, and finds half of its images in the cache.
"""

CRISPNESS = (0.0, 0.25, 0.5, 0.75, 1.0)

# At x2 the x2 network, at x4 the x4 one; the GAN, which enlarges four times, at both.
NETWORKS = {2: ("X2.pt", "realesr-animevideov3.pth"), 4: ("X4.pt", "realesr-animevideov3.pth")}


def rows_of(model: Wrapped, judge: Evaluator, scale: float) -> list[Row]:
    """The base as it is, its own image enlarged, and with each crispness the closed form and the recipe without a network."""
    warm_up(model, scale, model.cameras)
    base = lambda camera: model.render(camera.zoomed(scale), scale).image  # noqa: E731
    rows = [judge.row(BASE, scale, base, gaussians=splats_shown(model)), enlarged(model, judge, scale, "bicubic")]
    for each in CRISPNESS:
        instant = adapt_alone(model, scale, recipe="instant", views="train", crispness=each)
        rows.append(adapted_row(f"closed form, crispness {each:g}", instant, judge))
        rows.append(adapted_row(f"default, crispness {each:g}", adapt_alone(model, scale, crispness=each), judge))
    return rows


def network_rows(model: Wrapped, judge: Evaluator, scale: float, networks: list[Path], steps: int | None) -> list[Row]:
    """For each network its own image, and the recipes with it."""
    rows, limit = [], {} if steps is None else {"steps": steps}
    for network in networks:
        rows.append(enlarged(model, judge, scale, str(network)))
        for recipe in ("default", "thorough"):
            adapted = adapt_alone(model, scale, recipe=recipe, upsampler=str(network), **limit)
            rows.append(adapted_row(f"{recipe} + {network.name}", adapted, judge))
    return rows


def enlarged(model: Wrapped, judge: Evaluator, scale: float, by: str) -> Row:
    """The base's own image, made larger."""
    show = lambda camera: resized_base(model.render(camera).image, camera.zoomed(scale).size, shrink_by=judge.protocol.shrink_by, upsampler=by)  # noqa: E731
    return judge.row(f"enlarged by {Path(by).name}", scale, show, gaussians=splats_shown(model))


def kept(file: Path, scale: float) -> list[Row]:
    """The rows with networks of an earlier run."""
    return [row for row in earlier(file, Row) if row.scale == scale and any(name in row.name for name in NETWORKS[int(scale)])]


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[Literal[2, 4], ...]] = (),
    steps: int | None = None,
    views: int = 25,
    networks: bool = True,
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/, images/, upsamplers/ and lpips/.
        output: Where the results go; rows of bases that were measured before are replaced.
        only: Which bases; by default lego_100 and chair_100.
        scale: Which scales; by default 2 and 4.
        steps: Steps with a network, instead of the recipe's.
        views: How many of the test views are judged.
        networks: Whether the rows with networks are measured, instead of kept.
    """
    torch.set_num_threads(1)
    perceptual = Perceptual("alex", data / "lpips" / "alexnet_features_fp16.pth")
    for base in only or ("lego_100", "chair_100"):
        model = wrap_model(data / "checkpoints" / "bases" / base)
        judge = judge_of(model, data, base, views, perceptual)
        file, rows = output / "zoom_in" / f"{base}.json", []
        for each in scale or (2, 4):
            rows += rows_of(model, judge, each)
            files = [data / "upsamplers" / name for name in NETWORKS[each]]
            rows += network_rows(model, judge, each, files, steps) if networks else kept(file, each)
        write_rows(file, rows)
    measured = sorted(output.glob("zoom_in/*.json"))
    write_page(output / "zoom_in.md", INTRO, measured)
    draw(output / "zoom_in.png", {file.stem: earlier(file, Row) for file in measured})


if __name__ == "__main__":
    tyro.cli(main)
