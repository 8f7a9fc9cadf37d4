"""Constant and other bands of a color as one tensor."""

import pytest
import torch

from mipmap_plugin.process.pool import LARGE
from mipmap_plugin.splatting.bands import joined, neighbors

MANY = LARGE // 4 // 45 + 1


@pytest.mark.parametrize(("count", "side_by_side"), [(3, False), (MANY, False), (MANY, True)], ids=["small", "large", "large neighbors"])
@pytest.mark.parametrize("frozen", [False, True], ids=["all", "shN frozen"])
def test_values_and_gradients_are_those_of_cat(count, side_by_side, frozen):
    apart = {"means": torch.rand(count, 3), "sh0": torch.rand(count, 1, 3), "shN": torch.rand(count, 15, 3)}
    held = neighbors(apart) if side_by_side else apart
    assert all(torch.equal(held[name], tensor) for name, tensor in apart.items())
    sh0, shN, weights = held["sh0"].requires_grad_(), held["shN"].requires_grad_(not frozen), torch.rand(count, 16, 3)
    whole = joined(sh0, shN)
    assert torch.equal(whole, torch.cat([sh0, shN], dim=1)) and (whole.data_ptr() == sh0.data_ptr()) == side_by_side  # without a copy
    (whole * weights).sum().backward()
    assert torch.equal(sh0.grad, weights[:, :1]) and sh0.grad.is_contiguous()
    assert shN.grad is None if frozen else torch.equal(shN.grad, weights[:, 1:])


def test_two_results_do_not_share_memory():
    sh0, shN = torch.rand(LARGE // 100, 1, 3), torch.rand(LARGE // 100, 15, 3)
    first, second = joined(sh0, shN), joined(sh0 + 1, shN)
    assert torch.equal(first[:, :1], sh0) and torch.equal(second[:, :1], sh0 + 1)


def test_parts_of_one_tensor_are_joined_without_a_copy():
    whole = torch.rand(5, 4, 3)
    assert joined(whole[:, :1], whole[:, 1:]).data_ptr() == whole.data_ptr()
    assert torch.equal(joined(whole[:, 1:2], whole[:, :3]), torch.cat([whole[:, 1:2], whole[:, :3]], dim=1))
