"""The start without optimization: exact for one splat that faces the camera, sane for everything else."""

import importlib.util
import math
from dataclasses import replace

import pytest
import samples
import torch

from mipmap_plugin.adaptation.start.closed_form import CULL_MARGIN, MIN_AXIS, FormSettings, closed_form, draws_alike, filter_suffices
from mipmap_plugin.adaptation.start.surfel_form import visible_area
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.cpu import summed_areas
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process import threads
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.filters import compensates, footprint
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.viewers import find_viewer

needs_numba = pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="numba is not installed")

BACKEND = ReferenceBackend()
CLOSED_FORM_AREAS = "mipmap_plugin.adaptation.start.closed_form.summed_areas"
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


def adapted(gaussians: Gaussians, scale: float, base: Effects = Effects(0), target: Effects = Effects(0), crispness: float = 0.0) -> Gaussians:  # noqa: B008
    scales, opacities = closed_form(gaussians, [VIEW], scale, base, target, FormSettings(crispness=crispness))
    return replace(gaussians, scales=scales, opacities=opacities)


def finer(width: float, height: float, scale: float, base: Effects, opacity: float = 0.7, crispness: float = 0.0):
    """The picture at zoom-in of the disc that `base` shows: what an average over pixels widened is narrower again, and no light is lost."""
    whole = BASE_WIDTH[base.screen_filter]
    light = 0.0 if compensates(base.screen_filter) else whole
    averaged = [1 / 12 + crispness * (whole - 1 / 12) / (1 + 12 * side**2) for side in (width, height)]
    shown = [math.sqrt(side**2 + whole - each + each / scale**2) for side, each in zip((width, height), averaged, strict=True)]
    return show(disc(*shown, opacity * math.sqrt((width**2 + light) * (height**2 + light)) / math.prod(shown)), scale, 0.0)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
@pytest.mark.parametrize("base", [Effects(0), Effects(0, "antialiased")], ids=lambda base: base.screen_filter)
def test_zoom_in_shows_what_the_base_is_the_average_of(scale, size, base):
    torch.testing.assert_close(show(adapted(disc(*size), scale, base), scale), finer(*size, scale, base), atol=1e-6, rtol=0)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
@pytest.mark.parametrize("crispness", [0.5, 1.0])
def test_a_crisp_zoom_in_is_narrower_and_no_light_is_lost(scale, size, crispness):
    new = adapted(disc(*size, opacity=0.05), scale, crispness=crispness)
    torch.testing.assert_close(show(new, scale), finer(*size, scale, Effects(0), 0.05, crispness), atol=1e-6, rtol=0)


def test_what_is_wider_than_a_pixel_is_as_wide_at_any_crispness():
    plain, crisp = (adapted(disc(4.0, 0.05, opacity=0.1), 4, crispness=each) for each in (0.0, 1.0))
    torch.testing.assert_close(crisp.scales[:, 0], plain.scales[:, 0], atol=0, rtol=1e-3)
    assert crisp.scales[0, 1] < 0.3 * plain.scales[0, 1]


@pytest.mark.parametrize("crispness", [0.0, 0.5, 1.0])
def test_an_opaque_splat_covers_what_it_covers_in_the_base(crispness):
    """Its opacity cannot rise, so that a narrower one would leave a hole."""
    splat = disc(0.3, 0.05, opacity=1.0)
    new = adapted(splat, 4, crispness=crispness)
    torch.testing.assert_close(new.scales[:, :2].square() + DILATION * (PIXEL / 4) ** 2, splat.scales[:, :2].square() + DILATION * PIXEL**2)
    torch.testing.assert_close(new.opacities, splat.opacities)


