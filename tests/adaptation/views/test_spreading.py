"""Rounds through the views in which those that follow each other look from all sides."""

from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.views.schedule import Rounds


def placed(x: float, y: float):
    """A camera at a place, which looks along z."""
    viewmat = torch.eye(4)
    viewmat[:2, 3] = -torch.tensor([x, y])
    return replace(tiny.cameras(1)[0], viewmat=viewmat)


def test_neighbors_of_a_spread_round_are_of_all_parts_of_the_scene():
    """Views of four groups, far from each other: any four of a round, from a multiple of four on, are of different groups."""
    groups = [[placed(10.0 * (group % 2) + 0.1 * number, 4.0 * (group // 2)) for number in range(6)] for group in range(4)]
    rounds = Rounds([view for group in groups for view in group], seed=2, spread_out=True)
    drawn = [rounds(draw) for draw in range(72)]
    for start in range(0, 72, 4):
        assert [sum(view in group for view in drawn[start : start + 4]) for group in groups] == [1, 1, 1, 1]
    assert len({tuple(view.viewmat[0, 3].item() for view in drawn[start : start + 24]) for start in (0, 24, 48)}) == 3  # each round is another


@pytest.mark.parametrize("spread_out", [False, True])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_rounds_show_every_view_once_and_start_anywhere(count, spread_out):
    views = tiny.cameras(count)
    rounds, other = (Rounds(views, seed=seed, spread_out=spread_out) for seed in (2, 3))
    drawn = [rounds(draw) for draw in range(3 * count)]
    assert [Rounds(views, seed=2, spread_out=spread_out)(draw) for draw in range(3 * count)] == drawn
    assert all(set(drawn[start : start + count]) == set(views) for start in range(0, 3 * count, count))
    assert count < 12 or drawn[:count] not in (drawn[count : 2 * count], [other(draw) for draw in range(count)])


def test_views_of_one_place_are_told_apart_by_where_they_look():
    turned = [replace(tiny.cameras(1)[0], viewmat=torch.diag(torch.tensor([side, 1.0, side, 1.0]))) for side in (1.0, 1.0, -1.0, -1.0)]
    rounds = Rounds(turned, seed=0, spread_out=True)
    for start in range(0, 12, 2):
        assert sum(float(rounds(start + number).viewmat[2, 2]) for number in range(2)) == 0
