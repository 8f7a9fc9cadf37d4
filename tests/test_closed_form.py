"""The start without optimisation: exact for one splat that faces the camera, sane for everything else."""

import math
from dataclasses import replace

import pytest
import torch

from mipmap_plugin.adaptation.closed_form import THINNEST, closed_form, pixel_size
from mipmap_plugin.adaptation.resize import resize
from mipmap_plugin.backends.filters import keeps_light
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import DILATION, Effects
from mipmap_plugin.gaussians import Gaussians

BACKEND = ReferenceBackend()
DEPTH, FOCAL = 4.0, 40.0
PIXEL = DEPTH / FOCAL  # world units
BASE_WIDTH = {"classic": 0.3, "antialiased": 0.3, "mip": 0.1}  # px²
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


def finer(width: float, height: float, scale: float, base: Effects, opacity: float = 0.7):
    """The picture at zoom-in of the disc that `base` shows: what the pixel's average widened is narrower again, and no light is lost."""
    shown = BASE_WIDTH[base.screen_filter] - 1 / 12 + 1 / 12 / scale**2
    light = 0.0 if keeps_light(base.screen_filter) else BASE_WIDTH[base.screen_filter]
    areas = [math.sqrt((width**2 + more) * (height**2 + more)) for more in (light, shown)]
    return show(disc(width, height, opacity * areas[0] / areas[1]), scale, shown * scale**2)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
@pytest.mark.parametrize("base", [Effects(0), Effects(0, "antialiased")], ids=lambda base: base.screen_filter)
def test_zoom_in_shows_what_the_base_is_the_average_of(scale, size, base):
    torch.testing.assert_close(show(adapted(disc(*size), scale, base), scale), finer(*size, scale, base), atol=1e-6, rtol=0)


def test_a_view_from_afar_raises_no_opacity_further():
    far = VIEW.looking_from(torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 400], [0, 0, 0, 1]]), "far")
    opacities = closed_form(disc(0.3, 0.05, opacity=0.2), [VIEW, far], 64, Effects(0), Effects(0))[1]
    assert 0.2 < float(opacities) < 0.2 * 0.3 / (0.3 - 1 / 12)


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
    most = splats.opacities * (1.4 if scale > 1 else 1)
    assert new.scales.isfinite().all() and (new.scales >= 0).all()
    assert new.opacities.isfinite().all() and ((new.opacities >= 0) & (new.opacities <= most)).all()


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
def test_zoom_in_of_a_mip_base_for_any_viewer(scale):
    base = Effects(0, "mip", 0.1)
    torch.testing.assert_close(show(adapted(disc(1.0, 0.4), scale, base), scale), finer(1.0, 0.4, scale, base), atol=1e-6, rtol=0)


@pytest.mark.parametrize("scale", [1 / 8, 4])
@pytest.mark.parametrize("screen_filter", ["mip", "analytic"])
def test_a_base_and_a_file_that_keep_light_need_nothing(scale, screen_filter):
    splat, effects = disc(0.3, 0.05), Effects(0, screen_filter, 0.1)
    new = adapted(splat, scale, effects, effects)
    assert torch.equal(new.scales, splat.scales) and torch.equal(new.opacities, splat.opacities)


def test_zoom_in_of_an_analytic_base_shrinks_to_its_picture():
    splat = disc(1.5, 0.8)
    large = show(splat, 3, 0.0, "analytic")
    torch.testing.assert_close(resize(large, (VIEW.height, VIEW.width), "box"), show(splat, 1, 0.0, "analytic"), atol=2e-3, rtol=0)
