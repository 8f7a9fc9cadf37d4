"""Speed, memory and growth of every installed backend on a CPU.

    python benchmarks/backends.py --scene B --checkpoint output/bicycle --output benchmarks/results/backends.json

Prints Markdown tables and writes everything as JSON. What is measured, and how, is in README.md beside this file.
"""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from measure import YARDSTICK, fresh, measure_scaling, measure_speed
from pydantic import TypeAdapter
from scenes import SPECS, Name
from tables import GROWTH, Row, Rows, growth_table, sizes_table, speed_table
from tqdm import tqdm
from workloads import Size, Variant, prepare, users_scenes

from mipmap_plugin.backends import survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.errors import BackendUnavailable, SettingsError
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.process.versions import versions

# Imports and compilation are done on this scene before anything is timed.
WARM_UP: Name = "T"

# Scenes that are measured for how costs grow; two threads show nothing more there.
GROWING = frozenset(name for pair in GROWTH.values() for name in pair)


def main(
    scene: tyro.conf.UseAppendAction[tuple[Name, ...]] = (),
    checkpoint: tyro.conf.UseAppendAction[tuple[Path, ...]] = (),
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    output: Path = Path("benchmarks/results/backends.json"),
    runs: int = 5,
    keep: bool = False,
    scaling: bool = True,
    users: Path | None = None,
) -> None:
    """Measure, print the tables and write the JSON, which replaces an older one.

    Args:
        scene: A, B, C; T (tiny); N1 and N10, P1 and P10 (growth). May be repeated; by default, without checkpoints, all but T.
        checkpoint: A PLY or a model folder, of which the first view is measured. May be repeated.
        backend: A backend's name. May be repeated; by default all that can do it, and gsplat's torch twins.
        output: Path of the JSON.
        runs: How many of each; the median counts.
        keep: Add to the rows of an older JSON, so that a long measurement can be done in parts; rows measured again are replaced.
        users: The folder DATA of `real_bases.py`: adds the scenes that users have, students and bases at every zoom-out and a million splats.
        scaling: Compare two threads with one; meaningless on a busy machine, and half of the run time.
    """
    by_default = [] if checkpoint or users else [name for name in SPECS if name != WARM_UP]
    sources: list[Name | Path | Variant] = [*(scene or by_default), *checkpoint, *(users_scenes(users) if users else [])]
    able, reasons = installed(backend)
    with TemporaryDirectory() as folder:
        rows, sizes, failed = measure_all(able, sources, Path(folder), runs, scaling=scaling)
    if not rows:
        raise BackendUnavailable("nothing was measured: " + " | ".join(f"{what}: {reason}" for what, reason in {**reasons, **failed}.items()))
    if keep and output.exists():
        rows, sizes = joined(output, rows, sizes)
    compared = Rows(rows)
    print("\n\n".join(filter(None, [sizes_table(sizes), speed_table(compared), growth_table(compared)])))
    for what, reason in {**reasons, **failed}.items():
        print(f"\nnot measured: {what}: {reason}")
    write_json(output, facts(compared, sizes, {**reasons, **failed}), overwrite=True)


def installed(wanted: tuple[str, ...]) -> tuple[list[str], dict[str, str]]:
    """The backends to measure, and why the others are not. Raises SettingsError for an unknown name."""
    needs = Needs("cpu", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")
    reasons = survey(needs)
    unknown = [name for name in wanted if name not in reasons]
    if unknown:
        raise SettingsError(f"there is no backend {unknown[0]!r}; known are {', '.join(reasons)}")
    selected = {name: reasons[name] for name in wanted or reasons}
    return [name for name, lacks in selected.items() if not lacks], {name: "; ".join(lacks) for name, lacks in selected.items() if lacks}


def measure_all(
    backends: list[str], sources: list[Name | Path | Variant], folder: Path, runs: int, *, scaling: bool
) -> tuple[list[Row], list[Size], dict[str, str]]:
    """Every backend on every source: rows, sizes of the workloads, and what failed with its reason."""
    warm_up, rows, failed = folder / "warm_up", list[Row](), dict[str, str]()
    fresh(prepare, WARM_UP, warm_up)
    files = [folder / str(number) for number in range(len(sources))]
    sizes = [fresh(prepare, source, file) for source, file in zip(sources, files, strict=True)]
    for name in backends:
        _try(failed, name, measure_speed, name, warm_up, warm_up, 1)  # fills caches on disk: compiling takes memory too
    sound = [name for name in backends if name not in failed]
    for (file, size), name in tqdm([*product(zip(files, sizes, strict=True), sound)], disable=None, leave=False):
        what = f"{name} on {size.name}"
        speed = _try(failed, what, measure_speed, name, file, warm_up, runs)
        twice = scaling and speed and size.name not in GROWING and (os.cpu_count() or 1) > 1
        threads = _try(failed, f"{what}, two threads", measure_scaling, name, file, runs) if twice else None
        if speed:
            rows.append(Row(name, size, speed, threads))
    return rows, sizes, failed


def joined(output: Path, rows: list[Row], sizes: list[Size]) -> tuple[list[Row], list[Size]]:
    """What an older JSON holds, with these rows and sizes in place of its own of the same names; scene by scene."""
    older = json.loads(output.read_text(encoding="utf-8"))
    known = {size["name"]: Size(**size) for size in older["scenes"]} | {size.name: size for size in sizes}
    read = TypeAdapter(Row)
    before = [read.validate_python(record | {"size": known[record["size"]]}) for record in older["rows"]]
    latest = {(row.size.name, row.backend): row for row in [*before, *rows]}
    order = [*(name for name in SPECS if name in known), *(name for name in known if name not in SPECS)]
    return sorted(latest.values(), key=lambda row: order.index(row.size.name)), [known[name] for name in order]


def facts(rows: Rows, sizes: list[Size], reasons: dict[str, str]) -> dict[str, Any]:
    """Everything, for scripts."""
    records = []
    for row in rows.rows:
        ratios = {yardstick: rows.ratio(row, yardstick) for yardstick in ("reference", YARDSTICK)}
        records.append({**asdict(row), "size": row.size.name, "pairs_per_second": row.pairs_per_second, "ratio_to": ratios})
    growth = {name: {what: rows.growth(name, what) for what in GROWTH} for name in rows.backends()}
    return {"machine": machine(), "scenes": [asdict(size) for size in sizes], "rows": records, "growth": growth, "not_measured": reasons}


def machine() -> dict[str, Any]:
    """The machine and the versions; the load shows whether wall times are reliable."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cpu": _cpu(), "cpus": os.cpu_count(), "system": platform.platform(), "load_at_the_end": load, "versions": versions()}


def _cpu() -> str:
    listing = Path("/proc/cpuinfo")
    lines = listing.read_text().splitlines() if listing.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _try(failed: dict[str, str], what: str, *call: Any) -> Any:
    """The result of `fresh(*call)`; None, with the reason in `failed`, where it breaks."""
    try:
        return fresh(*call)
    except Exception as error:  # a third-party backend may fail in any way, or run out of memory; the others are still measured
        failed[what] = f"{type(error).__name__}: {error}"
        return None


if __name__ == "__main__":
    tyro.cli(main)
