"""The Pareto front, its knee, and the sentences that say them."""

from dataclasses import replace

import pytest
import tiny

from mipmap_plugin.evaluation.tradeoff import measuring
from mipmap_plugin.evaluation.tradeoff.front import Tradeoff, files, frames, front, knee, milliseconds, seconds
from mipmap_plugin.evaluation.tradeoff.points import Plan, Point, Spread
from mipmap_plugin.evaluation.tradeoff.truth import base_itself
from mipmap_plugin.wrap import wrap_model


def point(db, s=0.0, ms=None, kind="adapted", name="default"):
    spread = None if ms is None else Spread.of([ms])
    return Point(1 / 8, kind, name, "cpu", 100, Spread.of([db]), Spread.of([s]), spread)


BASE = point(10, 0, 5.0, "base", "base")

# After 2 s a doubling buys half a dB.
RUN = [BASE, point(18, 1), point(21.3, 2), point(21.8, 4), point(22.3, 8, 4.0)]


def test_a_spread_is_the_median_and_the_whole_range():
    assert Spread.of([3.0, 1.0, 7.0]) == Spread(3.0, 1.0, 7.0)


def test_the_front_leaves_out_what_something_cheaper_equals():
    worse, equal, same_cost = point(20, 5), point(21.3, 3), point(17, 1)
    assert front([worse, *RUN[::-1], equal, same_cost], seconds) == RUN


def test_the_front_of_seconds_is_of_files_and_that_of_frames_of_what_was_timed():
    free = [point(30, 0, 50, "supersampling", "supersampling, 8 x 8"), point(15, 0, 6, "filter", "scaled"), point(22, 8, 900, "renderer", "tile 8")]
    assert files([*RUN, *free]) == RUN
    assert frames([*RUN, *free]) == [BASE, RUN[-1], *free]


def test_files_for_a_viewer_are_compared_with_the_base_in_it():
    """Not with the base as its training drew it, by a filter that the viewer lacks."""
    model = wrap_model(tiny.model(30), cameras=tiny.cameras(3), screen_filter="mip")
    found = measuring._baselines(model, base_itself(model, 1 / 2, 1), 1 / 2, Plan(viewer="classic"))
    assert [each.name for each in found if each.kind == "base"] == ["base in classic"]


def test_the_knee_lies_furthest_above_the_line_between_the_ends():
    found = knee(front(RUN, seconds), seconds)
    assert found.point == RUN[2] and found.cost == 2
    assert found.gain_db == pytest.approx(11.3) and found.per_doubling_db == pytest.approx(0.5)


def test_a_front_of_one_point_has_no_knee():
    assert knee([BASE], seconds) is None
    found = knee(front([BASE, RUN[1]], seconds), seconds)
    assert found.point == RUN[1] and found.per_doubling_db is None


def test_what_adapting_buys_is_said():
    assert Tradeoff(1 / 8, "dB", RUN).sentences()[0] == "the first 2 s buy 11.3 dB (default); each doubling after that 0.5 dB"
    assert "more were not spent" in Tradeoff(1 / 8, "dB", RUN[:2]).sentences()[0]
    assert "adapting buys nothing here" in Tradeoff(1 / 8, "dB", [BASE, point(9, 3)]).sentences()[0]


def test_figures_above_99_are_plain_numbers():
    slow = [replace(each, adapt_seconds=Spread.of([100 * each.adapt_seconds.median]), ms_per_frame=Spread.of([253.4])) for each in RUN]
    assert Tradeoff(1 / 8, "dB", slow).sentences()[0].startswith("the first 200 s buy")
    assert Tradeoff(1 / 8, "dB", slow).sentences()[1].startswith("the quickest frame, 253 ms, has")


def test_what_a_slower_frame_buys_is_said():
    free = [point(30, 0, 8.0, "supersampling", "supersampling, 4 x 4"), point(31, 0, 32.0, "supersampling", "supersampling, 8 x 8")]
    said = Tradeoff(1 / 8, "dB", [*RUN, *free]).sentences()[1]
    assert said == "the quickest frame, 4 ms, has 22.3 dB (default); 8 ms buy 7.7 dB more (supersampling, 4 x 4); each doubling after that 0.5 dB"
    assert Tradeoff(1 / 8, "dB", RUN).sentences()[1].endswith("and no slower one is better")


def test_milliseconds_that_were_not_measured_are_no_bargain():
    assert milliseconds(RUN[1]) == float("inf")
