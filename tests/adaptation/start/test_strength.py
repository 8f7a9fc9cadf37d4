"""How far a start's splats are merged."""

import pytest

from mipmap_plugin.adaptation.start.strength import POWERS, strongest

MILDEST, BOTH = [POWERS[-1]], [POWERS[-1], POWERS[0]]


@pytest.mark.parametrize(("dbs", "suit", "found", "tries"), [
    ({}, POWERS, POWERS[0], BOTH),
    ({}, POWERS[1:], POWERS[1], [POWERS[-1], *POWERS[:-1]]),
    ({}, POWERS[-1:], POWERS[-1], [POWERS[-1], *POWERS[:-1]]),
    ({}, (), None, MILDEST),
    ({POWERS[-1]: 31.0}, POWERS[:1], POWERS[0], BOTH),
])  # fmt: skip
def test_the_strongest_merging_that_suits_is_taken_and_none_is_tried_in_vain(dbs, suit, found, tries):
    tried = []

    def at(power):
        tried.append(power)
        return power, dbs.get(power, 29.0), power in suit

    assert strongest(at, formed_db=30.0) == found and tried == tries


def test_what_was_made_before_time_ran_out_is_taken():
    assert strongest(lambda power: (power, 29.0, True) if power == POWERS[-1] else None, formed_db=30.0) == POWERS[-1]
    assert strongest(lambda _: None, formed_db=30.0) is None
