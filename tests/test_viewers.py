"""Viewers: every rule against its shader, computed by hand for one splat in the middle of an image."""

import math
from dataclasses import replace
from functools import reduce

import pytest
import samples
import tiny
import torch

from mipmap_plugin import cli, register_viewer, wrap_model
from mipmap_plugin.adaptation.renderers import SteppingRenderer
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.gsplat import GsplatBackend
from mipmap_plugin.backends.inria import InriaBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import TritonBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects, explain
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, EvenBuckets, Packing, RenderSettings
from mipmap_plugin.splatting.buckets import even_ranks, ranks, ranks_of_views
from mipmap_plugin.splatting.packing import in_two_steps, packed
from mipmap_plugin.splatting.viewers import BUILT_IN, EDGE, Viewer, find_viewer
from mipmap_plugin.viewing.sources import coarser
from mipmap_plugin.wrap import Wrapped

C0 = 0.28209479177387814
SIZE, FOCAL, DEPTH = 21, 100.0, 10.0  # px, px, world units: 0.1 world units are a pixel
MIDDLE = SIZE // 2
BACKENDS = [ReferenceBackend(), CpuBackend()]
BOTH = pytest.mark.parametrize("backend", BACKENDS, ids=["reference", "cpu"])


def camera() -> Camera:
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, torch.eye(4))


def splat(across: float, down: float, opacity: float = 0.9, color: float = 0.5, turn: float = 0.0, means=(0.0, 0.0, DEPTH)) -> Gaussians:
    """One gray splat of variances `across` and `down` px² at the center of the middle pixel, flat along the axis of view, turned by `turn`."""
    scales = torch.tensor([[math.sqrt(across), math.sqrt(down), 1e-6]]) * DEPTH / FOCAL
    quats = torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]])
    return Gaussians(torch.tensor([means]), quats, scales, torch.tensor([opacity]), torch.full((1, 1, 3), (color - 0.5) / C0))


def alpha(backend, viewer: str, splats: Gaussians) -> torch.Tensor:
    """[SIZE, SIZE] alpha under a viewer whose packing, which has tests of its own, is left out."""
    effects = find_viewer(viewer).effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, color_steps=None, picture_step=None))
    return backend.render(splats, camera(), effects).alpha


def differentiable(splats: Gaussians) -> tuple[dict[str, torch.Tensor], Gaussians]:
    leaves = {name: getattr(splats, name).clone().requires_grad_() for name in ("means", "quats", "scales", "opacities", "sh")}
    return leaves, Gaussians(**leaves)


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


@BOTH
def test_webgpu_drops_a_splat_that_contributes_less_than_three(backend):
    # opacity · 2π · sqrt(det) in half pixels, with variances 4·(0.1 + 0.075) and 4·(0.2 + 0.075)
    least = 3 / (2 * math.pi * math.sqrt(0.7 * 1.1))
    assert alpha(backend, "playcanvas-webgpu", splat(0.1, 0.2, least * 0.999)).max() == 0
    assert alpha(backend, "playcanvas-webgpu", splat(0.1, 0.2, least * 1.001)).max() > 0
    assert alpha(backend, "playcanvas", splat(0.1, 0.2, least * 0.999)).max() > 0


@BOTH
def test_viser_drops_a_splat_whose_opacity_times_determinant_is_less_than_a_quarter(backend):
    # Dilated: 0.5 + 0.3 and 0.1 + 0.3 px², a determinant of 0.32 px⁴
    least = 0.25 / 0.32
    assert alpha(backend, "viser", splat(0.5, 0.1, least * 0.999)).max() == 0
    assert alpha(backend, "viser", splat(0.5, 0.1, least * 1.001)).max() > 0
    assert alpha(backend, "classic", splat(0.5, 0.1, least * 0.999)).max() > 0


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
    end = math.exp(-4) if viewer == "playcanvas" else 0.0
    for x in (1, 3):
        weight = math.exp(-(x**2) / 2 / (4.0 + more))
        assert rendered[MIDDLE, MIDDLE + x] == pytest.approx(0.8 * (weight - end) / (1 - end), abs=2e-5)


