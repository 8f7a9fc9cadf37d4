"""How like the viewer's own picture our render under its name is: dB between the two, of bases as they are.

    python benchmarks/viewer_likeness.py DATA
    python benchmarks/viewer_likeness.py DATA --viewer three --viewer viser

Needs what tests/browser/README.md installs, and viser. DATA is that of real_bases.py. Writes viewer_likeness.json and viewer_likeness.md.
Viewers that are not measured again keep their rows.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.wrap import Wrapped

sys.path.append(str(Path(__file__).parents[1] / "tests" / "browser"))

from browser import VIEWERS, Browser
from in_viser import drawn, in_viser

# Checkpoint: an object and an unbounded scene, the scales that they are seen at, and which views.
SCENES = {"bases/lego_200": ((1 / 4, 1.0, 2.0), slice(0, 200, 100)), "flowers_r8": ((1 / 4, 1.0), slice(0, 173, 87))}

VISER = "viser"

INTRO = """# How like a viewer's own picture ours is

Made by `python benchmarks/viewer_likeness.py DATA`: dB between our render under a viewer's name and the viewer's own picture of the same file, both
of 8 bits, from the least to the greatest of two views of lego_200 at x1/4, x1 and x2, and of flowers at x1/4 and x1; Chromium with software WebGL.
"""


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    viewer: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
) -> None:
    """Measure, and write the table.

    Args:
        data: The folder with checkpoints/.
        output: Where the results go.
        viewer: Which viewers; all by default.
    """
    torch.set_num_threads(1)
    file = output / "viewer_likeness.json"
    found = json.loads(file.read_text()) if file.exists() else {}
    for name in viewer or (*VIEWERS, VISER):
        with Browser() as browser:
            found[name] = {scene: likeness(browser, name, data / "checkpoints" / scene, scene) for scene in SCENES}
        print(name, found[name], flush=True)
        write_json(file, found, overwrite=True)
    rows = [[name, *(f"{min(all_db):.1f} to {max(all_db):.1f}" for all_db in found[name].values())] for name in (*VIEWERS, VISER) if name in found]
    (output / "viewer_likeness.md").write_text(f"{INTRO}\n{markdown(['in', *SCENES], rows)}\n")


def likeness(browser: Browser, viewer: str, checkpoint: Path, scene: str) -> list[float]:
    """dB of each view at each scale."""
    model, (scales, views) = wrap_model(checkpoint, threads=1), SCENES[scene]
    cameras = [camera.zoomed(scale) for scale in scales for camera in model.cameras[views]]
    if viewer == VISER:  # whose pixels are square
        cameras = [replace(camera, fx=camera.fy) for camera in cameras]
    ours = [render(model, camera, viewer) for camera in cameras]
    return [psnr(image, torch.from_numpy(picture)) for image, picture in zip(ours, pictures(browser, viewer, model, cameras), strict=True)]


def pictures(browser: Browser, viewer: str, model: Wrapped, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """The viewer's own."""
    if viewer != VISER:
        return browser.open(viewer, model.model.source).draw(cameras, model.background)
    with torch.no_grad(), in_viser(browser, model.model.gaussians(cameras[0])) as shown:
        return [drawn(*shown, camera, model.background) for camera in cameras]


@torch.no_grad()
def render(model: Wrapped, camera: Camera, viewer: str) -> torch.Tensor:
    """Our picture, in 8 bits."""
    return model.render(camera, viewer=viewer).image.clamp(0, 1).mul(255).round().div(255)


if __name__ == "__main__":
    tyro.cli(main)
