"""The Triton kernels in Triton's interpreter: tiny images on the CPU. Run with `TRITON_INTERPRET=1 pytest -m interpreter`."""

from dataclasses import replace

import pytest
import torch
from oracle import brute_force
from samples import camera, gaussians
from triton_drawing import MARKS, WIDE, assert_equal, deterministic, draw, reference_result, triton_result

from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.conformance import CASES, check_case
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import TritonBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.projection import covariances_of

pytestmark = MARKS

# One case of each kind, which has broken a rasterizer here or elsewhere.
HARD = [
    "no-splat", "no-splat-in-view", "identical-splats", "1e6-units-from-the-origin", "1e25-units-aside-classic", "in-the-eye-classic",
    "on-the-near-plane-classic", "center-beyond-the-frustum-body-on-antialiased", "needle-1e12-classic", "scale-0-on-three-axes-mip",
    "quaternion-0-classic", "opacity-1-classic", "nan-in-scales-classic", "inf-in-sh-antialiased", "nan-in-covariances",
    "image-1x1-classic", "principal-point-outside-classic", "sh-bands-left-out",
    "spark-1", "playcanvas-1", "gaussian-splats-3d-1", "viser-1", "scale-1e4-playcanvas", "needle-1e12-spark",
    "rule-half-axis-of-the-whole", "rule-faint-and-transparent", "rule-rounded-picture", "rule-linear-light",
]  # fmt: skip


@pytest.mark.parametrize("tile", [4, 8])
@pytest.mark.parametrize(("screen_filter", "eps2d"), [("classic", 0.3), ("classic", 2.4), ("antialiased", 0.3), ("mip", 0.1)])
def test_equals_a_sum_over_every_pixel(screen_filter, eps2d, tile, monkeypatch):
    from mipmap_plugin.backends.triton_kernels import drawing

    monkeypatch.setattr(drawing, "tile_for", lambda pixels: tile)
    g = gaussians(30, dtype=torch.float32)
    effects = Effects(1, screen_filter, eps2d, (0.2, 0.5, 0.9))
    right = draw(lambda *scene: brute_force(*scene[:2], eps2d, effects.background, screen_filter), g.to(dtype=torch.float64), WIDE, effects)
    result = triton_result(g, WIDE, effects)
    assert set(result[2]) == {"means", "quats", "scales", "opacities", "sh"}
    assert_equal(result, right)


@pytest.mark.parametrize("degree", [0, 2, 3, 4])
def test_every_harmonic_has_its_gradient(degree):
    g, view, effects = gaussians(12, degree, dtype=torch.float32), camera(16, 16), Effects(degree)
    assert_equal(triton_result(g, view, effects), reference_result(g, view, effects))


def test_a_near_plane_of_0_divides_by_nothing():
    g, effects = gaussians(12, dtype=torch.float32), Effects(1, near_plane=0.0)
    g.means[0] = camera(16, 16).center.float()
    g.means[1, 2] = -5.0
    image, alpha, grads = triton_result(g, camera(16, 16), effects)
    seen = reference_result(g[torch.arange(12) > 1], camera(16, 16), effects)
    assert_equal((image, alpha, {name: grad[2:] for name, grad in grads.items()}), seen)
    assert not any(grad[:2].any() for grad in grads.values())


@pytest.mark.parametrize(("width", "drawn"), [(1e-12, True), (1e-16, False)])
def test_a_needle_along_y_is_drawn_and_has_gradients_down_to_the_thinnest(width, drawn):
    """Without dilation, through the middle of a column of pixels: 2.6e-24 px² across, whose square is 0 in float32; then less than is drawn."""
    view, no_dilation = replace(camera(16, 16, 16.0, 16.0), viewmat=torch.eye(4)), Effects(0, eps2d=0.0)
    shape = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([[width, 1.0, width]])
    needle = Gaussians(torch.tensor([[0.3125, 0.3125, 10.0]]), *shape, torch.tensor([0.9]), torch.ones(1, 1, 3))
    image, alpha, grads = triton_result(needle, view, no_dilation)
    right = reference_result(needle, view, no_dilation)
    assert_equal((image, alpha, grads if drawn else {}), right)
    assert (alpha.max() > 0.89) == drawn and all(grad.isfinite().all() and (grad.any() or not drawn) for grad in grads.values())


def test_bands_left_out_have_no_gradient():
    grads = triton_result(gaussians(12, 3), camera(16, 16))[2]
    assert grads["sh"][:, :4].any() and not grads["sh"][:, 4:].any()


def test_covariances_need_not_be_symmetric_to_have_their_gradient():
    g = gaussians(12).to(dtype=torch.float32)
    tilted = covariances_of(g) + 1e-4 * torch.randn(12, 3, 3, generator=torch.Generator().manual_seed(3))
    g = replace(g, covariances=tilted)
    result = triton_result(g, camera(16, 16))
    assert set(result[2]) == {"means", "opacities", "sh", "covariances"}
    assert_equal(result, reference_result(g, camera(16, 16), Effects(1)))


def test_pixels_stop_where_they_should():
    g = gaussians(150, dtype=torch.float32)
    g = replace(g, opacities=0.9 + 0.1 * g.opacities, scales=3 * g.scales)
    right = reference_result(g, camera(16, 16), Effects(1))
    assert (right[1] > 0.999).double().mean() > 0.5
    assert_equal(triton_result(g, camera(16, 16)), right, 1e-4)


