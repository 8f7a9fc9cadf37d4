"""Merging: what a pair becomes has its weight, mean and covariance, and only like splats that share pixels are paired."""

import math
from dataclasses import replace

import moving
import pytest
import torch
from tiny import cameras
from tiny import model as tiny_model

from mipmap_plugin.adaptation.start.merging import MAX_DISTANCE, merge
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process import threads
from mipmap_plugin.recipes import recipe
from mipmap_plugin.splatting.rotations import rotations
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


def merged(gaussians: Gaussians, share: float, pixel: float = 1.0, light: torch.Tensor | None = None) -> Gaussians:
    """All splats show as much, if nothing else is said."""
    ones = torch.ones(len(gaussians))
    return merge(gaussians, pixel * ones, (0.01 * ones if light is None else light)[:, None], share)[0]


def test_a_pair_becomes_its_weight_mean_and_covariance():
    pair = cloud(2)
    pair = replace(pair, means=torch.tensor([[0.1, 0.1, 0.1], [0.12, 0.1, 0.1]]), scales=torch.full((2, 3), 0.01), opacities=torch.tensor([0.3, 0.1]))
    pair.sh[1] = 0.32
    one = merged(pair, 0.5, light=torch.tensor([0.3, 0.1]))
    torch.testing.assert_close(one.means, torch.tensor([[0.105, 0.1, 0.1]]))  # weighed 3 : 1
    torch.testing.assert_close(one.sh, torch.full((1, 4, 3), 0.305))
    spread = 0.25 * 0.75 * 0.02**2
    torch.testing.assert_close(covariances(one)[0], torch.diag(torch.tensor([1e-4 + spread, 1e-4, 1e-4])))


def test_optical_depth_times_surface_stays():
    pair = cloud(2)
    pair = replace(pair, means=torch.full((2, 3), 0.1), scales=torch.full((2, 3), 0.01), opacities=torch.tensor([0.3, 0.6]))
    torch.testing.assert_close(merged(pair, 0.5).opacities, torch.tensor([1 - 0.7 * 0.4]))  # one behind the other, of the same shape


def test_merging_is_the_same_on_any_number_of_threads(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.parallel.CHUNK", 16)
    many = cloud(100)
    many = replace(many, sh=0.3 + 0.01 * torch.rand(many.sh.shape, generator=torch.Generator().manual_seed(1)))

    def on(count: int) -> Gaussians:
        with threads.limited(count, shared=True):
            return merged(many, 0.5, pixel=0.1)

    one, three = on(1), on(3)
    assert len(one) == 50 and all(torch.equal(getattr(one, name), getattr(three, name)) for name in ("means", "quats", "scales", "opacities", "sh"))


def test_a_splat_that_is_alone_stays_what_it_is_bit_by_bit():
    lonely = cloud(20)
    lonely = replace(lonely, means=lonely.means * 1000)
    same = merged(lonely, 0.5)
    assert same is lonely


def test_splats_beside_a_merged_pair_stay_what_they_are_bit_by_bit():
    some = cloud(20)
    some = replace(some, means=some.means * 1000)
    some.means[1] = some.means[0]
    left = merged(some, 0.5)
    assert len(left) == 19
    assert torch.equal(left.scales[:-1], some.scales[2:])
    assert torch.equal(left.opacities[:-1], some.opacities[2:])


@pytest.mark.parametrize("share", [0.5, 0.2, 0.1])
def test_as_many_are_left_as_were_asked_for(share):
    assert len(merged(cloud(2000), share, pixel=0.2)) == round(share * 2000)


def test_what_shows_much_stays_and_what_shows_little_goes():
    some = cloud(200)
    light = torch.full((200,), 1e-4)
    light[:100] = 1.0
    left = merged(some, 0.6, light=light)
    assert torch.cdist(some.means[:100], left.means).amin(dim=1).max() < 0.01  # none has moved by more than a faint one can


def test_a_pair_that_costs_too_much_stays_two():
    close = replace(cloud(2), means=torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    assert len(merged(close, 0.5, light=torch.full((2,), 0.4))) == 1  # 0.4 * 0.4 / 0.8 px of light, 2 px apart: 0.8
    assert len(merged(close, 0.5, light=torch.full((2,), 0.6))) == 2


def test_splats_that_are_far_apart_stay_two():
    far = replace(cloud(2), means=torch.tensor([[0.0, 0.0, 0.0], [1.01 * MAX_DISTANCE, 0.0, 0.0]]))
    assert len(merged(far, 0.5)) == 2


def test_unlike_colors_stay_apart():
    mixed = cloud(100)
    mixed.sh[50:, 0] = -0.3
    left = merged(mixed, 0.01)
    assert len(left) == 2
    assert left.sh[:, 0].unique().numel() == 2


def test_colors_that_a_display_shows_alike_are_alike():
    bright = replace(cloud(2), means=torch.zeros(2, 3))
    bright.sh[0], bright.sh[1] = 5.0, 9.0
    assert len(merged(bright, 0.5)) == 1


def test_unlike_shapes_stay_apart():
    needles = replace(cloud(2), means=torch.zeros(2, 3), scales=torch.tensor([[5.0, 0.1, 0.1], [0.1, 5.0, 0.1]]))
    needles = replace(needles, quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1))
    assert len(merged(needles, 0.5)) == 2
    along = replace(needles, scales=needles.scales[[0, 0]])
    assert len(merged(along, 0.5)) == 1


def test_of_splats_that_no_view_saw_the_larger_weighs_more():
    unseen = replace(cloud(2), means=torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), scales=torch.tensor([[1.0] * 3, [0.1] * 3]))
    one = merged(unseen, 0.5, light=torch.zeros(2))
    assert len(one) == 1 and one.means[0, 0] < 0.1


