"""The shape of a splat under each viewer's screen filter, edge, eigenvalues and limits, computed by hand for one splat."""

import math
from dataclasses import replace

import pytest
import torch
from one_splat import BOTH, MIDDLE, SIZE, alpha, camera, differentiable, splat

from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.viewing.sources import coarser


def weight(dx: float, dy: float, across: float, down: float) -> float:
    return math.exp(-(dx**2 / across + dy**2 / down) / 2)


def faded(weight: float) -> float:
    """As PlayCanvas draws it, whose splats fade to nothing at the root of eight standard deviations."""
    return (weight - math.exp(-4)) / (1 - math.exp(-4))


# The screen filter and the edge


@BOTH
@pytest.mark.parametrize(
    ("viewer", "more"),
    [
        *(("playcanvas", 0.075), ("gaussian-splats-3d", 0.3), ("cesium", 0.01875), ("babylon", 0.075), ("gsplat-js", 0.075), ("antimatter15", 0.0)),
        *(("web-splat", 0.3), ("visionary", 0.1), ("splatapult", 0.3), ("gdgs", 0.3)),
    ],
)
def test_a_viewer_dilates_by_its_own_variance(backend, viewer, more):
    rendered = alpha(backend, viewer, splat(4.0, 1.0, 0.8))
    for x in (1, 3):
        whole = weight(x, 0, 4.0 + more, 1.0 + more)
        assert rendered[MIDDLE, MIDDLE + x] == pytest.approx(0.8 * (faded(whole) if viewer == "playcanvas" else whole), abs=2e-5)


@BOTH
def test_playcanvas_fades_and_other_viewers_cut_at_the_root_of_eight(backend):
    # Dilated to 1 px²: pixels at 2 and 3 lie this side and that of 2.83 standard deviations.
    fading = alpha(backend, "playcanvas", splat(0.925, 0.925, 0.9))
    assert fading[MIDDLE, MIDDLE + 2] == pytest.approx(0.9 * faded(math.exp(-2)), abs=1e-5)
    assert fading[MIDDLE + 2, MIDDLE + 2] == 0  # just at the edge: A = 1
    cut = alpha(backend, "antimatter15", splat(1.0, 1.0, 0.9))
    assert cut[MIDDLE, MIDDLE + 2] == pytest.approx(0.9 * math.exp(-2), abs=1e-5)
    assert cut[MIDDLE, MIDDLE + 3] == 0 < 0.9 * math.exp(-4.5) - 0.5 / 255


@BOTH
def test_spark_compares_alpha_after_compensation(backend):
    # A needle of 2 by v px² keeps sqrt(2v / (2.3·(v + 0.3))) of its opacity.
    def share(v):
        return math.sqrt(2 * v / (2.3 * (v + 0.3)))

    least = 0.5 / 255
    bright, faint = splat(2.0, 1e-4, 1.1 * least / share(1e-4)), splat(2.0, 1e-4, 0.9 * least / share(1e-4))
    assert faint.opacities.item() > 10 * least  # before compensation it is bright
    assert alpha(backend, "spark", faint).max() == 0
    assert alpha(backend, "spark", bright)[MIDDLE, MIDDLE] == pytest.approx(1.1 * least, rel=1e-3)


@BOTH
def test_with_antialiasing_playcanvas_compensates_opacity(backend):
    whole, kept = (alpha(backend, viewer, splat(0.2, 0.1))[MIDDLE, MIDDLE] for viewer in ("playcanvas", "playcanvas-aa"))
    assert kept / whole == pytest.approx(math.sqrt(0.2 * 0.1 / (0.275 * 0.175)), rel=1e-5)


@BOTH
def test_an_opaque_splat_covers_more_than_in_training(backend):
    assert alpha(backend, "playcanvas", splat(4.0, 4.0, 1.0))[MIDDLE, MIDDLE] == pytest.approx(0.999)
    assert alpha(backend, "classic", splat(4.0, 4.0, 1.0))[MIDDLE, MIDDLE] == pytest.approx(0.99)


