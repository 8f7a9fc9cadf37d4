"""Measurements as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from measure import YARDSTICK, Scaling, Speed, Spread
from workloads import Size

from mipmap_plugin.evaluation.report import markdown

# What grows tenfold from the first scene to the second.
GROWTH = {"splats": ("N1", "N10"), "pixels": ("P1", "P10")}


@dataclass(frozen=True)
class Row:
    """One backend on one workload."""

    backend: str
    size: Size
    speed: Speed
    scaling: Scaling | None  # None: not measured, on one processor or where something only grows

    @property
    def pairs_per_second(self) -> int:
        """(splat, pixel) pairs forward and backward, per CPU second of one thread."""
        return round(1000 * self.size.pairs / self.speed.forward_backward.cpu_ms.median)


class Rows:
    """All rows of one run, and how they compare."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = list(rows)
        self._by_key = {(row.backend, row.size.name): row for row in rows}

    def ratio(self, row: Row, yardstick: str) -> tuple[float, float] | None:
        """How many times less CPU time than `yardstick` on the same workload: forward, forward and backward. None: not measured."""
        other = self._by_key.get((yardstick, row.size.name))
        return None if other is None else (_times(other, row, "forward"), _times(other, row, "forward_backward"))

    def growth(self, backend: str, what: str) -> dict[str, float] | None:
        """What ten times as many splats or pixels cost, as factors; None: not measured."""
        few, many = (self._by_key.get((backend, name)) for name in GROWTH[what])
        if few is None or many is None:
            return None
        factors = {of: _times(many, few, of) for of in ("forward", "forward_backward")}
        memory = many.speed.extra_mib / max(few.speed.extra_mib, 1.0)  # below 1 MiB lies the noise
        return factors | {"extra_memory": round(memory, 2), "pairs": round(many.size.pairs / few.size.pairs, 2)}

    def backends(self) -> list[str]:
        return list(dict.fromkeys(row.backend for row in self.rows))


def speed_table(rows: Rows) -> str:
    head = ["scene", "backend", "forward CPU ms", "wall ms", "fwd+bwd CPU ms", "wall ms", "x reference", f"x {YARDSTICK}",
            "Mpairs/s", "extra MiB", "2 threads"]  # fmt: skip
    return markdown(head, [_cells(rows, row) for row in rows.rows])


def growth_table(rows: Rows) -> str:
    """Empty where no backend was measured on both scenes of a pair."""
    head = ["backend", "ten times the", "pairs", "forward", "fwd+bwd", "extra memory"]
    body = []
    for backend in rows.backends():
        for what in GROWTH:
            factors = rows.growth(backend, what)
            if factors:
                names = ("pairs", "forward", "forward_backward", "extra_memory")
                body.append([backend, what, *(f"x {factors[name]:.1f}" for name in names)])
    return markdown(head, body) if body else ""


def sizes_table(sizes: Sequence[Size]) -> str:
    body = [[size.name, f"{size.splats:,}", f"{size.width} x {size.height}", f"{size.pairs / 1e6:.2f}"] for size in sizes]
    return markdown(["scene", "splats", "px", "million pairs"], body)


def _cells(rows: Rows, row: Row) -> list[str]:
    forward, both = row.speed.forward, row.speed.forward_backward
    return [
        row.size.name, row.backend, _spread(forward.cpu_ms), _spread(forward.wall_ms), _spread(both.cpu_ms), _spread(both.wall_ms),
        _ratio(rows.ratio(row, "reference")), _ratio(rows.ratio(row, YARDSTICK)), f"{row.pairs_per_second / 1e6:.2f}",
        f"{row.speed.extra_mib:.0f}", f"x {row.scaling.wall_ratio.median:.2f} of {row.scaling.machine_ratio.median:.2f}" if row.scaling else "-",
    ]  # fmt: skip


def _spread(values: Spread) -> str:
    digits = 0 if values.median >= 100 else 1
    return f"{values.median:.{digits}f} ({values.low:.{digits}f}-{values.high:.{digits}f})"


def _ratio(factors: tuple[float, float] | None) -> str:
    return "-" if factors is None else " / ".join(f"{factor:.1f}" for factor in factors)


def _times(dividend: Row, divisor: Row, of: Literal["forward", "forward_backward"]) -> float:
    most, least = (getattr(row.speed, of).cpu_ms.median for row in (dividend, divisor))
    return round(most / least, 2)
