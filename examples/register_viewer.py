"""Register the viewer that you use, to adapt files for it: one record.

    python examples/register_viewer.py output/bicycle --scale 1/4

A package registers it without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.viewers"]
    kiosk = "my_package.kiosk:KIOSK"

and `mipmap-plugin adapt output/bicycle --scale 1/4 --viewer kiosk` makes a file for it.
"""

from __future__ import annotations

import sys

from mipmap_plugin import register_viewer
from mipmap_plugin.cli import main
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.viewers import Viewer

KIOSK = Viewer(
    "kiosk", "The kiosk in our hall", "kiosk.glsl of 2026-11", "classic", eps2d=0.5, settings=RenderSettings(min_alpha=1 / 255), sh_degree=1
)  # fmt: skip

if __name__ == "__main__":
    register_viewer("kiosk", KIOSK)
    sys.exit(main(["adapt", *sys.argv[1:], "--viewer", "kiosk"]))  # the command, which knows it now