@pytest.mark.parametrize("origin", [0.0, 1e6])  # as georeferenced scenes have it
def test_partners_are_found_wherever_the_scene_lies_and_in_whatever_order_it_comes(origin):
    """2,000 pairs, 2 px within and 20 px between: neighbors in space are none in the file."""
    order = torch.randperm(4000, generator=torch.Generator().manual_seed(1))
    pair = torch.arange(4000) // 2
    grid = torch.stack([pair % 13, pair // 13 % 13, pair // 169], dim=1) * 20.0
    grid[:, 0] += 2.0 * (torch.arange(4000) % 2)
    splats = cloud(4000)
    splats = replace(splats, means=(grid + origin)[order])
    left = merged(splats, 0.5)
    assert 2000 <= len(left) <= 2010  # a few of the last are not looked for
    middles = (grid[::2] + grid[1::2]) / 2 + origin
    assert (torch.cdist(middles, left.means).amin(dim=1) < 0.1).sum() >= 1990


@pytest.mark.parametrize("degenerate", [0.0, 1e-30, 1e4])
def test_scales_of_any_size_and_opaque_splats_give_finite_ones(degenerate):
    odd = cloud(30)
    odd.scales[::2, 0], odd.opacities[::3] = degenerate, 1.0
    left = merged(odd, 0.1)
    assert len(left) < 30
    assert all(field.isfinite().all() for field in (left.means, left.quats, left.scales, left.opacities, left.sh))


def test_the_default_recipe_merges_for_zoom_out_only():
    assert [recipe("default", scale).merge_to for scale in (1 / 2, 1 / 4, 1 / 8)] == pytest.approx([0.5, 0.2, 0.1])
    assert recipe("default", 0.9).merge_to == 1
    assert recipe("default", 4).merge_to == 1


def test_adapting_merges_and_reports_it():
    base = tiny_model()
    adapted = wrap_model(base, cameras=cameras()).adapt(1 / 4, steps=1, merge_to=0.01, merging_costs=99, returns="last", views="given")
    assert adapted.report.gaussians_after < adapted.report.gaussians_before == len(base)
    assert adapted.report.seconds["merging"] > 0


def test_a_family_whose_splats_are_not_its_rows_says_so(tmp_path):
    base = wrap_model(moving.write_deformable(tmp_path / "moving"), cameras=cameras())
    assert base.adapt(1 / 4, steps=1, views="given").report.settings.merge_to == 1
    with pytest.raises(SettingsError, match=r"none are merged; leave merge_to and most_splats \(--splats, --bytes\) out"):
        base.adapt(1 / 4, merge_to=0.5)


@pytest.mark.parametrize("axes", [(0.3, 0.2, 0.0), (0.3, 0.0, 0.2), (0.0, 0.3, 0.2), (0.3, 0.2, 0.1)])
def test_of_unequal_shapes_depth_is_weighed_by_all_three_sides(axes):
    """Two that lie in one place and along the axes: the surface is the root of the squared products of each two half-axes."""

    def surface(a: float, b: float, c: float) -> float:
        return math.sqrt(a * a * b * b + b * b * c * c + c * c * a * a)

    pair = replace(cloud(2), means=torch.zeros(2, 3), scales=torch.tensor([[*axes], [0.1, 0.1, 0.1]]), opacities=torch.tensor([0.6, 0.2]))
    pair = replace(pair, quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1))
    one = [math.sqrt((axis**2 + 0.1**2) / 2) for axis in axes]
    depth = -math.log(0.4) * surface(*axes) - math.log(0.8) * surface(0.1, 0.1, 0.1)
    torch.testing.assert_close(merged(pair, 0.5).opacities, torch.tensor([1 - math.exp(-depth / surface(*one))]))
