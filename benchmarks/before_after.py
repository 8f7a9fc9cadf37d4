"""The README's first picture: the demo's scene at x1/8 (pixels enlarged) and x4, as it is, adapted by the default recipe, and true.

python benchmarks/before_after.py
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro

from mipmap_plugin.demo.run import PROTOCOL, WorldView, embedded, shown
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.images import write_image


def main(output: Path = Path("docs/before_after.png"), seed: int = 0) -> None:
    """Adapt to both scales, print the dB of the view that is shown, and draw it.

    Args:
        output: A PNG file; replaced.
        seed: Of adapting.
    """
    base = embedded()
    view = WorldView(next(camera for camera in base.cameras if camera.split == "test"))
    rows = []
    for scale in (1 / 8, 4.0):
        camera, truth = view.camera.zoomed(scale), view.truth(scale, PROTOCOL)
        adapted = base.adapt(scale, seed=seed)
        before, after = base.render(camera).image, adapted.render(camera).image
        print(f"x{scale:g}: {psnr(before, truth):.1f} dB as it is, {psnr(after, truth):.1f} dB adapted in {adapted.report.seconds['total']:.0f} s")
        rows.append(shown([before, after, truth]))
    gap = torch.ones(12, rows[0].shape[1], 3)
    write_image(output, torch.cat([rows[0], gap, rows[1]]), overwrite=True)


if __name__ == "__main__":
    tyro.cli(main)
