"""`mipmap-plugin list`."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Literal, get_args

import tyro

from mipmap_plugin.commands.common import print_facts, print_json, starting
from mipmap_plugin.errors import MipmapPluginError, warn

if TYPE_CHECKING:
    from mipmap_plugin.registry import Registry

# The groups of entry points that registries read, behind "mipmap_plugin."; a registry itself is not asked, which may import torch.
GROUPS = ("backends", "models", "recipes", "upsamplers", "viewers")

Kind = Literal["families", "recipes", "viewers", "backends", "upsamplers"]
KINDS: tuple[Kind, ...] = get_args(Kind)


def list_(kinds: tyro.conf.Positional[tuple[Kind, ...]] = (), json: bool = False) -> None:
    """List the families, recipes, viewers, backends and upsamplers, and those that installed packages add.

    Args:
        kinds: Only these; families and recipes are listed at once, the others after a moment.
        json: Print JSON.
    """
    warn_of_other_groups()
    if json:
        return print_json({each: _facts(each) for each in kinds or KINDS})
    for each in kinds or KINDS:
        facts = _facts(each)
        added = [f"{name}: {what}" for name, what in facts["of packages"].items()]
        refused = [f"recognized and refused: {', '.join(facts['refused'])}"] if facts.get("refused") else []
        print_facts({each: [", ".join(facts["built in"]), *refused, *added]})


def warn_of_other_groups() -> None:
    """Warn of packages whose entry points are in a group that nothing reads, as where its name is misspelled."""
    known, points = [f"mipmap_plugin.{kinds}" for kinds in GROUPS], entry_points()
    for group in sorted(points.groups):
        if group.startswith("mipmap_plugin.") and group not in known:
            names = ", ".join(sorted({f"{point.name} ({point.value})" for point in points.select(group=group)}))
            warn(f"{names}, in the group {group} of entry points, is not used: the groups are {', '.join(known)}")


def _facts(kind: Kind) -> dict[str, Any]:
    """What is known of a kind: names that are built in, and what packages add, with its place and what is wrong with it."""
    with starting():
        registry, find = registry_of(kind)
    added = {
        name: "; not used, as the name is the same: ".join([f"{first}{_trouble(name, registry, find)}", *others])
        for name, (first, *others) in registry.packages().items()
    }
    built_in = [name for name in registry.names() if registry.is_taken(name)]
    if kind != "families":
        return {"built in": built_in, "of packages": added}
    refused = [name for name in built_in if find(name).load is None]
    return {"built in": [name for name in built_in if name not in refused], "refused": refused, "of packages": added}


def registry_of(kind: Kind) -> tuple[Registry, Callable[[str], Any]]:
    """The registry of a kind, and what finds one by name and checks it."""
    if kind == "families":
        from mipmap_plugin.models.families import FAMILIES, find_family

        return FAMILIES, find_family
    if kind == "recipes":
        from mipmap_plugin.recipes import RECIPES, recipe

        return RECIPES, lambda name: [recipe(name, scale) for scale in (1 / 4, 4)]
    if kind == "viewers":
        from mipmap_plugin.splatting.viewers import VIEWERS, find_viewer, viewers_for

        return VIEWERS, lambda name: [find_viewer(member) for member in viewers_for(name)]
    if kind == "backends":
        from mipmap_plugin.backends import BACKENDS, get_backend

        return BACKENDS, get_backend
    from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS, find_upsampler

    return UPSAMPLERS, find_upsampler


def _trouble(name: str, registry: Registry, find: Callable[[str], Any]) -> str:
    """What is wrong with a plug-in, to be appended to where it is; "" if nothing is."""
    if registry.is_taken(name):
        return ", not used: the name is taken by a built-in one; choose another"
    try:
        find(name)
    except MipmapPluginError as error:
        return f", not used: {error}"
    return ""