def test_sums_in_one_order_are_the_same_sums():
    g, view = gaussians(12), camera(24, 20)
    right = triton_result(g, view)
    with deterministic(True):
        first, again = triton_result(g, view), triton_result(g, view)
    assert torch.equal(first[0], right[0]) and torch.equal(first[1], right[1])
    for name, grad in first[2].items():
        assert torch.equal(grad, again[2][name])
        torch.testing.assert_close(grad, right[2][name], atol=1e-6 * float(grad.abs().max()), rtol=1e-4)


def test_a_tile_lists_its_visible_splats_front_to_back_and_few_others(monkeypatch):
    from mipmap_plugin.backends.triton_kernels import drawing
    from mipmap_plugin.backends.triton_kernels.records import WIDTH

    g, view = gaussians(150, dtype=torch.float32), camera(64, 48)
    splats = drawing.KernelSplats.of(g.means, g.quats, g.scales, g.opacities, g.sh, None)
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: True)  # so that it is counted how often a splat is listed
    drawn = drawing.project(splats, [drawing.Shot(view, Effects(1))])
    [part] = drawn.lists.parts()
    assert part.listed.shape[1] == WIDTH
    records = torch.zeros(150, WIDTH).index_copy(0, part.bins.splat_ids.long(), part.listed)
    x, y, along, shear, across, log2_opacity = records[:, :6].T[:, :, None, None]
    ys, xs = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    u = xs - x - shear * (ys - y)
    alpha = torch.exp2(along * (ys - y) ** 2 + across * u**2 + log2_opacity)
    seen = (alpha >= 1 / 255) & torch.isfinite(drawn.depths)[:, None, None]
    tiles_x, tiles_y = 64 // drawn.tile, 48 // drawn.tile
    needed = seen.unflatten(2, (tiles_x, drawn.tile)).unflatten(1, (tiles_y, drawn.tile)).any(4).any(2).flatten(1)  # [N, tiles]
    listed = torch.zeros_like(needed)
    for tile in range(tiles_x * tiles_y):
        ids = part.bins.splat_ids[part.bins.tile_offsets[tile] : part.bins.tile_offsets[tile + 1]].long()
        listed[ids, tile] = True
        assert (drawn.depths[ids].diff() >= 0).all()
    assert not (needed & ~listed).any()
    boxed = int(part.bins.owned.counts.sum())
    assert needed.sum() <= listed.sum() < boxed
    assert listed.sum() - needed.sum() < 0.2 * (boxed - needed.sum())  # far fewer than by boxes


def test_rows_of_tiles_are_grouped_up_to_so_many_pairs():
    from mipmap_plugin.backends.triton_kernels import lists

    boxes = torch.tensor([[0, 1, 3, 6], [1, 0, 2, 2], [0, 0, 0, 0]], dtype=torch.int32)
    assert lists.pairs_by_row(boxes, 4) == [2, 3, 3, 0]
    assert list(lists.grouped([2, 3, 3, 0], 5)) == [(0, 2), (2, 4)]
    assert list(lists.grouped([9, 3], 5)) == [(0, 1), (1, 2)] and list(lists.grouped([0, 0], 5)) == [(0, 2)]
    assert lists.within(boxes, 2, 4).tolist() == [[0, 2, 3, 3], [1, 2, 2, 0], [0, 2, 0, 0]]


@pytest.mark.parametrize("case", HARD)
def test_hard_cases_equal_the_reference(case):
    outcome = check_case(TritonBackend(), case, CASES[case])
    assert outcome.passed and not outcome.skipped, outcome.message


def test_under_the_interpreter_it_serves_the_cpu_and_is_never_chosen_by_auto():
    needs = Needs("cpu", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")
    assert TritonBackend().lacking(needs) == [] and TritonBackend().speed < 0


def test_culled_splats_are_listed_for_their_gradient_only():
    from mipmap_plugin.backends.triton_kernels import drawing

    g = gaussians(40, dtype=torch.float32)
    splats = drawing.KernelSplats.of(g.means, g.quats, g.scales, g.opacities, g.sh, None)
    shots = [drawing.Shot(WIDE, Effects(1, settings=RenderSettings(min_variance=6.0)))]
    seen, listed = (drawing.draw(splats, shots, gradients=gradients) for gradients in (False, True))
    assert torch.equal(seen.images, listed.images)
    assert 0 < seen.projected.depths.isfinite().sum() < listed.projected.depths.isfinite().sum()


@pytest.mark.parametrize("settings", [USUAL, RenderSettings(radius=8**0.5, fades=True, min_variance=4.0, bucketed=True, max_alpha=0.8)])
def test_blend_weights_are_the_gradient_of_a_white_color(settings):
    g, effects = gaussians(20, dtype=torch.float32), Effects(0, settings=settings)
    colors = g.sh.detach().clone().requires_grad_()
    white = replace(g, sh=colors)
    image = ReferenceBackend().render(white, WIDE, effects).image
    [gradient] = torch.autograd.grad(image[..., 0].sum(), colors)
    for in_order in (False, True):
        with deterministic(in_order):
            weights = TritonBackend().blend_weights(g, WIDE, effects)
        torch.testing.assert_close(weights, gradient[:, 0, 0] / C0, atol=1e-5, rtol=1e-4)