@BOTH
def test_playcanvas_fades_and_other_viewers_cut_at_the_root_of_eight(backend):
    # Dilated to 1 px²: pixels at 2 and 3 lie this side and that of 2.83 standard deviations.
    faded = alpha(backend, "playcanvas", splat(0.925, 0.925, 0.9))
    end = math.exp(-4)
    assert faded[MIDDLE, MIDDLE + 2] == pytest.approx(0.9 * (math.exp(-2) - end) / (1 - end), abs=1e-5)
    assert faded[MIDDLE + 2, MIDDLE + 2] == 0  # just at the edge: A = 1
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
        down, across = (0.8 * math.exp(-(step**2) / 2 / (1.3 + sign * math.sqrt(0.1))) for sign in (1, -1))
        assert rendered[MIDDLE + step, MIDDLE] == pytest.approx(down, abs=1e-5)
        assert rendered[MIDDLE, MIDDLE + step] == pytest.approx(across, abs=1e-5)


@BOTH
def test_gaussian_splats_3d_turns_a_nearly_round_splat(backend):
    """The shader's own steps: eigenvalues, an eigenvector that is none, and the weight in that basis."""
    a, b, d = 1.15 + 0.3, 0.15, 1.15 + 0.3  # of variances 1.3 and 1.0, turned by 45 degrees
    middle, spread = (a + d) / 2, math.sqrt(max(0.1, ((a + d) / 2) ** 2 - (a * d - b * b)))
    x, y = b / math.hypot(b, middle + spread - a), (middle + spread - a) / math.hypot(b, middle + spread - a)
    rendered = alpha(backend, "gaussian-splats-3d", splat(1.3, 1.0, 0.8, turn=math.pi / 4))
    for dx, dy in ((1, 1), (1, -1), (2, 0), (0, 2)):
        along, across = dx * x + dy * y, dx * y - dy * x
        weight = math.exp(-(along**2 / (middle + spread) + across**2 / (middle - spread)) / 2)
        assert rendered[MIDDLE + dy, MIDDLE + dx] == pytest.approx(0.8 * weight, abs=2e-5)


@BOTH
def test_programs_that_took_its_eigenvalues_stretch_splats_or_drop_them(backend):
    """NVIDIA's viewer does both, MetalSplatter stretches less, and Godot's only drops. NVIDIA's stretches level splats along (1, up)."""
    small, a_little_larger, round_one = splat(0.0161, 0.0161), splat(0.0163, 0.0163), splat(1.0, 1.0, 0.8)
    stretched = {"vk-gaussian-splatting": math.sqrt(0.1), "metalsplatter": 0.1, "gdgs": 0.0}
    for viewer, spread in stretched.items():
        x, y = (1, spread) if viewer == "vk-gaussian-splatting" else (0, 1)
        along, across = (2 * y) ** 2 / (x * x + y * y), (2 * x) ** 2 / (x * x + y * y)  # of a pixel two below the middle
        weight = 0.8 * math.exp(-(along / (1.3 + spread) + across / (1.3 - spread)) / 2)
        assert alpha(backend, viewer, round_one)[MIDDLE + 2, MIDDLE] == pytest.approx(weight, abs=1e-5)
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
def test_lichtfeld_draws_half_a_step_of_8_bits_and_leaves_out_by_the_center(backend):
    """Its rasterizer of 2026; that of 2025 drew as Brush does."""
    def seen(viewer, opacity, halves=0.0):
        return alpha(backend, viewer, splat(900.0, 900.0, opacity, means=(halves * SIZE / 2 * DEPTH / FOCAL, 0.0, DEPTH))).max()

    assert seen("lichtfeld", 0.7 / 255) > 0 == seen("brush", 0.7 / 255) == seen("lichtfeld", 0.4 / 255)
    assert seen("lichtfeld", 0.9, 1.39) > 0.5 and seen("lichtfeld", 0.9, 1.41) == 0 < seen("brush", 0.9, 1.41)
    bright = backend.render(splat(4.0, 4.0, 0.5, 9.0), camera(), find_viewer("lichtfeld").effects(Effects(0))).image
    assert bright[MIDDLE, MIDDLE, 0].item() == pytest.approx(0.5 * 4, abs=1e-5)


@BOTH
def test_a_long_splat_keeps_its_shape(backend):
    stretching, plain = find_viewer("gaussian-splats-3d").effects(Effects(0)), replace(find_viewer("gaussian-splats-3d"), settings=USUAL)
    long = splat(4.0, 1.0, turn=0.5)
    drawn = backend.render(long, camera(), replace(stretching, settings=RenderSettings(least_spread=0.1**0.5))).alpha
    torch.testing.assert_close(drawn, backend.render(long, camera(), plain.effects(Effects(0))).alpha, atol=1e-6, rtol=0)


