"""Blend weights: how many pixels each splat fills, from any backend."""

import math
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tiny import cameras, model

from mipmap_plugin.adaptation.start import base_weights
from mipmap_plugin.adaptation.start.base_weights import BaseWeights, weighed_in_parts
from mipmap_plugin.adaptation.start.blend_weights import PARTS, _color_gradient, blend_weights, may_show, wanted_of, weighed, whole_weights
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.splatting.harmonics import C0


def opacity(gaussians: Gaussians, view) -> torch.Tensor:
    """The image of the splats in white on black."""
    white = torch.full_like(gaussians.sh[:, :1], 0.5 / C0)
    white_splats = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, white)
    return ReferenceBackend().render(white_splats, view, Effects(0)).image[..., 0]


@pytest.fixture(params=["reference", "cpu"])
def backend(request):
    if request.param == "cpu":
        pytest.importorskip("numba")
    return get_backend(request.param)


def test_the_sum_of_blend_weights_is_what_the_background_lacks(backend):
    splats, views = model(60).gaussians().detach(), cameras(3)
    filled = torch.stack([opacity(splats, view).sum() for view in views]).mean()
    torch.testing.assert_close(blend_weights(splats, views, backend, Effects(1)).sum(), filled, rtol=1e-4, atol=0.0)


def test_blend_weights_are_the_same_in_smaller_views(backend):
    splats, views = model(60).gaussians().detach(), [view.zoomed(4) for view in cameras(3)]
    whole, shown = weighed(splats, views, [0, 1, 0], backend, Effects(1))
    smaller, also_shown = weighed(splats, views, [0, 0, 0], backend, Effects(1), size=1 / 4)
    assert float((smaller - whole).sum(1).abs().sum() / whole.sum()) < 0.06 and also_shown == pytest.approx(shown, abs=0.05)


def test_a_splat_alone_fills_what_it_covers():
    splats, views = model(60).gaussians().detach(), cameras(1)
    one = splats[torch.tensor([0])]
    torch.testing.assert_close(blend_weights(one, views, ReferenceBackend(), Effects(1))[0], opacity(one, views[0]).sum(), rtol=1e-4, atol=0.0)


def test_the_whole_weight_is_that_of_a_splat_alone_in_the_middle_of_the_picture():
    """A faint ball of 3 px in the base, at half its size: alphas add up to opacity x 2 pi (variance + dilation)."""
    camera, depth = Camera(200, 200, 100.0, 100.0, 100.0, 100.0, torch.eye(4)), 5.0
    pixel, faint = torch.tensor([depth / 100]), torch.tensor([0.1])
    ball = Gaussians(torch.tensor([[0.0, 0.0, depth]]), torch.tensor([[1.0, 0, 0, 0]]), 3 * pixel.expand(1, 3), faint, torch.zeros(1, 1, 3))
    whole = whole_weights(ball, pixel, [camera], Effects(0), 0.5)
    assert whole.item() == pytest.approx(0.25 * 0.1 * 2 * math.pi * (9 + 0.3), rel=1e-5)
    shown = 0.25 * blend_weights(ball, [camera], ReferenceBackend(), Effects(0, settings=RenderSettings(min_alpha=1e-6)))
    assert shown.item() == pytest.approx(whole.item(), rel=0.01)


@pytest.mark.parametrize(("scale", "shrunk"), [(1 / 2, 1 / 4), (2.0, 1.0)])
def test_areas_are_in_the_larger_of_the_pixels_of_base_and_target(scale, shrunk):
    """A ball of 3 px in the base."""
    ball = Gaussians(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 6.0), torch.tensor([0.1]), torch.zeros(1, 1, 3))
    wanted = wanted_of(torch.ones(1, 4), ball, torch.tensor([2.0]), cameras(1), Effects(0), scale)
    assert wanted.areas.item() == pytest.approx(shrunk * (9 + 0.3))


def test_the_whole_weight_of_a_sky_is_the_picture():
    camera = cameras(1)[0]
    sky = Gaussians(torch.zeros(1, 3), torch.ones(1, 4), torch.full((1, 3), 1e6), torch.ones(1), torch.zeros(1, 1, 3))
    assert whole_weights(sky, torch.ones(1), [camera], Effects(0), 1.0).item() == camera.width * camera.height