# GaussianSplats3D's eigenvalues


@BOTH
def test_gaussian_splats_3d_drops_small_round_splats(backend):
    # mean + 0.3 - sqrt(0.1) > 0: a mean of 0.0162 px²
    assert alpha(backend, "gaussian-splats-3d", splat(0.0161, 0.0161)).max() == 0
    assert alpha(backend, "gaussian-splats-3d", splat(0.0163, 0.0163)).max() > 0
    assert alpha(backend, "gaussian-splats-3d", splat(0.0324, 0.0001)).max() > 0


@BOTH
def test_gaussian_splats_3d_draws_a_round_splat_upright(backend):
    rendered = alpha(backend, "gaussian-splats-3d", splat(1.0, 1.0, 0.8))
    for step in (1, 2):
        across, down = 1.3 - math.sqrt(0.1), 1.3 + math.sqrt(0.1)
        assert rendered[MIDDLE + step, MIDDLE] == pytest.approx(0.8 * weight(0, step, across, down), abs=1e-5)
        assert rendered[MIDDLE, MIDDLE + step] == pytest.approx(0.8 * weight(step, 0, across, down), abs=1e-5)


@BOTH
def test_gaussian_splats_3d_turns_a_nearly_round_splat(backend):
    """The shader's own steps: eigenvalues, an eigenvector that is none, and the weight in that basis."""
    a, b, d = 1.15 + 0.3, 0.15, 1.15 + 0.3  # of variances 1.3 and 1.0, turned by 45 degrees
    middle, spread = (a + d) / 2, math.sqrt(max(0.1, ((a + d) / 2) ** 2 - (a * d - b * b)))
    x, y = b / math.hypot(b, middle + spread - a), (middle + spread - a) / math.hypot(b, middle + spread - a)
    rendered = alpha(backend, "gaussian-splats-3d", splat(1.3, 1.0, 0.8, turn=math.pi / 4))
    for dx, dy in ((1, 1), (1, -1), (2, 0), (0, 2)):
        along, across = dx * x + dy * y, dx * y - dy * x
        assert rendered[MIDDLE + dy, MIDDLE + dx] == pytest.approx(0.8 * weight(along, across, middle + spread, middle - spread), abs=2e-5)


@BOTH
def test_programs_that_took_its_eigenvalues_stretch_splats_or_drop_them(backend):
    """NVIDIA's viewer does both, MetalSplatter stretches less, and Godot's only drops. NVIDIA's stretches level splats along (1, up)."""
    small, a_little_larger, round_one = splat(0.0161, 0.0161), splat(0.0163, 0.0163), splat(1.0, 1.0, 0.8)
    stretched = {"vk-gaussian-splatting": math.sqrt(0.1), "metalsplatter": 0.1, "gdgs": 0.0}
    for viewer, spread in stretched.items():
        x, y = (1, spread) if viewer == "vk-gaussian-splatting" else (0, 1)
        along, across = 2 * y / math.hypot(x, y), 2 * x / math.hypot(x, y)  # of a pixel two below the middle
        expected = 0.8 * weight(along, across, 1.3 + spread, 1.3 - spread)
        assert alpha(backend, viewer, round_one)[MIDDLE + 2, MIDDLE] == pytest.approx(expected, abs=1e-5)
        assert (alpha(backend, viewer, small).max() == 0) == (viewer != "metalsplatter")
    assert alpha(backend, "vk-gaussian-splatting", a_little_larger).max() > 0
    assert alpha(backend, "gdgs", splat(0.0326, 1e-6)).max() > 0  # a needle of that mean


