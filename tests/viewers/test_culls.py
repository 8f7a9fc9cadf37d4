"""Splats that a viewer leaves out, by its shader's rules, and the gradients that bring them back."""

import math
from dataclasses import replace

import pytest
import torch
from one_splat import BACKENDS, BOTH, MIDDLE, alpha, aside, camera, differentiable, splat

from mipmap_plugin.effects import Effects
from mipmap_plugin.splatting.viewers import find_viewer

# Left out by size


@BOTH
def test_playcanvas_drops_a_splat_whose_longer_axis_is_less_than_two_half_pixels(backend):
    # 2·sqrt(2·(4v + 0.3)) >= 2 in half pixels: v >= 0.05 px².
    assert alpha(backend, "playcanvas", splat(0.049, 0.01)).max() == 0
    assert alpha(backend, "playcanvas", splat(0.051, 0.01))[MIDDLE, MIDDLE] == pytest.approx(0.9, abs=1e-6)
    assert alpha(backend, "playcanvas", splat(0.01, 0.051)).max() > 0


@BOTH
def test_webgpu_tests_the_size_along_x_and_y(backend):
    slanted = splat(0.06, 0.0001, turn=math.pi / 4)  # 0.03 px² along x and along y
    assert alpha(backend, "playcanvas", slanted).max() > 0
    assert alpha(backend, "playcanvas-webgpu", slanted).max() == 0


LEAST = [
    # 3 of opacity · 2π · sqrt(det) in half pixels, with variances 4·(0.1 + 0.075) and 4·(0.2 + 0.075)
    ("playcanvas-webgpu", "playcanvas", (0.1, 0.2), 3 / (2 * math.pi * math.sqrt(0.7 * 1.1))),
    ("supersplat-viewer", "playcanvas", (0.1, 0.2), 1 / (2 * math.pi * math.sqrt(0.7 * 1.1))),
    # A quarter of opacity times determinant; dilated, that is of 0.5 + 0.3 and 0.1 + 0.3 px², 0.32 px⁴
    ("viser", "classic", (0.5, 0.1), 0.25 / 0.32),
]


@BOTH
@pytest.mark.parametrize(("viewer", "other", "shape", "least"), LEAST)
def test_a_viewer_drops_a_splat_that_contributes_too_little(backend, viewer, other, shape, least):
    assert alpha(backend, viewer, splat(*shape, least * 0.999)).max() == 0
    assert alpha(backend, viewer, splat(*shape, least * 1.001)).max() > 0
    assert alpha(backend, other, splat(*shape, least * 0.999)).max() > 0


@BOTH
def test_viser_leaves_out_alpha_below_a_hundredth(backend):
    # Dilated to 4 px²: sqrt(2·4·ln(0.2 / 0.01)) = 4.90 px
    rendered = alpha(backend, "viser", splat(3.7, 3.7, 0.2))[MIDDLE]
    assert rendered[MIDDLE + 5] == 0 < rendered[MIDDLE + 4]


@BOTH
def test_cesium_drops_splats_smaller_than_two_of_its_pixels(backend):
    # sqrt(2·(16v + 0.3)) >= 2: v >= 0.10625 px²
    assert alpha(backend, "cesium", splat(0.106, 0.01)).max() == 0
    assert alpha(backend, "cesium", splat(0.107, 0.01)).max() > 0


@BOTH
@pytest.mark.parametrize(
    ("viewer", "most"),
    [("spark", 1.4), ("gaussian-splats-3d", 1.2), ("splatapult", 1.5), ("gdgs", 1.2), ("web-splat", 1.2), ("lichtfeld", 1.4), ("kiri", 1.3)],
)
def test_a_splat_is_left_out_by_its_center(backend, viewer, most):
    def seen(halves, viewer=viewer):
        return alpha(backend, viewer, splat(900.0, 900.0, means=aside(halves))).max()

    assert seen(most - 0.01) > 0.5 and seen(1 - most) > 0.5
    assert seen(most + 0.01) == seen(-most - 0.01) == 0
    assert all(seen(1.5, other) > 0.5 for other in ("playcanvas", "brush", "inria"))


@BOTH
def test_gsplat_draws_splats_that_are_nearer_than_inria_draws_them(backend):
    """The limits of the two projects; splats so near fill the picture."""
    for depth, by_gsplat, by_inria in ((0.005, False, False), (0.1, True, False), (0.3, True, True)):
        drawn = [bool(alpha(backend, viewer, splat(4.0, 4.0, means=(0.0, 0.0, depth))).max() > 0) for viewer in ("gsplat", "classic")]
        assert drawn == [by_gsplat, by_inria]


# Gradients of a culled splat


CULLED = [("playcanvas", splat(0.04, 0.02)), ("playcanvas-webgpu", splat(0.1, 0.2, 0.4)), ("gaussian-splats-3d", splat(0.015, 0.014))]


@BOTH
@pytest.mark.parametrize(("viewer", "culled"), CULLED, ids=[name for name, _ in CULLED])
def test_a_culled_splat_is_not_rendered_and_its_gradient_makes_it_grow_where_it_is_missing(backend, viewer, culled):
    leaves, splats = differentiable(culled)
    rendered = alpha(backend, viewer, splats)
    assert (rendered == 0).all()
    (rendered.sum() * -1).backward()  # the loss falls as the splat appears
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values() if leaf.grad is not None)
    assert leaves["scales"].grad[0, :2].min() <= 0 and leaves["scales"].grad[0, 0] < 0
    assert leaves["scales"].grad[0, :2].abs().max() > 1e-3


@BOTH
@pytest.mark.parametrize(("viewer", "culled"), CULLED, ids=[name for name, _ in CULLED])
def test_a_culled_splat_that_is_in_the_way_does_not_grow(backend, viewer, culled):
    leaves, splats = differentiable(culled)
    alpha(backend, viewer, splats).sum().backward()
    assert leaves["scales"].grad[0, 0] > 0


def test_only_too_small_a_contribution_has_a_gradient_to_the_opacity():
    (_, small), (_, faint) = CULLED[0], CULLED[1]
    gradients_of_opacity = []
    for viewer, culled in (("playcanvas", small), ("playcanvas-webgpu", faint)):
        leaves, splats = differentiable(culled)
        alpha(BACKENDS[0], viewer, splats).sum().backward()
        gradients_of_opacity.append(leaves["opacities"].grad.item())
    assert gradients_of_opacity[0] == 0 < gradients_of_opacity[1]


def test_steps_along_the_gradient_bring_a_splat_back():
    scales = splat(0.03, 0.03).scales.log().requires_grad_()
    optimizer = torch.optim.Adam([scales], lr=0.02)
    for _ in range(60):
        rendered = alpha(BACKENDS[1], "playcanvas", replace(splat(0.03, 0.03), scales=scales.exp()))
        optimizer.zero_grad()
        (rendered[MIDDLE, MIDDLE] - 0.9).square().backward()
        optimizer.step()
    assert rendered[MIDDLE, MIDDLE].item() == pytest.approx(0.9, abs=0.02)


@BOTH
def test_the_cull_adds_no_gradient_to_a_large_splat(backend):
    gradients = []
    for settings in (find_viewer("playcanvas").settings, replace(find_viewer("playcanvas").settings, min_variance=0.0)):
        leaves, splats = differentiable(splat(4.0, 3.0))
        effects = Effects(0, "classic", 0.075, settings=replace(settings, packing=None, color_steps=None))
        backend.render(splats, camera(), effects).alpha[MIDDLE, MIDDLE + 1].backward()
        gradients.append(leaves["scales"].grad)
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=0)