# The largest splats


def weight(dx: float, dy: float, across: float, down: float) -> float:
    return 0.8 * math.exp(-(dx**2 / across + dy**2 / down) / 2)


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
    assert rendered[1200 + most - 1].item() == pytest.approx(weight(most - 0.5, 0, most**2 / 8, 4), abs=1e-4)
    assert rendered[1200 + most + 1] == 0 < rendered[1200 - most + 1]


@BOTH
def test_in_playcanvas_each_half_axis_fits_into_the_picture(backend):
    # 21 px are the picture's shorter side: a variance of 21²/8 px² at most; at 45 degrees the other axis keeps 4 px².
    rendered, end = alpha(backend, "playcanvas", splat(900.0, 4.0, 0.8, turn=math.pi / 4)), math.exp(-4)
    for x, y in ((3, 3), (6, 5), (2, -2)):
        along, across = (x + y) / math.sqrt(2), (x - y) / math.sqrt(2)
        whole = weight(along, across, SIZE**2 / 8, 4.075) / 0.8
        assert rendered[MIDDLE + y, MIDDLE + x].item() == pytest.approx(0.8 * (whole - end) / (1 - end), abs=1e-5)


@BOTH
def test_a_round_splat_fits_into_the_picture_too(backend):
    rendered, end = alpha(backend, "playcanvas", splat(900.0, 900.0, 0.8)), math.exp(-4)
    whole = weight(6, 3, SIZE**2 / 8, SIZE**2 / 8) / 0.8
    assert rendered[MIDDLE + 3, MIDDLE + 6].item() == pytest.approx(0.8 * (whole - end) / (1 - end), abs=1e-5)


@BOTH
def test_webgpu_makes_the_whole_splat_smaller(backend):
    # Of 900 px² across, 21²/8 are left, and of 90 down as large a share.
    rendered, end = alpha(backend, "playcanvas-webgpu", splat(900.0, 90.0, 0.8)), math.exp(-4)
    share = SIZE**2 / 8 / 900.075
    whole = weight(5, 2, 900.075 * share, 90.075 * share) / 0.8
    assert rendered[MIDDLE + 2, MIDDLE + 5].item() == pytest.approx(0.8 * (whole - end) / (1 - end), abs=1e-5)


@BOTH
def test_webgpu_shortens_the_axis_of_a_smaller_splat_that_lies_askew(backend):
    # Of 452 px² across and down, 21²/8 are left; 110 px² along the axis are still longer than the picture.
    rendered, end = alpha(backend, "playcanvas-webgpu", splat(900.0, 4.0, 0.8, turn=math.pi / 4)), math.exp(-4)
    share = SIZE**2 / 8 / 452.075
    for x, y in ((3, 3), (5, 5), (1, 1)):
        whole = weight(math.hypot(x, y), 0, SIZE**2 / 8, 4.075 * share) / 0.8
        assert rendered[MIDDLE + y, MIDDLE + x].item() == pytest.approx(0.8 * (whole - end) / (1 - end), abs=1e-5)


@BOTH
def test_a_half_axis_at_its_limit_has_no_gradient(backend):
    leaves, splats = differentiable(splat(900.0, 4.0, 0.8))
    alpha(backend, "playcanvas", splats)[MIDDLE + 2, MIDDLE + 4].backward()
    across, down = leaves["scales"].grad[0, :2].abs().tolist()
    assert across < 1e-4 * down


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


# Colors and order


@BOTH
def test_spark_clips_colors_and_shows_them_in_steps(backend):
    effects = find_viewer("spark").effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))

    def color(value):
        rendered = backend.render(splat(40.0, 40.0, 1.0, value), camera(), effects)
        return (rendered.image[MIDDLE, MIDDLE, 0] / rendered.alpha[MIDDLE, MIDDLE]).item()

    assert color(1.7) == pytest.approx(1.0, abs=1e-6)
    assert color(100.4 / 255) == pytest.approx(100 / 255, abs=1e-6)
    assert color(100.6 / 255) == pytest.approx(101 / 255, abs=1e-6)


