"""What was measured on a GPU, saved after each part, so that a run that is cut off keeps what it has."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gpu_adaptation import Adaptation
from gpu_conformance import Checked
from gpu_profile import Profile
from gpu_tables import Failure, Speed, report
from gpu_views import Views

from mipmap_plugin.formats.atomic import write_json

KINDS: dict[str, Any] = {
    "speed": Speed, "views": Views, "profiles": Profile, "conformance": Checked, "adaptation": Adaptation, "failures": Failure,
}  # fmt: skip


@dataclass
class Results:
    """Of one machine; the parts that are not measured again are those of an earlier run."""

    machine: dict[str, Any]
    bandwidth: float = 0.0  # bytes a second of a copy within the device's memory
    speed: list[Speed] = field(default_factory=list)
    views: list[Views] = field(default_factory=list)
    profiles: list[Profile] = field(default_factory=list)
    conformance: list[Checked] = field(default_factory=list)
    adaptation: list[Adaptation] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)

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
            results.bandwidth = known["bandwidth"]
            for key, kind in KINDS.items():
                with suppress(TypeError):  # those of an earlier version may have other figures, and are measured again
                    setattr(results, key, [] if key == "failures" else [kind(**row) for row in known[key]])
        return results

    def add(self, record: Any) -> None:
        """Put a record to those of its kind, and say so."""
        key = next(key for key, kind in KINDS.items() if isinstance(record, kind))
        getattr(self, key).append(record)
        print(f"{key}: {', '.join(str(value) for value in asdict(record).values())[:300]}", flush=True)

    def save(self, folder: Path) -> None:
        """Write the page and the figures, named after the device."""
        facts = {"machine": self.machine, "bandwidth": self.bandwidth}
        lists = {key: [asdict(row) for row in getattr(self, key)] for key in KINDS}
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / f"{self.name}.json", facts | lists, overwrite=True)
        (folder / f"{self.name}.md").write_text(report(self) + "\n")
