"""Adapt a checkpoint in five lines, and look at one view before and after.

    python examples/adapt_checkpoint.py output/bicycle 1/4
"""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

from mipmap_plugin import wrap_model
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.models.adapted_name import adapted_name


def main(path: str, scale: float) -> None:
    model = wrap_model(path)
    adapted = model.adapt(scale)
    print(adapted.save(Path(path).with_name(adapted_name(Path(path), scale))))

    camera = model.views()[0].zoomed(scale)
    write_image("before.png", model.render(camera, scale).image, overwrite=True)
    write_image("after.png", adapted.render(camera).image, overwrite=True)


if __name__ == "__main__":
    main(sys.argv[1], float(Fraction(sys.argv[2])))
