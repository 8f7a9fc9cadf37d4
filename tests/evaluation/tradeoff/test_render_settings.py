"""What an image may lack so that it is drawn sooner, where a backend can vary it."""

from dataclasses import replace

import pytest
import samples
import torch

from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import RenderSettings

BACKEND = ReferenceBackend()


def shown(settings: RenderSettings, splats: Gaussians, screen_filter: str = "classic"):
    return BACKEND.render(splats, samples.camera(), Effects(1, screen_filter, settings=settings))


@pytest.mark.parametrize("tile", [1, 8, 64])
def test_the_tile_changes_nothing(tile):
    splats = samples.gaussians()
    torch.testing.assert_close(shown(RenderSettings(tile=tile), splats).image, shown(RenderSettings(), splats).image)


@pytest.mark.parametrize("screen_filter", ["classic", "analytic"])
@pytest.mark.parametrize("radius", [1.0, 2.0])
def test_a_splat_ends_at_the_radius(radius, screen_filter):
    one = samples.gaussians(1)
    one = replace(one, means=torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64), scales=torch.full((1, 3), 0.3, dtype=torch.float64))
    whole = shown(RenderSettings(), one, screen_filter).alpha
    cut = shown(RenderSettings(radius=radius), one, screen_filter).alpha
    inside = whole >= whole.max() * torch.exp(torch.tensor(-(radius**2) / 2, dtype=torch.float64)) * 1.02  # the brightest is between pixels
    outside = whole <= whole.max() * torch.exp(torch.tensor(-(radius**2) / 2, dtype=torch.float64)) * 0.98
    torch.testing.assert_close(cut[inside], whole[inside])
    assert (cut[outside] == 0).all() and 0 < inside.sum() < (whole > 0).sum()


def test_the_alpha_threshold_leaves_the_faint_out():
    splats = samples.gaussians(1)
    alpha = shown(RenderSettings(), splats).alpha
    cut = shown(RenderSettings(min_alpha=0.05), splats).alpha
    torch.testing.assert_close(cut, torch.where(alpha >= 0.05, alpha, 0.0))
    assert (shown(RenderSettings(min_alpha=0.995), splats).alpha == 0).all()


def test_a_pixel_stops_before_the_splat_that_would_leave_it_less():
    splats = samples.gaussians(300)
    through = 1 - shown(RenderSettings(min_transmittance=0.3), splats).alpha
    assert through.min() >= 0.3 > (1 - shown(RenderSettings(), splats).alpha).min()


def test_gradients_are_of_what_is_drawn():
    leaves, splats = samples.leaves(samples.gaussians(5))
    settings = RenderSettings(radius=2.0, min_alpha=0.02, min_transmittance=0.1, tile=8)
    image = shown(settings, splats).image
    image.sum().backward()
    step = 1e-6 * torch.ones_like(leaves[3])
    moved = Gaussians(splats.means, splats.quats, splats.scales, splats.opacities + step, splats.sh)
    change = (shown(settings, moved).image - image).sum()
    torch.testing.assert_close(change.detach(), (leaves[3].grad * step).sum(), rtol=1e-3, atol=0)


def test_a_backend_whose_cut_offs_are_fixed_says_so():
    splats = samples.gaussians(3, dtype=torch.float32)
    needs = Needs.of(splats, Effects(1, settings=RenderSettings(radius=3.0, tile=8)), gradients=False)
    assert "it does not support another tile size, which the reference backend does" in CpuBackend().lacking(needs)
    assert not BACKEND.lacking(needs)
    usual = Needs.of(splats, Effects(1), gradients=False)
    assert not [reason for reason in CpuBackend().lacking(usual) if "reference" in reason]