@BOTH
def test_a_color_in_steps_keeps_its_gradient(backend):
    leaves, splats = differentiable(splat(40.0, 40.0, 1.0, 0.2 / 255))  # shown as black, and not black
    effects = find_viewer("spark").effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))
    rendered = backend.render(splats, camera(), effects)
    rendered.image[MIDDLE, MIDDLE, 0].backward()
    assert leaves["sh"].grad[0, 0, 0] == pytest.approx(C0 * rendered.alpha[MIDDLE, MIDDLE].item(), rel=1e-4)


@BOTH
def test_spark_sorts_by_distance(backend):
    """The splat of lesser depth may be farther from the camera, if it is off-axis."""
    near, far = splat(900.0, 900.0, 1.0, 1.0, means=(0.0, 0.0, 10.0)), splat(900.0, 900.0, 1.0, 0.0, means=(4.6, 0.0, 9.9))
    pair = near.joined(far)
    wide = replace(camera(), width=120, cx=60.0)
    first = {name: backend.render(pair, wide, find_viewer(name).effects(Effects(0))).image[MIDDLE, 82, 0].item() for name in ("spark", "classic")}
    assert first["spark"] > 0.5 > first["classic"]


def test_buckets_are_finer_near_the_camera():
    """A box 960 deep with the camera in its middle: 32 bins of 30 units, 1025 buckets for 209 weights.

    The bin before the camera has 20 weights, 98 buckets of 0.31 units; eleven bins from it, it is 1 weight, 4 buckets of 7.5 units.
    """
    depths = torch.tensor([10.0, 10.5, 310.0, 310.5, 311.0])
    means = torch.zeros(6, 3)
    means[1:, 2], means[0, 2] = depths, 0.0
    means[1:, 0] = torch.tensor([4.0, 3.0, 2.0, 1.0, 0.0])  # Morton's order is that of x
    scales = torch.full((6, 3), 1e-3)
    scales[0] = 240.0  # the box ends at two of them
    places = ranks(Gaussians(means, torch.ones(6, 4), scales, torch.ones(6), torch.zeros(6, 1, 3)), camera())
    assert places[1] < places[2] < min(places[3:])  # by depth
    assert places[5] < places[4] < places[3]  # by x


@BOTH
def test_playcanvas_does_not_sort_within_a_bucket(backend):
    """In a bounding box so deep that two splats share a bucket, the one in the lower cell along x is composited in front, though it is behind."""
    near, far = splat(40.0, 40.0, 1.0, 1.0, means=(0.01, 0.0, 10.0)), splat(40.0, 40.0, 1.0, 0.0, means=(-0.01, 0.0, 10.01))
    large = replace(splat(1.0, 1.0, means=(0.0, 0.0, -50.0)), scales=torch.full((1, 3), 1e3))
    drawn = {}
    for context in ((), (large,)):
        parts = (near, far, *context)
        together = reduce(Gaussians.joined, parts)
        drawn[len(parts)] = backend.render(together, camera(), find_viewer("playcanvas").effects(Effects(0))).image[MIDDLE, MIDDLE, 0].item()
    assert drawn[2] > 0.9 and drawn[3] < 0.1


def test_buckets_of_babylon_are_even():
    """1025 buckets over 1024 units of depth: one unit each, wherever the camera is. Within one the earlier row is in front."""
    depths = torch.tensor([0.0, 1024.0, 500.9, 500.1, 499.9])
    means = torch.cat([torch.zeros(5, 2), depths[:, None]], 1)
    splats = Gaussians(means, torch.ones(5, 4), torch.ones(5, 3), torch.ones(5), torch.zeros(5, 1, 3))
    assert even_ranks(splats, camera(), EvenBuckets()).tolist() == [0, 4, 2, 3, 1]
    assert even_ranks(splats, camera(), EvenBuckets(1024, later_in_front=True)).tolist() == [0, 4, 3, 2, 1]
    larger = replace(splats, scales=torch.tensor([1.0, 1.0, 1.0, 2.0, 1.0])[:, None].expand(5, 3))
    assert even_ranks(larger, camera(), EvenBuckets(1024, largest_first=True)).tolist() == [0, 4, 3, 2, 1]


def test_buckets_of_three_js_divide_a_sphere_around_all_splats():
    """Of a middle at a depth of 50 and a radius of 50 + 2 · 5: it ends at 110, and begins before the camera's least depth of 10."""
    means = torch.zeros(5, 3)
    means[:, 2] = torch.tensor([0.0, 100.0, 29.9, 20.1, 19.9])
    splats = Gaussians(means, torch.ones(5, 4), torch.full((5, 3), 5.0), torch.ones(5), torch.zeros(5, 1, 3))
    places = even_ranks(splats, camera(), EvenBuckets(10, sphere_from=10.0, later_in_front=True))  # buckets of 10 units
    assert places.tolist() == [1, 4, 3, 2, 0]