@BOTH
@pytest.mark.parametrize("viewer", ["gaussian-splats-3d", "metalsplatter", "vk-gaussian-splatting"])
def test_a_splat_is_stretched_the_same_way_with_more_pixels(backend, viewer):
    effects, round_one, finer = find_viewer(viewer).effects(Effects(0)), splat(1.0, 1.0, 0.8), camera().resized(3 * SIZE, 3 * SIZE)
    more = backend.render(round_one, finer, coarser(effects, 3.0)).alpha[1::3, 1::3]  # where the pixels' centers are
    torch.testing.assert_close(more, backend.render(round_one, camera(), effects).alpha, atol=1e-5, rtol=0)


@BOTH
@pytest.mark.parametrize(("viewer", "radius", "most"), [("metalsplatter", 3.0, 0.999), ("web-splat", 3.0687, 0.99), ("visionary", 3.0687, 0.99)])
def test_a_splat_ends_and_is_covered_as_in_the_program(backend, viewer, radius, most):
    more = find_viewer(viewer).eps2d
    spread = 0.1 if viewer == "metalsplatter" else 0.0
    middle = alpha(backend, viewer, splat(9.0, 9.0, 1.0))[MIDDLE]
    assert middle[MIDDLE] == pytest.approx(most, abs=1e-6)
    assert [bool(middle[MIDDLE + x] > 0) for x in range(11)] == [x < radius * math.sqrt(9.0 + more - spread) for x in range(11)]


@BOTH
def test_lichtfeld_draws_half_a_step_of_8_bits_and_limits_no_color(backend):
    """Its rasterizer of 2026; that of 2025 drew as Brush does."""

    def seen(viewer, opacity):
        return alpha(backend, viewer, splat(900.0, 900.0, opacity)).max()

    assert seen("lichtfeld", 0.7 / 255) > 0 == seen("brush", 0.7 / 255) == seen("lichtfeld", 0.4 / 255)
    bright = backend.render(splat(4.0, 4.0, 0.5, 9.0), camera(), find_viewer("lichtfeld").effects(Effects(0))).image
    assert bright[MIDDLE, MIDDLE, 0].item() == pytest.approx(0.5 * 4, abs=1e-5)


@BOTH
def test_a_long_splat_keeps_its_shape(backend):
    stretching, plain = find_viewer("gaussian-splats-3d").effects(Effects(0)), replace(find_viewer("gaussian-splats-3d"), settings=USUAL)
    long = splat(4.0, 1.0, turn=0.5)
    drawn = backend.render(long, camera(), replace(stretching, settings=RenderSettings(least_spread=0.1**0.5))).alpha
    torch.testing.assert_close(drawn, backend.render(long, camera(), plain.effects(Effects(0))).alpha, atol=1e-6, rtol=0)


# The largest splats


@BOTH
@pytest.mark.parametrize(
    ("viewer", "most"), [("spark", 512), ("gaussian-splats-3d", 1024), ("antimatter15", 1024), ("babylon", 1024), ("cesium", 512)]
)
def test_half_axes_are_limited_as_the_viewer_does(backend, viewer, most):
    """Root of eight standard deviations are a half-axis: its variance is at most most²/8, and the other's stays."""
    effects = find_viewer(viewer).effects(Effects(0))
    effects = replace(effects, screen_filter="classic", settings=replace(effects.settings, packing=None, picture_step=None))
    wide = replace(camera(), width=2400, height=3, cx=1200.0, cy=1.5)
    rendered = backend.render(splat(1e7, 4.0, 0.8), wide, effects).alpha[1]
    assert rendered[1200 + most - 1].item() == pytest.approx(0.8 * weight(most - 0.5, 0, most**2 / 8, 4), abs=1e-4)
    assert rendered[1200 + most + 1] == 0 < rendered[1200 - most + 1]


