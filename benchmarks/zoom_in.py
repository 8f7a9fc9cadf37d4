"""What super-resolution networks add to a zoom-in: adapted models and the enlarged images themselves, against real test images.

    python benchmarks/zoom_in.py DATA --only lego_100 --output benchmarks/results

DATA holds `checkpoints/bases/<scene>_<px>` (3DGS model folders), `images/<scene>` (NeRF-Synthetic folders), `upsamplers/*` (networks that
spandrel loads) and `lpips/alexnet_features_fp16.pth`. Writes zoom_in/<base>.json for each base, and zoom_in.md from all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
import tyro
from pages import write_page

from mipmap_plugin import load_scene, wrap_model
from mipmap_plugin.evaluation.evaluate import Judge, Row, adapted_row
from mipmap_plugin.evaluation.measure import BASE, resized_base, warm_up
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.evaluation.protocols import PROTOCOLS, test_views
from mipmap_plugin.evaluation.report import records, table
from mipmap_plugin.files import write_json
from mipmap_plugin.wrap import Wrapped

INTRO = """# Zoom-in with super-resolution networks

Made by `python benchmarks/zoom_in.py DATA`. Protocol P3, mean of the test views, nothing adapted to any of them. X2.pt and X4.pt are DCTLSA
transformers, realesr-animevideov3.pth is a GAN that is worse in dB than bicubic. *Enlarged by* is the network's image of the base's,
no splat touched. Seconds on one thread of a shared machine, those to enlarge the views among them (about 1 s a view with a transformer,
and an empty cache). The *base* as it is can have the better LPIPS, for its needles are crisp.

`thorough` clones and splits splats to the end and asks for contrasts as strong as the network's, which is what LPIPS asks for. It runs
after `default`, and finds half of its images in the cache.
"""


# At x2 the x2 network, at x4 the x4 one; the GAN, which enlarges four times, at both.
NETWORKS = {2: ("X2.pt", "realesr-animevideov3.pth"), 4: ("X4.pt", "realesr-animevideov3.pth")}


def rows_of(model: Wrapped, judge: Judge, scale: float, networks: list[Path], steps: int | None) -> list[Row]:
    """The base as it is, the closed form, the recipe without a network, and for each network its own image and the recipe with it."""
    count = len(model.model.gaussians(model.any_camera()))
    limit = {} if steps is None else {"steps": steps}

    def enlarged(by: str) -> Row:
        show = lambda camera: resized_base(model.render(camera).image, camera.zoomed(scale).size, shrink_by=judge.protocol.shrink_by, upsampler=by)  # noqa: E731
        return judge.row(f"enlarged by {Path(by).name}", scale, show, gaussians=count)

    warm_up(model, scale, model.cameras)
    rows = [judge.row(BASE, scale, lambda camera: model.render(camera.zoomed(scale), scale).image, gaussians=count)]
    rows += [adapted_row("closed form", model.adapt(scale, recipe="instant", views="train"), judge), enlarged("bicubic")]
    rows.append(adapted_row("default", model.adapt(scale), judge))
    for network in networks:
        rows.append(enlarged(str(network)))
        for recipe in ("default", "thorough"):
            adapted = model.adapt(scale, recipe=recipe, upsampler=str(network), **limit)
            rows.append(adapted_row(f"{recipe} + {network.name}", adapted, judge))
    return rows


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[Literal[2, 4], ...]] = (),
    steps: int | None = None,
    views: int = 25,
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/, images/, upsamplers/ and lpips/.
        output: Where the results go; rows of bases that were measured before are replaced.
        only: Which bases; by default lego_100 and chair_100.
        scale: Which scales; by default 2 and 4.
        steps: Steps with a network, instead of the recipe's.
        views: How many of the test views are judged.
    """
    torch.set_num_threads(1)
    perceptual = Perceptual("alex", data / "lpips" / "alexnet_features_fp16.pth")
    for base in only or ("lego_100", "chair_100"):
        model = wrap_model(data / "checkpoints" / "bases" / base)
        judged = test_views(load_scene(data / "images" / base.split("_")[0]), model.cameras[0], model.background)[:views]
        judge = Judge(judged, PROTOCOLS["P3"], perceptual, base)
        rows = []
        for each in scale or (2, 4):
            rows += rows_of(model, judge, each, [data / "upsamplers" / name for name in NETWORKS[each]], steps)
        write_json(output / "zoom_in" / f"{base}.json", records(rows), overwrite=True)
        print(f"{table(rows)}\n", flush=True)
    write_page(output / "zoom_in.md", INTRO, output.glob("zoom_in/*.json"))


if __name__ == "__main__":
    tyro.cli(main)