def test_the_order_of_several_views_is_that_of_each():
    means = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, DEPTH])
    splats = Gaussians(means, torch.ones(50, 4), torch.ones(50, 3), torch.ones(50), torch.zeros(50, 1, 3))
    aside = camera().looking_from(torch.tensor([[0.6, 0.0, -0.8, 6.0], [0.0, 1.0, 0.0, 0.0], [0.8, 0.0, 0.6, 4.0], [0.0, 0.0, 0.0, 1.0]]), "")
    bucketed, even = RenderSettings(bucketed=True), EvenBuckets(10)
    found = ranks_of_views(splats, [(aside, bucketed), (aside, RenderSettings(even_buckets=even)), (camera(), USUAL), (camera(), bucketed)])
    expected = [ranks(splats, aside), even_ranks(splats, aside, even), None, ranks(splats, camera())]
    assert [None if own is None else own.tolist() for own in found] == [None if own is None else own.tolist() for own in expected]
    assert not torch.equal(expected[0], expected[3])


@BOTH
@pytest.mark.parametrize(
    ("viewer", "front"), [("three", 1.0), ("gaussian-splats-3d", 1.0), ("viser", 1.0), ("gsplat-js", 0.0), ("antimatter15", 0.0)]
)
def test_a_viewer_does_not_sort_within_a_bucket(backend, viewer, front):
    """Beside a center so far away that two splats share a bucket, either the later row is in front, or the earlier one, whatever their depths."""
    rows = [splat(40.0, 40.0, 1.0, color, means=(0.0, 0.0, 10.0)) for color in (0.0, 1.0)]
    nearer = replace(rows[0], means=rows[0].means - torch.tensor([0.0, 0.0, 0.01]))
    far = splat(1.0, 1.0, means=(0.0, 0.0, 1e4))
    for parts, expected in (((nearer, rows[1]), 0.0), ((nearer, rows[1], far), front), ((rows[1], nearer, far), 1 - front)):
        together = reduce(Gaussians.joined, parts)
        drawn = backend.render(together, camera(), find_viewer(viewer).effects(Effects(0))).image[MIDDLE, MIDDLE, 0].item()
        assert drawn == pytest.approx(expected, abs=0.1)


@BOTH
def test_babylon_does_not_sort_within_a_bucket(backend):
    """Beside a center so far away that two splats share a bucket, the first row is in front, though it is behind."""
    rows = (splat(40.0, 40.0, 1.0, 0.0, means=(0.0, 0.0, 10.01)), splat(40.0, 40.0, 1.0, 1.0, means=(0.0, 0.0, 10.0)))
    far = splat(1.0, 1.0, means=(0.0, 0.0, 1e4))
    drawn = []
    for parts in (rows, (*rows, far)):
        together = reduce(Gaussians.joined, parts)
        drawn.append(backend.render(together, camera(), find_viewer("babylon").effects(Effects(0))).image[MIDDLE, MIDDLE, 0].item())
    assert drawn[0] > 0.9 and drawn[1] < 0.1


@BOTH
def test_babylon_limits_colors_to_those_of_the_frame_buffer(backend):
    drawn = {name: backend.render(splat(900.0, 900.0, 0.5, 3.0), camera(), find_viewer(name).effects(Effects(0))) for name in ("babylon", "classic")}
    middle = {name: rendered.image[MIDDLE, MIDDLE, 0].item() for name, rendered in drawn.items()}
    assert middle == pytest.approx({"babylon": 0.5, "classic": 1.5}, abs=0.01)


def test_a_viewer_without_a_record_is_refused_with_what_to_take_instead():
    with pytest.raises(SettingsError, match=r"^viewer polycam: .*take portable"):
        find_viewer("polycam")
    assert find_viewer("nerfstudio") is find_viewer("gsplat") and find_viewer("inria") is find_viewer("classic")


def test_the_order_is_one_or_the_other():
    for orders in (dict(radial=True, bucketed=True), dict(bucketed=True, even_buckets=EvenBuckets())):
        with pytest.raises(SettingsError, match="`radial`, `bucketed` and `even_buckets` are different orders"):
            RenderSettings(**orders)