@pytest.mark.parametrize(("scale", "narrower"), [(1 / 4, 0.7), (4, 1.0)])
def test_a_compensated_splat_is_narrowed_as_far_as_its_own_opacity_can_rise(scale, narrower):
    """What its base's filter takes off an opacity was no reason to keep it wide: antialiased bases lost 0.8 to 1.6 dB by that at zoom-out."""
    splat, effects = disc(1.0, 0.5), Effects(0, "antialiased")
    scales, opacities = closed_form(splat, [VIEW], scale, effects, effects, FormSettings(crispness=1.0, matched=True))
    torch.testing.assert_close(scales[:, :2].square(), narrower * splat.scales[:, :2].square())
    torch.testing.assert_close(opacities, splat.opacities / narrower)


def test_crispness_is_of_zoom_in_only():
    splat = disc(0.8, 0.3)
    plain, crisp = (adapted(splat, 1 / 4, crispness=each) for each in (0.0, 1.0))
    assert torch.equal(plain.scales, crisp.scales) and torch.equal(plain.opacities, crisp.opacities)


def test_the_crispest_surfels_keep_their_size_and_add_as_much_light():
    splat, surfel = disc(0.3, 0.05, opacity=0.02), Effects(0, SURFEL)
    plain, crisp = (adapted(splat, 4, surfel, surfel, crispness) for crispness in (0.0, 1.0))
    torch.testing.assert_close(crisp.scales, splat.scales)
    areas = [visible_area(project(each, VIEW.zoomed(4), 0.2), surfel.eps2d) for each in (plain, crisp)]
    torch.testing.assert_close(crisp.opacities * areas[1], plain.opacities * areas[0])
    opaque = replace(splat, opacities=torch.ones_like(splat.opacities))
    assert torch.equal(*(adapted(opaque, 4, surfel, surfel, crispness).scales[:, :2] for crispness in (0.0, 1.0)))


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
    assert (new.scales >= MIN_AXIS * PIXEL / scale * (1 - 1e-9)).all()
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


# Targets that compensate, and targets that cull


def drawn_by(viewer: str) -> Effects:
    return find_viewer(viewer).effects(Effects(0))


def light(splat: Gaussians, scale: float, effects: Effects) -> float:
    """px², over 2π: what a splat adds to an image."""
    shown = footprint(project(splat, VIEW.zoomed(scale), effects.near_plane), splat.opacities, effects.screen_filter, effects.eps2d)
    return float(shown.opacities * (shown.yy * shown.across).sqrt())


@pytest.mark.parametrize("viewer", ["spark", "antialiased"])
@pytest.mark.parametrize("scale", [1 / 2, 1 / 8])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05), (0.05, 0.02)])
@pytest.mark.parametrize("opacity", [0.7, 0.05])
def test_a_target_that_compensates_shows_each_splats_light(viewer, scale, size, opacity):
    splat, target = disc(*size, opacity), drawn_by(viewer)
    new = adapted(splat, scale, target=target)
    assert light(new, scale, target) == pytest.approx(light(splat, 1, Effects(0)) * scale**2, rel=1e-6)
    assert new.opacities <= 1


MIP = Effects(0, "mip", 0.1)


@pytest.mark.parametrize(
    ("base", "target", "nothing"),
    [
        (MIP, MIP, False),
        (Effects(0, "antialiased"), Effects(0, "antialiased"), False),
        (MIP, Effects(0, "analytic", 0.1), True),  # which does what a pixel does, whatever the base's filter was
        (MIP, Effects(0, "mip", 0.3), False),
        (Effects(0), Effects(0), False),
        (Effects(0), Effects(0, "analytic", 0.1), False),
        (Effects(0, SURFEL), Effects(0, SURFEL), False),
    ],
)
def test_what_needs_nothing(base, target, nothing):
    assert filter_suffices(base, target) == nothing


@pytest.mark.parametrize(
    ("base", "target", "alike"),
    [
        (MIP, MIP, True),
        (Effects(0, "antialiased"), Effects(0, "antialiased"), True),
        (MIP, Effects(0, "mip", 0.3), False),
        (Effects(0, "antialiased"), MIP, False),
        (Effects(0), Effects(0), False),
        (MIP, Effects(0), False),
        (Effects(0, SURFEL), Effects(0, SURFEL), False),
    ],
)
def test_what_compensates_alike(base, target, alike):
    assert draws_alike(base, target) == alike


