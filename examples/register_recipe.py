"""Register a recipe of your own; here: half of the steps of `default`, and slower changes of view-dependent colors.

    python examples/register_recipe.py output/bicycle --scale 1/4

A package registers it without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.recipes"]
    brief = "my_package.brief:brief"

and `mipmap-plugin adapt output/bicycle --scale 1/4 --recipe brief` uses it.
"""

from __future__ import annotations

import sys
from typing import Any

from mipmap_plugin import register_recipe
from mipmap_plugin.cli import main
from mipmap_plugin.recipes import default


def brief(scale: float, network: bool) -> dict[str, Any]:
    """The settings at a scale, by the names of mipmap_plugin.config.AdaptConfig; `network`: whether the upsampler is a network."""
    settings = default(scale, network)
    return {**settings, "steps": settings["steps"] // 2, "rates": settings["rates"].model_copy(update={"shN": settings["rates"].shN / 4})}


if __name__ == "__main__":
    register_recipe("brief", brief)
    sys.exit(main(["adapt", *sys.argv[1:], "--recipe", "brief"]))  # the command, which knows it now