def test_splats_of_views_that_were_not_looked_at_may_be_shown():
    """A drive along a wall: what only other pictures hold is not known to be hidden; what none holds is."""
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, 0, 3] = -torch.arange(6.0)
    views = [Camera(8, 8, 8.0, 8.0, 4.0, 4.0, pose) for pose in poses]
    means = torch.tensor([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0], [5.0, 0.0, 1.0], [90.0, 0.0, 1.0]])
    weights, whole = torch.tensor([0.5, 0.0, 0.0, 0.0]), torch.ones(4)
    assert may_show(weights, whole, means, views, [views[0], views[5]]).tolist() == [True, True, False, False]
    assert may_show(weights, whole, means, views, views).tolist() == [True, False, False, False]
    for dtype in (torch.float32, torch.float64):  # one of them without kernels
        assert may_show(whole, whole, means.to(dtype), views, views[:1]).all()


def test_what_lies_behind_the_camera_has_none():
    splats, view = model(60).gaussians().detach(), cameras(1)[0]
    behind = splats.means + 2 * (view.center.float() - splats.means)
    hidden = Gaussians(behind, splats.quats, splats.scales, splats.opacities, splats.sh)
    assert blend_weights(hidden, [view], ReferenceBackend(), Effects(1)).abs().max() == 0


@pytest.mark.parametrize(
    "effects", [Effects(0), Effects(0, "analytic"), Effects(0, settings=replace(USUAL, min_variance=1.0))], ids=["classic", "analytic", "culled"]
)
def test_one_pass_finds_the_same_weights_as_gradients(effects):
    pytest.importorskip("numba")
    splats, views, backend = model(300).gaussians().detach(), cameras(3), get_backend("cpu")
    gray = replace(splats, sh=torch.zeros_like(splats.sh[:, :1]))
    for view in views:
        expected = _color_gradient(gray, view, backend, effects)
        torch.testing.assert_close(backend.blend_weights(gray, view, effects), expected, rtol=1e-4, atol=1e-5)
        assert expected.max() > 1


def test_weights_over_windows_are_found_from_gradients():
    pytest.importorskip("numba")
    splats, views = model(60).gaussians().detach(), cameras(2)
    assert get_backend("cpu").blend_weights(splats, views[0], Effects(1, "window")) is None
    windows, pixels = (blend_weights(splats, views, get_backend("cpu"), Effects(1, name)).sum() for name in ("window", "classic"))
    assert 0.5 * pixels < windows < pixels


@pytest.mark.parametrize(("count", "enough"), [(1, 12), (5, 12), (12, 12), (60, 24), (60, 48), (36, 48), (30, 48)])
def test_each_part_of_the_views_has_its_own_blend_weights(count, enough):
    """Of as many splats as views, each of which one view shows: what it adds to the mean, in the part of this view."""

    def weigh(numbers, parts):
        weights = torch.zeros(count, PARTS)
        weights[list(numbers), list(parts)] = 1 / len(numbers)
        return weights, 1.0

    weights, numbers = weighed_in_parts(count, weigh, lambda _: enough)
    expected = torch.zeros(count, PARTS)
    expected[numbers, [place % PARTS for place in range(len(numbers))]] = 1 / len(numbers)
    assert sorted(numbers) == evenly(range(count), enough)
    torch.testing.assert_close(weights, expected)


@pytest.mark.parametrize(("time", "count"), [(0.7, 20), (0.6, 12)])  # of the twelve that are looked at first, for the other eight
def test_a_time_budget_counts_the_views_that_there_are(monkeypatch, time, count):
    views = cameras(20)
    problem = SimpleNamespace(views=views, closest_of=views, scale=1 / 2, base_effects=Effects(0), backend=ReferenceBackend())
    clock = SimpleNamespace(timing=lambda *_: nullcontext(), size=lambda *_: 1.0, allows=lambda work, amount: amount <= time)
    monkeypatch.setattr(base_weights, "views_for", lambda shown: 48)
    seen = BaseWeights(problem, clock)
    assert seen.measured(model(60)).shape == (60, PARTS)
    assert len(seen.views) == count
