"""What was measured on a GPU, saved with each figure, so that a run that is cut off keeps what it has."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from textwrap import shorten
from typing import Any

from gpu_records import Adaptation, Bandwidth, Checked, Failure, FirstUse, Kernel, Profile, Speed, Views
from gpu_tables import adaptation_table, conformance_table, first_use_table, profile_table, speed_table, views_table

from mipmap_plugin.formats.atomic import write_json

KINDS: dict[str, Any] = {
    "speed": Speed, "views": Views, "profiles": Profile, "conformance": Checked, "adaptation": Adaptation,
    "first_uses": FirstUse, "failures": Failure,
}  # fmt: skip

# What tells a record from others of its kind; a later one of the same takes its place.
KEYS = {
    "speed": ("backend", "mode", "splats", "width", "height"), "views": ("backend", "width", "views"),
    "profiles": ("backend", "splats", "width", "height"), "conformance": ("backend",), "adaptation": ("base", "scale", "backend", "viewer"),
    "first_uses": ("backend", "viewer"), "failures": ("backend", "what", "reason"),
}  # fmt: skip


# Characters of a reason: what a backend lacks for viewers is a long list.
REASON = 200


@dataclass
class Results:
    """Of one machine, from one run or from several."""

    machine: dict[str, Any]
    bandwidth: float = 0.0  # bytes a second of a copy within the device's memory
    speed: list[Speed] = field(default_factory=list)
    views: list[Views] = field(default_factory=list)
    profiles: list[Profile] = field(default_factory=list)
    conformance: list[Checked] = field(default_factory=list)
    adaptation: list[Adaptation] = field(default_factory=list)
    first_uses: list[FirstUse] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    done: list[str] = field(default_factory=list)  # titles of the pieces of work that ended, whatever they showed

    @property
    def name(self) -> str:
        """The device's, as files are named."""
        return re.sub(r"\W+", "_", str(self.machine["device"])).strip("_").lower()

    @classmethod
    def of(cls, machine: dict[str, Any], folder: Path) -> Results:
        """Those of `machine` that are in `folder`, without what was not measured then."""
        results = cls(machine)
        file = folder / f"{results.name}.json"
        if file.exists():
            known = json.loads(file.read_text())
            results.bandwidth, results.done = known["bandwidth"], known.get("done", [])
            for key, kind in KINDS.items():
                with suppress(TypeError):  # those of an earlier version may have other figures, and are measured again
                    setattr(results, key, [kind(**row) for row in known.get(key, [])])
            results.profiles = [replace(row, kernels=[Kernel(*kernel) for kernel in row.kernels]) for row in results.profiles]
        return results

    def begin(self, parts: Sequence[str], further: bool) -> None:
        """Forget what is measured again: all of the parts, or `further` what was missing only."""
        self.failures = [failure for failure in self.failures if further and not failure.late]
        if further:
            return
        self.done = [title for title in self.done if title.split(":")[0] not in parts]
        self.adaptation = [row for row in self.adaptation if ("viewers" if row.viewer else "adaptation") not in parts]
        self.first_uses = [] if "adaptation" in parts else self.first_uses
        for part in {"speed", "views", "profiles", "conformance"} & set(parts):
            setattr(self, part, [])

    def add(self, record: Any) -> None:
        """Put a record to those of its kind, in place of an earlier one of the same, and say so."""
        if isinstance(record, Bandwidth):
            self.bandwidth = record.bytes_a_second
            return
        key = next(key for key, kind in KINDS.items() if isinstance(record, kind))
        rows = getattr(self, key)
        same = [number for number, row in enumerate(rows) if all(getattr(row, name) == getattr(record, name) for name in KEYS[key])]
        if same:
            rows[same[0]] = record
        else:
            rows.append(record)
        print(f"{key}: {', '.join(str(value) for value in asdict(record).values())[:300]}", flush=True)

    def save(self, folder: Path) -> None:
        """Write the page and the figures, named after the device."""
        facts = {"machine": self.machine, "bandwidth": self.bandwidth, "done": self.done}
        lists = {key: [asdict(row) for row in getattr(self, key)] for key in KINDS}
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / f"{self.name}.json", facts | lists, overwrite=True)
        (folder / f"{self.name}.md").write_text(report(self) + "\n")


def report(results: Results) -> str:
    """Everything as one page."""
    known = results.machine
    machine = ", ".join(f"{name} {value}" for name, value in known.items() if name != "device")
    copied = f" A copy moves {results.bandwidth / 1e9:.0f} GB/s, read and written." if results.bandwidth else ""
    made = "Made by `python benchmarks/gpu.py --data DATA`"
    lines = [f"# {known['device']}", f"{made}; {machine}.{copied}", speed_table(results.speed, results.bandwidth), views_table(results.views)]
    lines += [adaptation_table(results.adaptation), first_use_table(results.first_uses), conformance_table(results.conformance)]
    lines += [profile_table(results.profiles, results.bandwidth), not_measured(results.failures)]
    return "\n\n".join(filter(None, lines))


def not_measured(failures: Sequence[Failure]) -> str:
    """What was left out, and why. Empty where nothing was."""
    rows = [f"- {_name(failure)}: {shorten(failure.reason, REASON, placeholder=' ...')}" for failure in failures if not failure.late]
    late = "; ".join(_name(failure) for failure in failures if failure.late)
    rows += [f"- No time was left for {late}."] if late else []
    return "## Not measured\n\n" + "\n".join(rows) if rows else ""


def _name(failure: Failure) -> str:
    return " ".join(filter(None, [failure.backend, failure.what]))
