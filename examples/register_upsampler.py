"""Register your own upsampler, to adapt a zoom-in to its images; here: Lanczos with unsharp masking.

    python examples/register_upsampler.py output/bicycle --scale 2

A package registers it without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.upsamplers"]
    sharp = "my_package.sharp:sharp"

and `mipmap-plugin adapt output/bicycle --scale 2 --upsampler sharp` uses it.
"""

from __future__ import annotations

import sys

from torch import Tensor

from mipmap_plugin import register_upsampler
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.cli import main


def sharp(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize an image [H, W, 3] in 0..1 to `size` (height, width): [*size, 3]."""
    height, width, _ = image.shape
    blurred = resize(resize(image, ((height + 1) // 2, (width + 1) // 2), "area"), (height, width), "lanczos")
    return resize(image + 0.5 * (image - blurred), size, "lanczos").clamp(0, 1)


if __name__ == "__main__":
    register_upsampler("sharp", sharp)
    sys.exit(main(["adapt", *sys.argv[1:], "--upsampler", "sharp"]))  # the command, which knows it now