# Pictures of 8 bits


@BOTH
def test_an_8_bit_image_is_rounded_after_every_splat_from_the_back(backend):
    settings = RenderSettings(min_alpha=0.5 / 255, max_alpha=0.999, min_transmittance=1e-6, picture_step=1 / 255)
    parts = [splat(30.0, 30.0, opacity, color, means=(0.0, 0.0, depth)) for opacity, color, depth in ((0.01, 0.3, 9.0), (0.3, 0.9, 10.0))]
    both = parts[0].joined(parts[1])
    rendered = backend.render(both, camera(), Effects(0, settings=settings, background=(0.2, 0.2, 0.2)))
    behind = round(255 * (0.3 * 0.9 + 0.7 * 0.2)) / 255
    assert rendered.image[MIDDLE, MIDDLE, 0].item() == pytest.approx(round(255 * (0.01 * 0.3 + 0.99 * behind)) / 255, abs=1e-6)


@BOTH
def test_a_splat_of_less_than_half_a_step_is_not_seen_and_has_its_gradient(backend):
    leaves, splats = differentiable(splat(30.0, 30.0, 0.01, 0.5))
    settings = [RenderSettings(picture_step=step) for step in (1 / 255, None)]
    images = [backend.render(splats, camera(), Effects(0, settings=choice, background=(0.6, 0.6, 0.6))).image for choice in settings]
    assert (images[0] == images[0][0, 0]).all() and not (images[1] == images[1][0, 0]).all()
    gradients = [torch.autograd.grad(image.sum(), list(leaves.values()), retain_graph=True) for image in images]
    for rounded, exact in zip(*gradients, strict=True):
        torch.testing.assert_close(rounded, exact)


# Linear light


@BOTH
def test_metalsplatter_blends_in_linear_light(backend):
    """Half of a splat of 0.2 over white: in linear light, 0.5 · 0.2^2.2 + 0.5, which sRGB shows as 0.747, where others show 0.6."""
    effects = replace(find_viewer("metalsplatter").effects(Effects(0)), background=(1.0, 1.0, 1.0))
    image = backend.render(splat(400.0, 400.0, 0.5, 0.2), camera(), effects).image
    light = 0.5 * 0.2**2.2 + 0.5
    assert image[MIDDLE, MIDDLE].tolist() == pytest.approx([1.055 * light ** (1 / 2.4) - 0.055] * 3, abs=1e-5)
    others = replace(effects, settings=replace(effects.settings, linear_light=None))
    assert backend.render(splat(400.0, 400.0, 0.5, 0.2), camera(), others).image[MIDDLE, MIDDLE, 0] == pytest.approx(0.6, abs=1e-5)


@BOTH
def test_a_background_is_shown_as_it_is_in_linear_light(backend):
    behind = (0.02, 0.4, 1.0)  # on the line of sRGB, on its curve, and white
    effects = Effects(0, background=behind, settings=RenderSettings(linear_light=2.2))
    image = backend.render(splat(1.0, 1.0), camera(), effects).image
    assert image[0, 0].tolist() == pytest.approx(behind, abs=1e-6)


@BOTH
def test_black_has_finite_gradients_in_linear_light(backend):
    leaves, black = differentiable(splat(9.0, 9.0, color=-0.5))
    backend.render(black, camera(), Effects(0, settings=RenderSettings(linear_light=2.2))).image.sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


def test_all_views_of_a_step_are_blended_in_linear_light():
    light, plain = Effects(0, settings=RenderSettings(linear_light=2.2)), Effects(0)
    splats, backend = splat(9.0, 9.0), CpuBackend()
    views = [view.image for view in backend.render_views(splats, [(camera(), plain), (camera(), light)])]
    assert all(torch.equal(view, backend.render(splats, camera(), effects).image) for view, effects in zip(views, (plain, light), strict=True))


def test_steps_by_rows_are_not_taken_in_linear_light():
    light = find_viewer("metalsplatter").effects(Effects(0))
    assert SteppingRenderer.of(CpuBackend(), [Effects(0)]) and not SteppingRenderer.of(CpuBackend(), [Effects(0), light])


@pytest.mark.parametrize("also", [{"max_color": 1.0}, {"picture_step": 1 / 255}, {"packing": find_viewer("spark").settings.packing}])
def test_linear_light_goes_with_no_rounding(also):
    with pytest.raises(SettingsError, match="leave those out"):
        RenderSettings(linear_light=2.2, **also)


