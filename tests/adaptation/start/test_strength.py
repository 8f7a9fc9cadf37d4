"""How strongly splats are merged, by what candidates are worth."""

import math

import pytest

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.start.strength import Bounds, Candidate, Merger, MergingCosts

SPLATS, FORMED = 64, 30.0
BOUNDS = Bounds(FORMED - 0.3, 0.0, FORMED)


def chosen(limited, coarse, *, learns=False, reached=0):
    """The splats of the strongest merging, by what it leaves at `merge_to` 1/16: `limited` and `coarse` have dB by splats; others have none.

    `reached`: fewer splats are left only where too few share a pixel.
    """

    def merge(power, coarsely):
        left = round(SPLATS * 16**-power)
        left, psnrs = (left, coarse) if coarsely else (max(left, reached), limited)
        return Candidate(left, Quality(*[psnrs.get(left, -math.inf)] * 2), left)

    found = Merger(merge, lambda power: math.ceil(SPLATS * 16**-power), MergingCosts(0.3, 0.3, learns)).strongest(BOUNDS)
    return None if found is None else found.made


@pytest.mark.parametrize(("learns", "splats"), [(False, 32), (True, 4)])
def test_without_steps_a_stronger_merging_is_no_worse_than_a_milder_one(learns, splats):
    """Steps would regain what it costs."""
    assert chosen({32: 31.0, 16: 30.5, 4: 29.8}, {}, learns=learns) == splats


@pytest.mark.parametrize(("learns", "splats"), [(False, 8), (True, 20)])
def test_where_merging_gains_and_no_step_follows_splats_are_merged_beyond_the_limits(learns, splats):
    assert chosen({32: 31.0, 20: 32.0}, {16: 33.0, 8: 32.8, 4: 32.0}, learns=learns, reached=20) == splats


def test_beyond_the_limits_nothing_is_merged_that_lost_within_them():
    assert chosen({32: 29.9}, {16: 33.0}, reached=32) == 32


def test_a_merging_that_is_reached_within_the_limits_is_not_tried_beyond_them():
    assert chosen({32: 31.0, 16: 31.0, 4: 31.0}, {16: 40.0, 8: 40.0, 4: 40.0}) == 4
