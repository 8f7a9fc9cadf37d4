"""Merging: what a group becomes has its weight, mean and covariance, and only like splats that share pixels are grouped."""

from dataclasses import replace

import mip_checkpoints
import pytest
import torch
from tiny import cameras
from tiny import model as tiny_model

from mipmap_plugin.adaptation.merging import LARGEST_CELL, merge
from mipmap_plugin.backends.projection import rotations
from mipmap_plugin.config import recipe
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.wrap import wrap_model


def cloud(n: int, seed: int = 0) -> Gaussians:
    """Small splats of one color within a unit cube."""
    g = torch.Generator().manual_seed(seed)
    means, scales = torch.rand(n, 3, generator=g), 0.001 + 0.01 * torch.rand(n, 3, generator=g)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1)
    return Gaussians(means, quats, scales, 0.1 + 0.2 * torch.rand(n, generator=g), torch.full((n, 4, 3), 0.3))


def covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = rotations(gaussians.quats) * gaussians.scales[:, None]
    return axes @ axes.mT


def test_a_group_becomes_its_weight_mean_and_covariance():
    pair = cloud(2)
    pair = replace(pair, means=torch.tensor([[0.1, 0.1, 0.1], [0.12, 0.1, 0.1]]), scales=torch.full((2, 3), 0.01), opacities=torch.tensor([0.3, 0.1]))
    pair.sh[1] = 0.32
    one = merge(pair, torch.ones(2), 0.5)
    torch.testing.assert_close(one.means, torch.tensor([[0.105, 0.1, 0.1]]))  # weighed 3 : 1
    torch.testing.assert_close(one.sh, torch.full((1, 4, 3), 0.305))
    spread = 0.25 * 0.75 * 0.02**2
    torch.testing.assert_close(covariances(one)[0], torch.diag(torch.tensor([1e-4 + spread, 1e-4, 1e-4])))
    assert 0.3 < one.opacities[0] < 0.4  # the light of both over a surface a little larger


def test_a_splat_that_is_alone_stays_what_it_is():
    lonely = cloud(20)
    lonely = replace(lonely, means=lonely.means * 1000)
    same = merge(lonely, torch.ones(20), 0.5)
    order = torch.cdist(lonely.means, same.means).argmin(dim=1)
    torch.testing.assert_close(covariances(same)[order], covariances(lonely))
    torch.testing.assert_close(same.opacities[order], lonely.opacities)


@pytest.mark.parametrize("share", [0.5, 0.2, 0.1])
def test_as_many_are_left_as_were_asked_for(share):
    assert 0.5 * share < len(merge(cloud(2000), torch.full((2000,), 0.2), share)) / 2000 <= share


def test_cells_do_not_grow_without_end():
    left = merge(cloud(2000), torch.full((2000,), 0.25 / LARGEST_CELL), 0.001)
    assert len(left) == 4**3


def test_unlike_colors_stay_apart():
    mixed = cloud(100)
    mixed.sh[50:, 0] = -0.3
    assert len(merge(mixed, torch.ones(100), 0.01)) == 2


def test_splats_larger_than_their_cell_stay_alone():
    large = replace(cloud(50), scales=torch.full((50, 3), 10.0))
    assert len(merge(large, torch.ones(50), 0.1)) == 50


@pytest.mark.parametrize("degenerate", [0.0, 1e-30, 1e4])
def test_scales_of_any_size_give_finite_splats(degenerate):
    odd = cloud(30)
    odd.scales[::2, 0] = degenerate
    merged = merge(odd, torch.ones(30), 0.1)
    assert all(field.isfinite().all() for field in (merged.means, merged.quats, merged.scales, merged.opacities, merged.sh))


def test_the_default_recipe_merges_for_zoom_out_only():
    assert recipe("default", 1 / 4).merge_to == pytest.approx(0.2)
    assert recipe("default", 4).merge_to == 1


def test_adapting_merges_and_reports_it():
    base = tiny_model()
    adapted = wrap_model(base, cameras=cameras()).adapt(1 / 4, steps=1, merge_to=0.01, views="given")
    assert adapted.report.gaussians_after < adapted.report.gaussians_before == len(base)
    assert adapted.report.seconds["merging"] > 0


def test_a_family_whose_splats_are_not_its_rows_says_so(tmp_path):
    base = wrap_model(mip_checkpoints.folder(tmp_path / "mip"), cameras=cameras())
    assert base.adapt(1 / 4, steps=1, views="given").report.settings.merge_to == 1
    with pytest.raises(SettingsError, match="none are merged; leave merge_to out"):
        base.adapt(1 / 4, merge_to=0.5)
