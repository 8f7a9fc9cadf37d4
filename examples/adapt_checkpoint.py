"""Adapt a checkpoint in five lines, and look at one view before and after.

    python examples/adapt_checkpoint.py output/bicycle 1/4
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from mipmap_plugin import MipmapPluginError, wrap_model
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.types import Scale
from mipmap_plugin.formats.images import write_image


def main(path: tyro.conf.Positional[Path], scale: tyro.conf.Positional[Scale]) -> None:
    model = wrap_model(path)
    adapted = model.adapt(scale)
    print(adapted.save(adapted_path(path, None, scale, several=False)))

    camera = model.views()[0].zoomed(scale)
    write_image("before.png", model.render(camera, scale).image, overwrite=True)
    write_image("after.png", adapted.render(camera).image, overwrite=True)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except MipmapPluginError as error:  # whose text says what is wrong, and what to do
        print(error, file=sys.stderr)
        sys.exit(2)
