"""The start without optimization: exact for one splat that faces the camera, sane for everything else."""

import importlib.util
import math
from dataclasses import replace

import pytest
import samples
import torch
from discs import DEPTH, PIXEL, VIEW, adapted, disc, seen_from, show

from mipmap_plugin.adaptation.start.closed_form import MIN_AXIS, FormSettings, closed_form
from mipmap_plugin.adaptation.views.pixel_size import mean_pixel_size, pixel_size
from mipmap_plugin.backends.cpu import summed_areas
from mipmap_plugin.effects import Effects
from mipmap_plugin.process import threads
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.filters import compensates

needs_numba = pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="numba is not installed")

CLOSED_FORM_AREAS = "mipmap_plugin.adaptation.start.closed_form.summed_areas"


def finer(width: float, height: float, scale: float, base: Effects, opacity: float = 0.7, crispness: float = 0.0):
    """The picture at zoom-in of the disc that `base` shows: what an average over pixels widened is narrower again, and no light is lost."""
    whole, pixel = base.eps2d, min(1 / 12, base.eps2d)
    light = 0.0 if compensates(base.screen_filter) else whole
    averaged = [pixel + crispness * (whole - pixel) / (1 + 12 * side**2) for side in (width, height)]
    shown = [math.sqrt(side**2 + whole - each + each / scale**2) for side, each in zip((width, height), averaged, strict=True)]
    return show(disc(*shown, opacity * math.sqrt((width**2 + light) * (height**2 + light)) / math.prod(shown)), scale, 0.0)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
@pytest.mark.parametrize("base", [Effects(0), Effects(0, "antialiased")], ids=lambda base: base.screen_filter)
def test_zoom_in_shows_what_the_base_is_the_average_of(scale, size, base):
    torch.testing.assert_close(show(adapted(disc(*size), scale, base), scale), finer(*size, scale, base), atol=1e-6, rtol=0)


@pytest.mark.parametrize("scale", [2, 4])
def test_zoom_in_of_a_mip_base_for_any_viewer(scale):
    base = Effects(0, "mip", 0.1)
    torch.testing.assert_close(show(adapted(disc(1.0, 0.4), scale, base), scale), finer(1.0, 0.4, scale, base), atol=1e-6, rtol=0)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05)])
@pytest.mark.parametrize("crispness", [0.5, 1.0])
@pytest.mark.parametrize("base", [Effects(0), Effects(0, "classic", 0.05)], ids=["usual", "a filter narrower than a pixel"])
def test_a_crisp_zoom_in_is_narrower_and_no_light_is_lost(scale, size, crispness, base):
    new = adapted(disc(*size, opacity=0.05), scale, base, base, crispness)
    torch.testing.assert_close(show(new, scale, base.eps2d), finer(*size, scale, base, 0.05, crispness), atol=1e-6, rtol=0)


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


def test_a_view_from_afar_raises_no_opacity_further():
    opacities = closed_form(disc(0.3, 0.05, opacity=0.2), [VIEW, seen_from(404.0)], 64, Effects(0), Effects(0))[1]
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


@pytest.mark.parametrize(("width", "left"), [(0.2, 0.2), (0.5, 0.3), (1.2, math.sqrt(1.2**2 - DILATION * 15 / 16))])
def test_before_steps_no_splat_is_narrowed_to_a_line(width, left):
    """Seen from nearer than the views it would be one. What is narrower already stays as it is. Target pixels at x1/4."""
    splat = disc(4 * width, 4 * width)
    scales, _ = closed_form(splat, [VIEW], 1 / 4, Effects(0), Effects(0), FormSettings(least_axis=0.3))
    torch.testing.assert_close(scales[0, :2], splat.scales.new_tensor([left, left]) * 4 * PIXEL)


def test_the_least_axis_is_of_zoom_out_only():
    splat = disc(0.8, 0.3)
    plain, wide = (closed_form(splat, [VIEW], 4, Effects(0), Effects(0), FormSettings(least_axis=each))[0] for each in (0.0, 9.0))
    assert torch.equal(plain, wide)


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
    alone, among = (closed_form(disc(20, 20), views, 1 / 4, Effects(0), Effects(0))[1] for views in ([VIEW], [VIEW, seen_from(51 * DEPTH)]))
    torch.testing.assert_close(among, alone, rtol=0.05, atol=0)
    assert not torch.equal(among, alone)


@pytest.mark.parametrize(("scale", "size"), [(1 / 2, pixel_size), (2, mean_pixel_size)])
def test_a_zoom_out_is_formed_for_the_closest_view_and_a_zoom_in_for_the_mean_of_all(scale, size):
    request = splat, views, *_ = disc(1.0, 0.5), [VIEW, seen_from(2 * DEPTH)], scale, Effects(0), Effects(0)
    known = FormSettings(pixel=size(splat.means, views))
    assert all(map(torch.equal, closed_form(*request), closed_form(*request, known)))


def test_a_view_before_whose_near_plane_a_splat_lies_does_not_count():
    splat, settings, base = disc(1.0, 0.5), FormSettings(pixel=torch.tensor([PIXEL]), views=2), Effects(0, "antialiased")
    alone, both = (closed_form(splat, views, 1 / 4, base, Effects(0), settings) for views in ([VIEW], [VIEW, seen_from(base.near_plane / 2)]))
    assert all(map(torch.equal, both, alone))


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