LONGEST = SIZE**2 / 8  # px², the variance of a half-axis that just fits into the picture
# By what fits: the viewer, the splat's variances (px²) and turn, the variances that are left, and pixels to look at.
FITTED = {
    "each half-axis": ("playcanvas", (900.0, 4.0, math.pi / 4), (LONGEST, 4.075), [(3, 3), (6, 5), (2, -2)]),
    "both half-axes": ("playcanvas", (900.0, 900.0, 0.0), (LONGEST, LONGEST), [(6, 3)]),
    "the whole splat": ("playcanvas-webgpu", (900.0, 90.0, 0.0), (LONGEST, 90.075 * LONGEST / 900.075), [(5, 2)]),
    # Askew it is 452 px² across and down, and made smaller by that; 110 px² along the axis are still longer than the picture.
    "the whole, then its axis": ("playcanvas-webgpu", (900.0, 4.0, math.pi / 4), (LONGEST, 4.075 * LONGEST / 452.075), [(3, 3), (5, 5), (1, 1)]),
}


@BOTH
@pytest.mark.parametrize(("viewer", "shape", "left", "pixels"), FITTED.values(), ids=FITTED)
def test_a_splat_fits_into_the_picture(backend, viewer, shape, left, pixels):
    across, down, turn = shape
    rendered = alpha(backend, viewer, splat(across, down, 0.8, turn=turn))
    for x, y in pixels:
        along, beside = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
        assert rendered[MIDDLE + y, MIDDLE + x].item() == pytest.approx(0.8 * faded(weight(along, beside, *left)), abs=1e-5)


@BOTH
def test_a_half_axis_at_its_limit_has_no_gradient(backend):
    leaves, splats = differentiable(splat(900.0, 4.0, 0.8))
    alpha(backend, "playcanvas", splats)[MIDDLE + 2, MIDDLE + 4].backward()
    across, down = leaves["scales"].grad[0, :2].abs().tolist()
    assert across < 1e-4 * down


# Beside the picture


@BOTH
def test_on_the_web_the_projection_is_frozen_nowhere(backend):
    """A ball far aside: along x its variance on the picture is f²σ²/z² · (1 + (x/z)²)."""
    sigma, f = 0.3, 20.0
    near = replace(camera(), fx=f, fy=f)  # half the picture is 0.525 wide: 1.3 of that is 0.68, and 0.9 lies beyond
    for slope in (0.5, 0.9):
        shape = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), sigma)
        ball = Gaussians(torch.tensor([[slope * 2, 0.0, 2.0]]), *shape, torch.tensor([0.9]), torch.zeros(1, 1, 3))
        variance = (f * sigma / 2) ** 2 * (1 + slope**2)
        dx = 20.5 - (SIZE / 2 + f * slope)
        rendered = backend.render(ball, near, Effects(0, eps2d=0.0, settings=RenderSettings(frozen_beyond=math.inf))).alpha
        assert rendered[MIDDLE, 20].item() == pytest.approx(0.9 * math.exp(-(dx**2) / variance / 2), abs=1e-5)
    frozen = backend.render(ball, near, Effects(0, eps2d=0.0)).alpha
    assert frozen[MIDDLE, 20] < rendered[MIDDLE, 20] - 0.01


@BOTH
def test_in_unity_the_width_limits_the_jacobian_along_y_too(backend):
    """A ball in a tall picture, whose half is 2.1 high and 0.525 wide: at a slope of 1 its variance is that at 1.3 · 0.525, also off center."""
    sigma, f, tall = 0.3, 20.0, 4 * SIZE
    for cy in (tall / 2, tall / 2 - 8):
        view = replace(camera(), height=tall, fx=f, fy=f, cy=cy)
        shape = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), sigma)
        ball = Gaussians(torch.tensor([[0.0, 2.0, 2.0]]), *shape, torch.tensor([0.9]), torch.zeros(1, 1, 3))
        for viewer, slope in (("unity", 1.3 * 0.525), ("brush", 1.0)):
            variance = (f * sigma / 2) ** 2 * (1 + slope**2) + 0.3
            rendered = backend.render(ball, view, find_viewer(viewer).effects(Effects(0))).alpha[:, MIDDLE]
            assert rendered[int(cy + f) + 4].item() == pytest.approx(0.9 * math.exp(-(4.5**2) / variance / 2), abs=1e-5)
