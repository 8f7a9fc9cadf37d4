"""The benchmark of effects measures the pairs that it names."""

import sys
from pathlib import Path

import torch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))  # its modules import one another by bare names, as scripts do

import effects  # noqa: E402


def test_an_effect_changes_the_image_where_it_is_called_for_and_nowhere_else(tmp_path):
    for pair in effects.pairs(effects.Bench("reference", "T"), tmp_path):
        if not pair.backward or "supersampling" in pair.effect:  # take too long here
            continue
        on, off = (draw().detach() for draw in (pair.on, pair.off))
        same = on.shape == off.shape and torch.allclose(on, off, atol=1e-3)
        assert same != pair.needed, f"{pair.effect}, {pair.scene}"


def test_costs_are_medians_of_calls_in_turn():
    order = []
    cost = effects._in_turn([lambda: order.append("on"), lambda: order.append("off")], 3)
    assert order == ["on", "off"] * 4  # the first pair is for warming up
    assert cost.on_ms >= 0 and cost.off_ms >= 0


def test_a_row_says_what_is_saved_or_that_the_image_is_another():
    image = torch.ones(2, 2, 3, requires_grad=True)
    needed, unneeded = (effects.Pair("time", "a scene", lambda: image * 2, lambda: image * 2, needed) for needed in (True, False))
    assert [effects.row(pair, 1)[-1] for pair in (needed, unneeded)] == ["another image", "0e+00"]
