"""An unbounded scene, of which there are no photographs: how close its views stay to the base's own, on cameras that nothing was adapted to.

    python benchmarks/unbounded.py DATA --only 0.25

DATA holds `checkpoints/flowers_r8`. At x1/4 an image is compared with the base's, resized. At x2, for which cameras are half as large, it is
shrunk and compared with the base's; Lanczos takes a network's place. Every 24th camera is held out. Writes unbounded/x<scale>.json for
each scale, and unbounded.md from both. Half a minute to ten minutes a row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from pages import write_page
from torch import Tensor

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.adaptation.resize import resize
from mipmap_plugin.adaptation.upsamplers import register_upsampler
from mipmap_plugin.evaluation.evaluate import Judge
from mipmap_plugin.evaluation.protocols import Protocol
from mipmap_plugin.evaluation.report import records, table
from mipmap_plugin.files import write_json

INTRO = """# An unbounded scene

Made by `python benchmarks/unbounded.py DATA`: flowers of mip-NeRF 360, judged on cameras that nothing was adapted to, by how close their
views are to the base's own: at x1/4 resized; at x2 (of cameras half as large) the view is shrunk. Lanczos takes a network's place there.
One thread of a shared machine.
"""
HELD_OUT = 24  # one camera of so many

# By scale: the share of the cameras' size that is the base's, and the settings of each row.
LANCZOS = dict(upsampler="lanczos as a network")
ROWS: dict[float, tuple[float, dict[str, dict[str, Any]]]] = {
    0.25: (1.0, {"closed form": dict(recipe="instant"), "default": {}, "default, nothing merged": dict(merge_to=1.0)}),
    2.0: (0.5, {
        "closed form": dict(recipe="instant"),
        "default": LANCZOS,
        "thorough": dict(LANCZOS, recipe="thorough"),
        "thorough, not on trial": dict(LANCZOS, recipe="thorough", densify_on_trial=False),
    }),
}  # fmt: skip


@dataclass(frozen=True)
class BaseView:
    """A camera, and the base's own image as its truth."""

    camera: Camera
    image: Tensor

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        return resize(self.image, self.camera.zoomed(min(scale, 1.0)).size, "pil-bicubic")


def no_larger(render: Callable[[Camera], Tensor], scale: float) -> Callable[[Camera], Tensor]:
    """What a camera of the base scale sees at `scale`, shrunk to the base's size where it is larger."""
    return lambda camera: resize(render(camera.zoomed(scale)).clamp(0, 1), camera.zoomed(min(scale, 1.0)).size, "pil-bicubic")


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/.
        output: Where the results go; those of scales that were measured before are replaced.
        only: Which scales, 0.25 or 2; both by default.
    """
    torch.set_num_threads(1)
    register_upsampler(LANCZOS["upsampler"], lambda image, size: resize(image, size, "lanczos"))
    base = wrap_model(data / "checkpoints" / "flowers_r8")
    for scale in only or ROWS:
        share, settings = ROWS[scale]
        cameras = [replace(camera.zoomed(share), split="train") for camera in base.cameras]
        with torch.no_grad():
            views = [BaseView(camera, base.render(camera).image.clamp(0, 1)) for camera in cameras[::HELD_OUT]]
        others = [camera for camera in cameras if camera not in cameras[::HELD_OUT]]
        judge = Judge(views, Protocol("base", "pil-bicubic", truncate=False))
        rows = []
        for name, chosen in settings.items():
            adapted = base.adapt(scale, cameras=others, **chosen)
            facts = dict(adapt_seconds=adapted.report.seconds["total"], gaussians=adapted.report.gaussians_after, adapted_on=adapted.report.views)
            rows.append(judge.row(name, scale, no_larger(lambda camera, made=adapted: made.render(camera).image, scale), **facts))
            print(table(rows[-1:]), adapted.report.ended_by, flush=True)
        write_json(output / "unbounded" / f"x{scale:g}.json", records(rows), overwrite=True)
    write_page(output / "unbounded.md", INTRO, output.glob("unbounded/*.json"))


if __name__ == "__main__":
    tyro.cli(main)
