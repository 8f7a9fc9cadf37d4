"""The reference against a brute-force sum, published test vectors, finite differences and gsplat's CPU twins."""

import math

import pytest
import torch
from oracle import brute_force
from samples import camera, gaussians, leaves, t2_camera, t3_gaussian

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.supersample import render
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.screen_filters import SCREEN_FILTERS
from mipmap_plugin.splatting import compositing
from mipmap_plugin.splatting.filters import footprint
from mipmap_plugin.splatting.harmonics import basis
from mipmap_plugin.splatting.projection import project, slope_limits

BACKEND = ReferenceBackend()


@pytest.mark.parametrize("screen_filter", sorted(SCREEN_FILTERS))
@pytest.mark.parametrize("eps2d", [0.3, 0.02])
def test_equals_a_sum_over_every_pixel(screen_filter, eps2d):
    g, view = gaussians(), camera(cx=17.3, cy=12.9)
    effects = Effects(1, screen_filter, eps2d, (0.2, 0.5, 0.9))
    rendered = BACKEND.render(g, view, effects)
    image, alpha = brute_force(g, view, eps2d, effects.background, screen_filter)
    error = 1e-7 if screen_filter == "window" else 1e-10  # sums over five points instead of many
    torch.testing.assert_close(rendered.image, image, atol=error, rtol=0)
    torch.testing.assert_close(rendered.alpha, alpha, atol=error, rtol=0)


def test_float32_equals_float64_but_for_pixels_on_a_cut_off():
    view = camera(80, 64, 90.0, 84.0)
    exact = BACKEND.render(gaussians(400), view, Effects(1)).image
    single = BACKEND.render(gaussians(400, dtype=torch.float32), view, Effects(1)).image
    gap = (single.double() - exact).abs()
    assert (gap > 2e-5).double().mean() < 0.002  # a splat that crosses 1/255 in one precision only moves its pixel by up to 1/255
    assert gap.max() < 2 / 255


def test_covariances_override_quats_and_scales():
    g = gaussians()
    rotation = torch.linalg.qr(torch.randn(len(g), 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[0]
    covariances = rotation @ torch.diag_embed(g.scales**2) @ rotation.mT
    turned = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh, covariances)
    torch.testing.assert_close(BACKEND.render(turned, camera(), Effects(1)).image, brute_force(turned, camera())[0], atol=1e-10, rtol=0)


@pytest.mark.parametrize(("scales", "settings"), [
    ((100.0, 1e-16, 1e-20), USUAL),
    ((6e4, 8e-24, 0.0), USUAL),
    ((1e10, 0.04, 3e-8), RenderSettings(least_spread=0.1)),
    ((1e10, 1e9, 3e-8), RenderSettings(radius=3.0, max_half_axis=50.0)),
    ((1e10, 1e9, 3e-8), RenderSettings(min_variance=0.125)),
])  # fmt: skip
def test_splats_far_thinner_or_wider_than_a_picture_have_finite_gradients_in_float32(scales, settings):
    quats = torch.tensor([[1.0, 0.2, 0.1, 0.4], [0.3, -0.6, 0.2, 0.1], [0.0, -0.1, 0.9, 0.1]])
    means = torch.tensor([[0.0, 0.1, 2.0], [0.1, 0.0, 3.0], [0.0, 0.0, 4.0]])
    parts = [means, quats, torch.tensor([scales] * 3), torch.full((3,), 0.9), torch.rand(3, 1, 3, generator=torch.Generator().manual_seed(0))]
    splats = Gaussians(*(part.requires_grad_() for part in parts))
    view = Camera(20, 16, 30.0, 25.0, 10.0, 8.0, torch.eye(4))
    rendered = BACKEND.render(splats, view, Effects(0, eps2d=0.0 if settings is USUAL else 0.3, settings=settings))
    assert rendered.image.isfinite().all()
    grads = torch.autograd.grad(rendered.image.sum(), parts, allow_unused=True, materialize_grads=True)
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize(("by_width", "limits"), [(False, (-4 / 3 - 0.3, 2 / 3 + 0.3, -0.25 - 0.15, 0.75 + 0.15)), (True, (-1.3, 1.3, -1.3, 1.3))])
def test_slopes_are_frozen_beyond_the_picture_or_beyond_its_width(by_width, limits):
    view = Camera(60, 20, 30.0, 20.0, 40.0, 5.0, torch.eye(4))
    assert slope_limits(view, RenderSettings(frozen_beyond=0.3, frozen_by_width=by_width)) == pytest.approx(limits)


def test_batches_do_not_change_the_image(monkeypatch):
    whole = BACKEND.render(gaussians(), camera(), Effects(1)).image
    monkeypatch.setattr(compositing, "BATCH_PAIRS", 16 * 16 * 8)
    torch.testing.assert_close(BACKEND.render(gaussians(), camera(), Effects(1)).image, whole, atol=1e-12, rtol=0)


def test_gradients_equal_finite_differences():
    # At cut-offs there is no derivative: opacities are so high, and splats so few and large, that no pixel is near one.
    g = gaussians(5, seed=3)
    view = camera(6, 5, 7.0, 6.5)
    g = Gaussians(torch.cat([g.means[:, :2] * 0.2, 2 + g.means[:, 2:].abs()], 1), g.quats, g.scales + 0.8, 0.1 + 0.6 * g.opacities, g.sh)
    tensors, _ = leaves(g)
    for name in sorted(SCREEN_FILTERS):
        effects = Effects(1, name, 0.3, (1.0, 1.0, 1.0))
        assert torch.autograd.gradcheck(lambda *t, e=effects: BACKEND.render(Gaussians(*t), view, e).image, tensors, atol=1e-6, fast_mode=True)


def test_t1_spherical_harmonics():
    expected = [0.282094792, -0.261169028, 0.391753542, -0.130584514, 0.156078347, -0.468235042, 0.292863596, -0.234117521,
                -0.117058760, 0.022527969, 0.331092173, -0.540952781, 0.064115724, -0.270476391, -0.248319130, 0.123903829]  # fmt: skip
    direction = torch.nn.functional.normalize(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    torch.testing.assert_close(basis(direction, 3)[0], torch.tensor(expected, dtype=torch.float64), atol=1e-9, rtol=0)


def test_degree_four_is_orthonormal():
    rng = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=rng, dtype=torch.float64))
    functions = basis(directions, 4)
    gram = 4 * math.pi * functions.T @ functions / len(functions)
    assert (gram - torch.eye(25)).abs().max() < 0.03  # Monte Carlo noise of 200 000 directions


