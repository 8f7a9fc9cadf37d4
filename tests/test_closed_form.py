"""The start without optimisation: exact for one splat that faces the camera, sane for everything else."""

import math
from dataclasses import replace

import pytest
import torch

from mipmap_plugin.adaptation.closed_form import THINNEST, closed_form, pixel_size
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import DILATION, Effects
from mipmap_plugin.gaussians import Gaussians

BACKEND = ReferenceBackend()
DEPTH, FOCAL = 4.0, 40.0
PIXEL = DEPTH / FOCAL  # world units
VIEW = Camera(32, 24, FOCAL, FOCAL, 16.0, 12.0, torch.eye(4))


def disc(width: float, height: float, opacity: float = 0.7, count: int = 1) -> Gaussians:
    """Flat splats on the optical axis that face the camera; standard deviations in px of the base."""
    means = torch.tensor([[0.0, 0.0, DEPTH]], dtype=torch.float64).repeat(count, 1)
    scales = means.new_tensor([[width * PIXEL, height * PIXEL, 0.0]]).repeat(count, 1)
    quats = means.new_tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    return Gaussians(means, quats, scales, means.new_full((count,), opacity), means.new_ones(count, 1, 3))


def show(gaussians: Gaussians, scale: float, eps2d: float = DILATION, screen_filter: str = "classic"):
    return BACKEND.render(gaussians, VIEW.zoomed(scale), Effects(0, screen_filter, eps2d)).image


def adapted(gaussians: Gaussians, scale: float, base: Effects = Effects(0), target: Effects = Effects(0)) -> Gaussians:  # noqa: B008
    scales, opacities = closed_form(gaussians, [VIEW], scale, base, target)
    return replace(gaussians, scales=scales, opacities=opacities)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
def test_zoom_in_equals_the_scaled_filter(scale, size):
    splat = disc(*size)
    torch.testing.assert_close(show(adapted(splat, scale), scale), show(splat, scale, DILATION * scale**2), atol=1e-6, rtol=0)


def test_zoom_in_keeps_the_compensation_that_the_base_was_trained_with():
    splat = disc(1.0, 0.4)
    trained = Effects(0, "antialiased")
    new = adapted(splat, 4, base=trained)
    torch.testing.assert_close(show(new, 4), show(splat, 4, DILATION * 16, "antialiased"), atol=1e-6, rtol=0)


def test_zoom_out_of_a_large_splat_equals_the_scaled_filter():
    splat = disc(6.0, 4.0)
    new = adapted(splat, 0.5)
    torch.testing.assert_close(show(new, 0.5), show(splat, 0.5, DILATION / 4), atol=1e-6, rtol=0)
    assert new.opacities == splat.opacities


@pytest.mark.parametrize("scale", [1 / 2, 1 / 8, 1 / 64])
def test_zoom_out_of_splats_below_a_pixel_trades_opacity_for_area(scale):
    splat = disc(0.05, 0.02)
    new = adapted(splat, scale)
    assert 0 < new.opacities < 0.5 * splat.opacities
    assert (new.scales >= THINNEST * PIXEL / scale * (1 - 1e-9)).all()
    assert new.scales.isfinite().all()


@pytest.mark.parametrize("scale", [1 / 64, 1 / 4, 4, 64])
def test_hostile_splats_stay_finite(scale):
    """Behind the camera, at its eye, beyond every edge, without any extent, huge, a needle."""
    splats = disc(1.0, 1.0, count=6)
    means = splats.means + torch.tensor([[0, 0, -8.0], [0, 0, -DEPTH], [1e6, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    scales = torch.tensor([[1.0] * 3, [1.0] * 3, [1.0] * 3, [0.0] * 3, [1e4] * 3, [1e3, 1e-9, 1e-9]], dtype=torch.float64)
    new = adapted(replace(splats, means=means, scales=scales), scale)
    assert new.scales.isfinite().all() and (new.scales >= 0).all()
    assert new.opacities.isfinite().all() and ((new.opacities >= 0) & (new.opacities <= splats.opacities)).all()


@pytest.mark.parametrize("scale", [1 / 4, 4])
def test_views_that_see_nothing_give_finite_splats(scale):
    away = VIEW.looking_from(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), "away")
    scales, opacities = closed_form(disc(1.0, 1.0), [away], scale, Effects(0), Effects(0))
    assert scales.isfinite().all() and opacities.isfinite().all()


def test_scale_one_changes_nothing():
    splat = disc(1.0, 0.5)
    new = adapted(splat, 1.0)
    torch.testing.assert_close(new.scales[:, :2], splat.scales[:, :2])
    torch.testing.assert_close(new.opacities, splat.opacities)


def test_a_pixel_is_the_depth_over_the_focal_length():
    means = torch.tensor([[0.0, 0.0, 4.0], [0.5, 0.2, 2.0]])
    torch.testing.assert_close(pixel_size(means, [VIEW]), torch.tensor([4.0, 2.0]) / FOCAL)
    anamorphic = replace(VIEW, fx=20.0, fy=80.0)
    torch.testing.assert_close(pixel_size(means[:1], [anamorphic]), means.new_tensor([4 / math.sqrt(20 * 80)]))


def test_a_pixel_is_that_of_the_closest_view_that_sees_the_splat():
    closer = VIEW.looking_from(torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]]), "closer")
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0], [30.0, 0.0, 4.0]])  # both see it; only the first does; none does
    torch.testing.assert_close(pixel_size(means, [VIEW, closer]), torch.tensor([2.0, 1.0, 2.0]) / FOCAL)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize(("drawn", "eps2d"), [("classic", 0.3), ("mip", 0.1)])
def test_zoom_in_of_a_mip_base_equals_its_scaled_filter_in_either_file(scale, drawn, eps2d):
    splat = disc(1.0, 0.4)
    new = adapted(splat, scale, Effects(0, "mip", 0.1), Effects(0, drawn, eps2d))
    if drawn == "classic":  # 0.3 target px² is more than 0.1 base px² at x2, but not more than the splat and that together
        assert (new.scales[:, :2] > 0.1 * PIXEL).all()
    torch.testing.assert_close(show(new, scale, eps2d, drawn), show(splat, scale, 0.1 * scale**2, "mip"), atol=1e-6, rtol=0)


def test_a_filter_that_keeps_light_needs_nothing_at_zoom_out():
    splat, mip = disc(0.3, 0.05), Effects(0, "mip", 0.1)
    new = adapted(splat, 1 / 8, mip, mip)
    assert torch.equal(new.scales, splat.scales) and torch.equal(new.opacities, splat.opacities)


def test_zoom_in_of_an_analytic_base_is_its_picture_made_larger():
    splat, analytic = disc(1.5, 0.8), Effects(0, "analytic", 0.0)
    small = show(splat, 1, 0.0, "analytic")
    large = show(adapted(splat, 3, analytic, analytic), 3, 0.0, "analytic")
    torch.testing.assert_close(large[1::3, 1::3], small, atol=5e-3, rtol=0)  # the same points; a square against a Gaussian of its variance
    assert (show(splat, 3, 0.0, "analytic")[1::3, 1::3] - small).abs().max() > 0.02
