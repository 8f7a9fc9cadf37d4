"""Name a set of settings of your own: half of the steps of `default`, and slower changes of colors that depend on the view, here.

    python examples/register_recipe.py output/bicycle 1/4

A package makes it known without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.recipes"]
    brief = "my_package.brief:brief"

and `mipmap-plugin adapt output/bicycle --scale 1/4 --recipe brief` follows it.
"""

from __future__ import annotations

import sys
from fractions import Fraction
from typing import Any

from mipmap_plugin import register_recipe, wrap_model
from mipmap_plugin.recipes import default


def brief(scale: float, network: bool) -> dict[str, Any]:
    """The settings at a scale, by the names of mipmap_plugin.config.AdaptConfig; `network`: whether one enlarges the base's images."""
    usual = default(scale, network)
    return {**usual, "steps": usual["steps"] // 2, "rates": usual["rates"].model_copy(update={"shN": usual["rates"].shN / 4})}


if __name__ == "__main__":
    register_recipe("brief", brief)
    print(wrap_model(sys.argv[1]).adapt(float(Fraction(sys.argv[2])), recipe="brief").save("brief.ply"))