@pytest.mark.parametrize("alone", range(5))
def test_where_nothing_is_drawn_any_parameter_alone_has_a_gradient_of_zero(alone):
    means, *others = (tensor.detach() for tensor in leaves(gaussians(3))[0])
    tensors = [means * torch.tensor([1.0, 1.0, -1.0]), *others]  # behind the camera
    tensors[alone].requires_grad_()
    rendered = BACKEND.render(Gaussians(*tensors), camera(), Effects(1))
    assert not torch.autograd.grad(rendered.image.sum() + rendered.alpha.sum(), tensors[alone])[0].any()


def test_t3_projection():
    projected = project(t3_gaussian(), t2_camera(), 0.2)
    got = torch.cat([projected.depths, projected.means2d[0], projected.xx, projected.xy, projected.yy])
    expected = [4.325263158, 37.758091993, 21.765879776, 2.718538992, 0.113341465, 0.784628197]
    torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64), atol=1e-7, rtol=0)
    dilated = footprint(projected, t3_gaussian().opacities, "classic", 0.3)
    assert float(dilated.across * dilated.yy) == pytest.approx(3.261146218, abs=1e-7)
    compensated = footprint(projected, t3_gaussian().opacities, "antialiased", 0.3)
    assert float(compensated.opacities / dilated.opacities) == pytest.approx(0.806311541, abs=1e-7)
    mip = footprint(projected, t3_gaussian().opacities, "mip", 0.1)  # the published number has two summands of 1e-6 more
    assert float(mip.opacities / dilated.opacities) == pytest.approx(0.924522412, abs=1e-6)


def test_t3_pixel():
    pixel = BACKEND.render(t3_gaussian(), t2_camera(), Effects(0)).image[21, 37]
    torch.testing.assert_close(pixel, torch.tensor([0.449633559, 0.291343503, 0.370488531], dtype=torch.float64), atol=1e-6, rtol=0)


def test_supersampled_scaled_filter_is_the_resized_base():
    g, base = gaussians(), camera(64, 48, 72.0, 72.0)
    target = base.zoomed(1 / 4)
    box = BACKEND.render(g, base, Effects(1)).image.unflatten(1, (-1, 4)).unflatten(0, (-1, 4)).mean((1, 3))
    fine = render(BACKEND, g, target, Effects(1, "classic", 0.3 / 16, supersampling=4))
    torch.testing.assert_close(fine.image, box, atol=1e-12, rtol=0)


def test_projection_equals_gsplat():
    twins = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is in the test extra")
    g, view = gaussians(300), camera()
    k = torch.tensor([[[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]]], dtype=torch.float64)
    covariances, _ = twins._quat_scale_to_covar_preci(g.quats, g.scales, compute_preci=False)
    radii, means2d, depths, conics, compensation = twins._fully_fused_projection(
        g.means, covariances, view.viewmat[None], k, view.width, view.height, eps2d=0.3, near_plane=0.2, calc_compensations=True
    )
    projected = project(g, view, 0.2)
    projected_footprint = footprint(projected, g.opacities, "antialiased", 0.3)
    seen = (radii[0] > 0).all(-1) if radii.dim() == 3 else radii[0] > 0
    assert seen.sum() > 100
    torch.testing.assert_close(projected.means2d[seen], means2d[0][seen], atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(projected.depths[seen], depths[0][seen], atol=1e-9, rtol=0)
    det = projected_footprint.across * projected_footprint.yy
    conic = torch.stack([projected_footprint.yy / det, -projected_footprint.shear * projected_footprint.yy / det, (projected.xx + 0.3) / det], -1)
    torch.testing.assert_close(conic[seen], conics[0][seen], atol=1e-7, rtol=1e-6)
    torch.testing.assert_close((projected_footprint.opacities / g.opacities)[seen], compensation[0][seen].clamp_min(0.005), atol=1e-8, rtol=1e-6)
