"""Blend weights: how many pixels each splat fills, from any backend."""

import pytest
import torch
from tiny import cameras, model

from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
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


def test_a_splat_alone_fills_what_it_covers():
    splats, views = model(60).gaussians().detach(), cameras(1)
    one = splats[torch.tensor([0])]
    torch.testing.assert_close(blend_weights(one, views, ReferenceBackend(), Effects(1))[0], opacity(one, views[0]).sum(), rtol=1e-4, atol=0.0)


def test_what_lies_behind_the_camera_has_none():
    splats, view = model(60).gaussians().detach(), cameras(1)[0]
    behind = splats.means + 2 * (view.center.float() - splats.means)
    hidden = Gaussians(behind, splats.quats, splats.scales, splats.opacities, splats.sh)
    assert blend_weights(hidden, [view], ReferenceBackend(), Effects(1)).abs().max() == 0