# Beside the picture


@BOTH
@pytest.mark.parametrize(("viewer", "most"), [("spark", 1.4), ("gaussian-splats-3d", 1.2), ("splatapult", 1.5), ("gdgs", 1.2), ("web-splat", 1.2)])
def test_a_splat_is_left_out_by_its_center(backend, viewer, most):
    def seen(halves):
        return alpha(backend, viewer, splat(900.0, 900.0, means=(halves * SIZE / 2 * DEPTH / FOCAL, 0.0, DEPTH))).max()

    assert seen(most - 0.01) > 0.5 and seen(1 - most) > 0.5
    assert seen(most + 0.01) == seen(-most - 0.01) == 0
    assert alpha(backend, "playcanvas", splat(900.0, 900.0, means=(1.5 * SIZE / 2 * DEPTH / FOCAL, 0.0, DEPTH))).max() > 0.5


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
def test_gsplat_draws_splats_that_are_nearer_than_inria_draws_them(backend):
    """The limits of the two projects; splats so near fill the picture."""
    for depth, by_gsplat, by_inria in ((0.005, False, False), (0.1, True, False), (0.3, True, True)):
        drawn = [bool(alpha(backend, viewer, splat(4.0, 4.0, means=(0.0, 0.0, depth))).max() > 0) for viewer in ("gsplat", "classic")]
        assert drawn == [by_gsplat, by_inria]


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


# Packing


def test_spark_packs_scales_in_254_steps_and_opacities_in_steps_of_two():
    packing = find_viewer("spark").settings.packing
    splats = samples.gaussians(200)
    kept = packed(splats, samples.camera(), packing)
    code = (kept.scales.log() + 12) * 254 / 21
    assert (code - code.round()).abs().max() < 1e-9
    assert (kept.scales.log() - splats.scales.log()).abs().max() <= 21 / 254 / 2 + 1e-9
    code = kept.opacities * 255 / 2
    assert (code - code.round()).abs().max() < 1e-9 and (kept.opacities - splats.opacities).abs().max() < 1.6 / 255


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


# Records


def test_effects_of_a_viewer_are_on_and_the_rest_is_off():
    active = {}
    for viewer in (record.name for record in BUILT_IN):
        active[viewer] = {part.name for part in explain(find_viewer(viewer).effects(Effects(0)), splat(1.0, 1.0)) if part.on}
    assert active["classic"] == {"screen filter"}
    web = {"screen filter", "edge", "size limit", "packing", "rounded picture"}
    assert active["spark"] == web | {"compensation", "frame", "color limit", "order by distance"}
    assert active["playcanvas"] == web | {"size cull", "color limit", "coarse order"}
    assert active["playcanvas-webgpu"] == active["playcanvas"] - {"coarse order"} | {"contribution cull"}
    assert active["gaussian-splats-3d"] == web | {"frame", "stretching", "coarse order"}


def test_the_usual_viewers_have_the_usual_settings():
    assert all(find_viewer(name).settings == USUAL for name in ("classic", "antialiased", "mip"))
    assert find_viewer("classic").effects(Effects(2)) == Effects(2)


def test_supersplat_is_playcanvas_and_every_record_is_under_its_name():
    assert find_viewer("supersplat") is find_viewer("playcanvas")
    assert all(find_viewer(viewer.name) is viewer and viewer.source and viewer.title for viewer in BUILT_IN)


def test_a_new_viewer_is_one_record():
    register_viewer("blurry", Viewer("blurry", "A blurry one", "nowhere", "classic", 2.0))
    model = wrap_model(tiny.model(), cameras=tiny.cameras(1), backend="reference")
    rendered = model.render(tiny.cameras(1)[0], viewer="blurry").image
    expected = model.render(tiny.cameras(1)[0]).image
    assert not torch.allclose(rendered, expected)
    register_viewer("wrong", 3)
    with pytest.raises(PluginError, match=r"viewer 'wrong' must be a .*, got int"):
        find_viewer("wrong")


@pytest.mark.parametrize(("name", "guess"), [("antialised", "; did you mean antialiased"), (None, "$")])
def test_a_screen_filter_that_there_is_not_is_told_with_what_was_probably_meant(name, guess):
    with pytest.raises(SettingsError, match=f"viewer 'a': there is no screen filter '{name}'; choose from classic, .*, window{guess}"):
        Viewer("a", "A", "nowhere", name, 2.0)


