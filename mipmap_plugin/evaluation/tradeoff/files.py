"""The files and the table of a tradeoff."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.adaptation.plot import figure_class
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.evaluation.tradeoff.front import Tradeoff, frames
from mipmap_plugin.evaluation.tradeoff.plot import OTHERWISE, draw
from mipmap_plugin.evaluation.tradeoff.points import Point, Spread
from mipmap_plugin.formats.atomic import new_file, refuse_output, refuse_unwritable, settled, together, write_json
from mipmap_plugin.models.places import PAGE, page_at
from mipmap_plugin.process.versions import versions

NAMES = ("tradeoff.json", "tradeoff.csv", "tradeoff.png")

# The folder, in that of the results, with what an interrupted command had measured (`cells`).
KEPT = "tradeoff.resume"


def facts(tradeoffs: Sequence[Tradeoff], complete: bool) -> dict[str, Any]:
    """Everything that was measured, as written to JSON."""
    machine = {"threads": torch.get_num_threads(), "cores": os.cpu_count(), "processor": platform.machine(), **versions()}
    return {"complete": complete, "machine": machine, "scales": [_facts_of(each) for each in tradeoffs]}


def _facts_of(each: Tradeoff) -> dict[str, Any]:
    fronts = each.fronts()
    sentences = dict(zip(("seconds", "frames"), each.sentences(), strict=True))
    marks = [{"on_front_of_seconds": point in fronts[0], "on_front_of_frames": point in fronts[1]} for point in each.points]
    points = [asdict(point) | mark for point, mark in zip(each.points, marks, strict=True)]
    return {"scale": each.scale, "truth": each.truth, "sentences": sentences, "notes": each.notes, "points": points}


@dataclass(frozen=True)
class Folder:
    path: Path
    picture: bool  # whether to write the plot
    overwrite: bool
    page: Callable[[Sequence[Tradeoff]], Any] | None = None  # what writes the page of all results, if there is to be one

    @property
    def files(self) -> list[Path]:
        """The JSON, the CSV and, if it is to be drawn, the plot."""
        return [self.path / name for name in NAMES[: None if self.picture else -1]]


def goes_on(folder: Folder) -> Folder:
    """The folder, whose results are replaced if they are those of an interrupted command, which are incomplete."""
    return replace(folder, overwrite=folder.overwrite or ((folder.path / KEPT).is_dir() and not _is_complete(settled(folder.path / NAMES[0]))))


def refuse(folder: Folder) -> None:
    """Raise now the errors that `write` would raise at the end: OutputExists, and SettingsError without matplotlib."""
    if folder.picture:
        figure_class(OTHERWISE)
    overwrite = goes_on(folder).overwrite
    for name in NAMES:
        refuse_output(folder.path / name, overwrite, is_file=True)
    refuse_unwritable(folder.path / NAMES[0])


def _is_complete(file: Path) -> bool:
    """Whether a file has all results of a command; unreadable ones have to be looked at by a person."""
    try:
        return bool(json.loads(file.read_text(encoding="utf-8"))["complete"])
    except FileNotFoundError:
        return False
    except (OSError, ValueError, KeyError, TypeError):
        return True


def write(folder: Folder, tradeoffs: Sequence[Tradeoff], *, complete: bool) -> None:
    """Write JSON, CSV, plot and page, all at once, and remove what was kept once results are complete.

    Raises OutputExists, OutputError, and SettingsError without matplotlib.
    """
    older = [*page_at(folder.path / PAGE), folder.path / NAMES[2]] if (folder.path / NAMES[0]).exists() else []  # else the page shows something else
    spent = [*older, *([folder.path / KEPT] if complete else [])]
    with together(folder.path / NAMES[0], spent):
        write_json(folder.path / NAMES[0], facts(tradeoffs, complete), folder.overwrite)
        _write_table(folder, tradeoffs)
        if folder.picture:
            draw(folder.path / NAMES[2], tradeoffs, folder.overwrite)
        if complete and folder.page is not None:
            folder.page(tradeoffs)


def _write_table(folder: Folder, tradeoffs: Sequence[Tradeoff]) -> None:
    text = io.StringIO(newline="")
    rows = [{"truth": each.truth, **_flat(point)} for each in tradeoffs for point in each.points]
    writer = csv.DictWriter(text, fieldnames=list(rows[0]) if rows else ["truth"])
    writer.writeheader()
    writer.writerows(rows)
    with new_file(folder.path / NAMES[1], folder.overwrite) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8", newline="")


def _flat(point: Point) -> dict[str, Any]:
    """A point as a row: each spread becomes three columns; values that were not measured are empty."""
    row: dict[str, Any] = {}
    for name, value in vars(point).items():
        if isinstance(value, Spread) or name == "ms_per_frame":
            row |= {f"{name}_{part}": None if value is None else getattr(value, part) for part in ("median", "low", "high")}
        else:
            row[name] = value
    return row


def table(each: Tradeoff) -> str:
    """A table of all final points, best first, with the truth, both sentences and the notes."""
    best = each.fronts()
    body = [
        [point.name, point.backend, _text(point.psnr_db, 2), _text(point.adapt_seconds, 2), _text(point.ms_per_frame, 1), f"{point.gaussians:,}",
         " ".join(mark for mark, points in zip(("s", "ms"), best, strict=True) if point in points), point.ended_by]
        for point in sorted(frames(each.points), key=lambda point: -point.psnr_db.median)
    ]  # fmt: skip
    head = ["what", "backend", "dB", "adapt s", "ms/frame", "splats", "front", "ended by"]
    return "\n".join([f"x{each.scale:g}, {each.truth}", markdown(head, body), *each.sentences(), *each.notes])


def _text(spread: Spread | None, digits: int) -> str:
    """The median, and the range if it is not a single value."""
    if spread is None:
        return "-"
    low, middle, high = (f"{value:.{digits}f}" for value in (spread.low, spread.median, spread.high))
    return middle if low == high else f"{middle} ({low}-{high})"
