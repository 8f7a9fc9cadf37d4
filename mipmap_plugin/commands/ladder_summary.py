"""What `mipmap-plugin levels` prints: the manifest of a ladder, in lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from mipmap_plugin.commands.common import print_json
from mipmap_plugin.commands.pages import look_at
from mipmap_plugin.commands.voice import say
from mipmap_plugin.errors import plural
from mipmap_plugin.formats.here import size_in_bytes

# Viewers of three.js, for which a ladder's module is told of.
OF_THREE_JS = ("spark", "three")

# dB by which the base alone has to be better than a ladder for a line that says so.
LOST = 0.5


def print_summary(folder: Path, manifest: dict[str, Any], exports: Sequence[Path] = (), json: bool = False) -> None:
    """Print a ladder's manifest, as JSON or in lines."""
    from mipmap_plugin.models.places import PAGE

    if json:
        return print_json(manifest)
    lines = _distances(folder, manifest) if manifest.get("by") == "distance" else _zooms(folder, manifest)
    if missed := _below(manifest):
        lines.append(f"  {', '.join(missed)}: below the {manifest['least_db']:g} dB that were asked for, in the narrowest band that is tried")
    lines += _left_out(manifest)
    base = [point["base_db"] for point in manifest["curve"]]
    steps = [abs(each["step_db"]) for each in manifest["switches"] if "step_db" in each]
    changed = f", at most {max(steps):.1f} lost or gained at a switch" if steps else ""
    ladder = f"at worst {manifest['worst_db']:.1f} dB, {manifest['mean_db']:.1f} on average"
    lines.append(f"  {ladder}{changed}; the base alone: at worst {min(base):.1f} dB, {fmean(base):.1f} on average")
    lines += _behind(manifest)
    lines.append(f"  {manifest['measured']}")
    say("\n".join([*lines, *(look_at(path) if path.name == PAGE else f"  {path}" for path in exports)]))


def _behind(manifest: dict[str, Any]) -> list[str]:
    """A line on where the base alone is clearly better than the ladder, if it is anywhere."""
    lost = {point["zoom"]: point["base_db"] - point["psnr_db"] for point in manifest["curve"]}
    zooms = [zoom for zoom, db in lost.items() if db > LOST]
    where = " to ".join(dict.fromkeys(f"x{zoom:.3g}" for zoom in (max(zooms), min(zooms)))) if zooms else ""
    return [f"  at {where} the base alone is better, by up to {max(lost.values()):.1f} dB"] if zooms else []


def _below(manifest: dict[str, Any]) -> list[str]:
    """The levels that are shown with fewer dB than were asked for, which a ladder by distance is not asked for."""
    least = manifest.get("least_db")
    return [] if least is None else [level["file"] for level in manifest["levels"] if min(level["psnr_db"].values(), default=least) < least]


def _left_out(manifest: dict[str, Any]) -> list[str]:
    """A line for each reason why levels are left out."""
    scales = dict[str, list[str]]()
    for level in manifest.get("left_out", []):
        scales.setdefault(level["reason"], []).append(f"x{level['scale']:.3g}")
    return [f"  no level of its own at {', '.join(of)}, where a neighbor is shown: {reason}" for reason, of in scales.items()]


def _zooms(folder: Path, manifest: dict[str, Any]) -> list[str]:
    from mipmap_plugin.levels.manifest import THREE_JS
    from mipmap_plugin.splatting.viewers import own_name

    lines = [f"{folder}, for {manifest['viewer']}: {plural(len(manifest['levels']), 'level')}"]
    for level in manifest["levels"]:
        ends = {"down to": level["shown_from"], "up to": level["shown_to"]}
        shown = ", ".join(f"{word} x{zoom:.3g}" for word, zoom in ends.items() if zoom is not None) or "at every zoom"
        quality = " to ".join(dict.fromkeys(f"{of(level['psnr_db'].values()):.1f}" for of in (min, max)))
        lines.append(f"  {level['file']}  x{level['scale']:.3g}, shown {shown}: {quality} dB, {_size(level)}")
    if own_name(manifest["viewer"]) in OF_THREE_JS:
        lines.append(f"  {folder / THREE_JS}  shows the level that fits, in pages of three.js")
    return lines


def _distances(folder: Path, manifest: dict[str, Any]) -> list[str]:
    lines = [f"{folder}, for {manifest['viewer']}: {plural(len(manifest['levels']), 'level')} by distance"]
    for level in manifest["levels"]:
        ends = {"from": level["distance_from"] or None, "to": level["distance_to"]}
        shown = " ".join(f"{word} {distance:.3g}" for word, distance in ends.items() if distance is not None) or "everywhere"
        lines.append(f"  {level['file']}  shown {shown}: {_size(level)}")
    rule = f"lodBaseDistance {manifest['lodBaseDistance']:.4g}, lodMultiplier {manifest['lodMultiplier']:.3g}"
    return [*lines, f"  distances in world units on a canvas of {manifest['canvas']} px: {rule}"]


def _size(level: dict[str, Any]) -> str:
    return f"{plural(level['splats'], 'splat')}, {size_in_bytes(level['bytes'])}, {level['seconds']:.0f} s"