def test_a_viewer_draws_no_more_bands_than_it_has():
    effects = find_viewer("gaussian-splats-3d").effects(Effects(3, background=(1.0, 1.0, 1.0), near_plane=0.5))
    assert (effects.sh_degree, effects.background, effects.near_plane) == (0, (1.0, 1.0, 1.0), 0.5)
    assert find_viewer("spark").effects(Effects(2)).sh_degree == 2


@pytest.mark.parametrize("backend", [GsplatBackend(), InriaBackend()], ids=lambda backend: backend.name)
def test_backends_on_a_gpu_report_what_they_do_not_support(backend):
    needs = Needs.of(splat(1.0, 1.0), find_viewer("gaussian-splats-3d").effects(Effects(0)), gradients=True)
    [reason] = [reason for reason in backend.lacking(needs) if "reference backend does" in reason]
    assert "stretching of round splats" in reason and "packing" in reason and "splats that end at a radius" in reason
    assert not [reason for reason in backend.lacking(replace(needs, settings=USUAL)) if "reference backend does" in reason]


def test_triton_draws_every_viewer():
    needs = [Needs.of(splat(1.0, 1.0), viewer.effects(Effects(0)), gradients=True) for viewer in BUILT_IN]
    capabilities = TritonBackend().capabilities
    assert not [reason for need in needs for reason in capabilities.lacking(replace(need, device=next(iter(capabilities.devices))))]


def test_filters_that_integrate_are_no_viewers():
    needs = Needs.of(splat(1.0, 1.0), Effects(0, "analytic", settings=RenderSettings(min_variance=1.0)), gradients=True)
    for backend in BACKENDS:
        assert "the screen filter analytic does not support culling by size" in backend.lacking(needs)


def test_a_splat_that_fades_needs_an_end():
    with pytest.raises(SettingsError, match="give radius"):
        RenderSettings(fades=True)


@pytest.mark.parametrize("limit", [{"max_half_axis": 512.0}, {"fits_picture": True}])
def test_a_half_axis_that_is_limited_needs_an_end(limit):
    with pytest.raises(SettingsError, match="give radius"):
        RenderSettings(**limit)


def test_sizes_keep_their_meaning_under_supersampling():
    assert find_viewer("spark").settings.finer(2).max_half_axis == 1024
    usual, culled = Effects(0, supersampling=3), find_viewer("playcanvas").effects(Effects(0, supersampling=3))
    assert culled.settings.finer(3).min_variance == pytest.approx(9 / 8)
    assert usual.settings.finer(3) is usual.settings
    assert culled.settings.radius == EDGE


# A model, and the command


def wrapped() -> Wrapped:
    return wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="reference")


def test_a_model_is_rendered_as_in_the_viewer():
    model, view = wrapped(), tiny.cameras(1)[0]
    rendered = model.render(view, viewer="playcanvas")
    expected = ReferenceBackend().render(model.model.gaussians(view), view, find_viewer("playcanvas").effects(model.effects()))
    assert torch.equal(rendered.image, expected.image)
    assert not torch.allclose(rendered.image, model.render(view).image)


def test_depth_is_no_color():
    model, view = wrapped(), tiny.cameras(1)[0]
    assert model.render(view, outputs=("depth",), viewer="spark").depth.max() > 1.5


def test_a_viewer_has_its_own_screen_filter():
    with pytest.raises(SettingsError, match="viewer spark has a screen filter of its own"):
        wrapped().render(tiny.cameras(1)[0], screen_filter="mip", viewer="spark")


def test_the_command_renders_as_in_a_viewer(tmp_path, capsys):
    folder = tiny.folder(tmp_path / "model")
    words = ["render", str(folder), "--output", str(tmp_path / "out"), "--viewer", "supersplat"]
    assert cli.main(words) == 0
    assert list((tmp_path / "out").glob("*.png"))
    words[-1] = "superspalt"
    assert cli.main([*words, "--overwrite"]) == 2
    assert "there is no viewer 'superspalt'; choose from" in capsys.readouterr().err


def test_an_option_that_is_not_there_is_refused():
    with pytest.raises(TypeError, match=r"unknown options: filter3d; there are scale, .*, viewer, filter_3d, outputs, clamped, exposure"):
        wrap_model(tiny.model(4), cameras=tiny.cameras(), backend="reference").render(tiny.cameras()[0], filter3d=True)
