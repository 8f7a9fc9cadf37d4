"""The scale and the viewer that a checkpoint was adapted to, and its base's orbit, by what this package wrote into its header or beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.magic import kind_of
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.tags import provenance_of, vertical_of
from mipmap_plugin.models.places import REPORT


def adapted_scale(source: Path | None) -> float | None:
    """The scale that the file `source` was adapted to; None if it is a base. Raises CheckpointError, SceneError (`_record`)."""
    scale = _record(source).get("scale")
    return float(scale) if isinstance(scale, (int, float)) else None


def adapted_viewer(source: Path | None) -> str | None:
    """The viewer that the file `source` was adapted for; None if for none by name. Raises as `adapted_scale`."""
    viewer = _record(source).get("viewer")
    return viewer if isinstance(viewer, str) else None


def adapted_orbit(source: Path | None) -> dict[str, Any] | None:
    """The orbit around the base of the file `source`, by the fields of `Orbit`; None if it is a base, or of an older version.

    Raises as `adapted_scale`.
    """
    match _record(source).get("orbit"):
        case {"center": [float(), float(), float()] as center, "up": [float(), float(), float()] | None as up, "distance": float() as far, **more}:
            nearest = more.get("nearest")
            known = {"center": tuple(center), "up": up and tuple(up), "distance": far, "said": more.get("said") is True}
            return known | ({"nearest": nearest} if isinstance(nearest, float) else {})
    return None


def known_up(source: Path | None, by_family: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """What is up in a base, as its family or its header says; None: not known, or an adapted file, whose base's orbit is recorded.

    Raises as `adapted_scale`.
    """
    return None if adapted_orbit(source) else by_family or vertical_of(_comments(source))


def report_beside(source: Path | None) -> dict[str, Any]:
    """The report beside the adapted file `source`; {} if there is none. Raises SceneError for a damaged one."""
    report = None if source is None else source.with_name(source.name + REPORT)
    found = read_json(report) if report is not None and report.is_file() else {}
    return found if isinstance(found, dict) else {}


def _record(source: Path | None) -> dict[str, Any]:
    """What this package wrote into a file, or beside it. Raises CheckpointError for a damaged file, SceneError for a damaged report."""
    if source is None or not source.is_file():  # made in memory, gone since, or a folder of another family
        return {}
    record = provenance_of(_comments(source)) or {}
    return record if "scale" in record else report_beside(source)


def _comments(source: Path | None) -> tuple[str, ...]:
    """The comments of a PLY's header; () of anything else. Raises CheckpointError for a damaged file."""
    return read_header(source).comments if source is not None and source.is_file() and kind_of(source) == "ply" else ()


def refuse_adapted(source: Path | None) -> None:
    """Raise SettingsError for a file that was adapted to another scale: its pictures at x1, which it would be adapted to, are wrong."""
    if (scale := adapted_scale(source)) not in (None, 1.0):
        raise SettingsError(f"{source} was adapted to x{scale:g}, at which alone it looks right; adapt the checkpoint that it was made from")