@pytest.mark.parametrize("scale", [1 / 4, 4])
def test_what_compensates_alike_changes_only_where_opacities_are_matched(scale):
    splat, effects = disc(1.0, 0.5), Effects(0, "antialiased")
    left, formed = (closed_form(splat, [VIEW], scale, effects, effects, FormSettings(matched=matched)) for matched in (False, True))
    assert torch.equal(left[0], splat.scales) and torch.equal(left[1], splat.opacities)
    assert not torch.equal(formed[0], splat.scales) and not torch.equal(formed[1], splat.opacities)


@pytest.mark.parametrize("size", [(0.8, 0.8), (3.0, 0.05), (0.01, 0.01)])
def test_the_two_longer_axes_stay_clear_of_a_viewers_cull(size):
    target = drawn_by("playcanvas")
    variances = (adapted(disc(*size), 1 / 8, target=target).scales[0] / (8 * PIXEL)).square()
    least = CULL_MARGIN * (target.settings.min_variance - target.eps2d)
    assert (variances[:2] >= least * (1 - 1e-9)).all() and variances[2] < least


def test_a_splat_that_a_viewer_would_cull_is_seen():
    splat, target = disc(0.8, 0.8), drawn_by("playcanvas")
    shown = [BACKEND.render(each, VIEW.zoomed(1 / 8), target).image.max() for each in (splat, adapted(splat, 1 / 8, target=target))]
    assert shown[0] == 0 and shown[1] > 0.01


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_parts_that_threads_share_make_the_same_whole(dtype, monkeypatch):
    g, views = samples.gaussians(70, dtype=dtype), [samples.camera()]
    whole = closed_form(g, views, 1 / 4, Effects(1), Effects(1))
    monkeypatch.setattr("mipmap_plugin.adaptation.parallel.CHUNK", 16)
    made = []
    for count in (1, 3):
        with threads.limited(count, shared=True):
            made.append(closed_form(g, views, 1 / 4, Effects(1), Effects(1)))
    assert all(torch.equal(one, other) for one, other in zip(*made, strict=True))
    torch.testing.assert_close(made[0], whole, rtol=16 * torch.finfo(dtype).eps, atol=0)  # matrix products of other sizes may round otherwise


def test_opacities_follow_the_views_in_which_a_splat_is_large():
    """Both areas are summed over views, as blend weights are: distant views do not take a splat away from the close one."""
    away = VIEW.viewmat.clone()
    away[2, 3] = 50 * DEPTH
    alone, among = (closed_form(disc(20, 20), views, 1 / 4, Effects(0), Effects(0))[1] for views in ([VIEW], [VIEW, VIEW.looking_from(away, "away")]))
    torch.testing.assert_close(among, alone, rtol=0.05, atol=0)


@needs_numba
@pytest.mark.parametrize("scale", [1 / 4, 2])
def test_compiled_areas_are_those_of_torch(scale, monkeypatch):
    """Of splats beside the pictures and behind them too."""
    g, views = samples.gaussians(300, dtype=torch.float32), [samples.camera(), VIEW]
    found = []
    monkeypatch.setattr(CLOSED_FORM_AREAS, lambda *arguments: found.append(summed_areas(*arguments)) or found[-1])
    compiled = closed_form(g, views, scale, Effects(1), Effects(1))
    monkeypatch.setattr(CLOSED_FORM_AREAS, lambda *_: None)
    torch.testing.assert_close(closed_form(g, views, scale, Effects(1), Effects(1)), compiled, rtol=1e-5, atol=0)
    assert found[0].shape == (2, 300)


def test_an_area_beyond_the_type_leaves_the_opacity_as_it_is():
    large = disc(4e10, 4e10).to(dtype=torch.float32)
    assert closed_form(large, [VIEW], 1 / 4, Effects(0), Effects(0))[1].isfinite().all()
