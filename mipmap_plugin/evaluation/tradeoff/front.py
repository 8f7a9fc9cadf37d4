"""The Pareto front of cost and quality, its knee, and sentences about both."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mipmap_plugin.evaluation.tradeoff.points import Point

Cost = Callable[[Point], float]


@dataclass(frozen=True)
class Tradeoff:
    """All points of one scale, and the truth that their dB are measured against."""

    scale: float
    truth: str
    points: list[Point]
    notes: Sequence[str] = ()  # on points that are missing

    def sentences(self) -> tuple[str, str]:
        """The result in sentences: for seconds of adapting, and for milliseconds per frame."""
        return seconds_sentence(self.points), frames_sentence(self.points)

    def fronts(self) -> tuple[list[Point], list[Point]]:
        """The Pareto fronts: for seconds of adapting, and for milliseconds per frame."""
        return front(files(self.points), seconds), front(frames(self.points), milliseconds)


def seconds(point: Point) -> float:
    return point.adapt_seconds.median


def milliseconds(point: Point) -> float:
    """The milliseconds per frame of a point; infinite if not measured."""
    return math.inf if point.ms_per_frame is None else point.ms_per_frame.median


def files(points: Sequence[Point]) -> list[Point]:
    """The points that any renderer shows, without special filters: the base as it is, and adapted models."""
    return [point for point in points if point.kind in ("base", "adapted")]


def frames(points: Sequence[Point]) -> list[Point]:
    """The points whose frames were timed."""
    return [point for point in points if point.ms_per_frame is not None]


def front(points: Sequence[Point], cost: Cost) -> list[Point]:
    """The Pareto front: points that are better than all cheaper ones, by rising cost."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (cost(point), -point.psnr_db.median)):
        if not best or point.psnr_db.median > best[-1].psnr_db.median:
            best.append(point)
    return best


@dataclass(frozen=True)
class Knee:
    """The knee of a front: up to it dB are cheap, beyond it expensive."""

    point: Point
    cost: float
    gain_db: float  # over the cheapest point
    per_doubling_db: float | None  # gain per doubling of the cost, from the knee to the end; None: the knee is the end


def knee(best: Sequence[Point], cost: Cost) -> Knee | None:
    """The point of a front farthest above the line from its first to its last point (Satopää et al. 2011); None for a single point."""
    if len(best) < 2:
        return None
    start, end = best[0], best[-1]
    rise, run = end.psnr_db.median - start.psnr_db.median, cost(end) - cost(start)

    def above(point: Point) -> float:
        return (point.psnr_db.median - start.psnr_db.median) / rise - ((cost(point) - cost(start)) / run if run else 0.0)

    at = max(best[1:], key=above)
    doublings = math.log2(cost(end) / cost(at)) if cost(at) > 0 else 0.0
    rest = (end.psnr_db.median - at.psnr_db.median) / doublings if doublings > 0 else None
    return Knee(at, cost(at), at.psnr_db.median - start.psnr_db.median, rest)


def seconds_sentence(points: Sequence[Point]) -> str:
    """The gain of adapting, in a sentence."""
    found = knee(front(files(points), seconds), seconds)
    if found is None:
        return "adapting buys nothing here: no file is better than the base as it is"
    rest = "more were not spent" if found.per_doubling_db is None else f"each doubling after that {found.per_doubling_db:.1f} dB"
    return f"the first {_plain(found.cost)} s buy {found.gain_db:.1f} dB ({found.point.name}); {rest}"


def frames_sentence(points: Sequence[Point]) -> str:
    """The gain of slower frames, in a sentence."""
    best = front(frames(points), milliseconds)
    found = knee(best, milliseconds)
    quickest = f"the quickest frame, {_plain(milliseconds(best[0]))} ms, has {best[0].psnr_db.median:.1f} dB ({best[0].name})"
    if found is None:
        return f"{quickest}, and no slower one is better"
    rest = "" if found.per_doubling_db is None else f"; each doubling after that {found.per_doubling_db:.1f} dB"
    return f"{quickest}; {_plain(found.cost)} ms buy {found.gain_db:.1f} dB more ({found.point.name}){rest}"


def _plain(value: float) -> str:
    """Two digits, or all those before the point: 0.012, 1.3, 253."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
