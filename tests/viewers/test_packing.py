"""What the packed formats of viewers keep of a splat."""

import math
from dataclasses import replace

import pytest
import samples
import torch
from one_splat import BOTH, C0, MIDDLE, camera, differentiable, splat

from mipmap_plugin.effects import Effects
from mipmap_plugin.render_settings import Packing, RenderSettings
from mipmap_plugin.splatting.packing import in_two_steps, packed
from mipmap_plugin.splatting.viewers import find_viewer


def test_spark_packs_scales_in_254_steps_and_opacities_in_steps_of_two():
    packing = find_viewer("spark").settings.packing
    splats = samples.gaussians(200)
    kept = packed(splats, samples.camera(), packing)
    code = (kept.scales.log() + 12) * 254 / 21
    assert (code - code.round()).abs().max() < 1e-9
    assert (kept.scales.log() - splats.scales.log()).abs().max() <= 21 / 254 / 2 + 1e-9
    code = kept.opacities * 255 / 2
    assert (code - code.round()).abs().max() < 1e-9 and (kept.opacities - splats.opacities).abs().max() < 1.6 / 255


def test_harmonics_beyond_1_are_cut_off():
    kept = packed(replace(splats := samples.gaussians(20), sh=10 * splats.sh), samples.camera(), find_viewer("spark").settings.packing).sh
    assert 0.99 < kept[:, 1:].abs().max() < 1.01


@pytest.mark.parametrize(("viewer", "most"), [("spark", 2.0), ("playcanvas", 0.3)])
def test_packed_rotations_are_nearly_what_they_were(viewer, most):
    splats = samples.gaussians(500)
    kept = packed(splats, samples.camera(), find_viewer(viewer).settings.packing)
    dots = (torch.nn.functional.normalize(kept.quats) * torch.nn.functional.normalize(splats.quats)).sum(1).abs()
    degrees = torch.rad2deg(2 * dots.clamp(max=1).acos())
    assert 0.01 < degrees.max() < most
    assert torch.allclose(kept.quats.norm(dim=1), splats.quats.norm(dim=1))


@BOTH
def test_a_largest_alpha_below_that_of_the_edge_leaves_the_splat_its_size(backend):
    """Half of its peak is left at the edge, and alpha is clamped to 0.3."""
    settings = RenderSettings(radius=math.sqrt(2 * math.log(2)), max_alpha=0.3)
    alpha = backend.render(splat(2.0, 2.0, 1.0), camera(), Effects(0, eps2d=0.0, settings=settings)).alpha
    assert alpha[MIDDLE, MIDDLE] == alpha[MIDDLE, MIDDLE + 1] == pytest.approx(0.3)
    assert alpha[MIDDLE, MIDDLE + 2] == 0


def test_packing_in_two_steps_is_packing_in_one():
    packing = Packing(opacity=(1 / 63,), half_means=True)
    once, rest = in_two_steps(packing)
    splats, view = samples.gaussians(100), samples.camera()
    assert torch.equal(packed(packed(splats, view, once), view, rest).opacities, packed(splats, view, packing).opacities)


def test_packed_twice_is_packed():
    packing = replace(find_viewer("spark").settings.packing, half_means=False)
    once = packed(samples.gaussians(100), samples.camera(), packing)
    twice = packed(once, samples.camera(), packing)
    assert torch.allclose(once.scales, twice.scales) and torch.allclose(once.opacities, twice.opacities) and torch.allclose(once.sh, twice.sh)


def test_colors_are_rounded_down():
    kept = packed(splat(1.0, 1.0, 100.9 / 255, 100.9 / 255), camera(), find_viewer("gaussian-splats-3d").settings.packing)
    assert kept.opacities.item() * 255 == pytest.approx(100, abs=1e-3) and (0.5 + C0 * kept.sh[0, 0, 0].item()) * 255 == pytest.approx(100, abs=1e-3)


def test_gradients_pass_packing_as_they_are():
    leaves, splats = differentiable(samples.gaussians(20))
    kept = packed(splats, samples.camera(), find_viewer("spark").settings.packing)
    sum((index + 1) * getattr(kept, name).sum() for index, name in enumerate(leaves)).backward()
    assert all((leaf.grad == index + 1).all() for index, leaf in enumerate(leaves.values()))
