"""The closed form between filters: bases and viewers that compensate, integrate or cull, and surfels."""

from dataclasses import replace

import pytest
import torch
from discs import DEPTH, PIXEL, VIEW, adapted, disc, light, seen_from, show

from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, CULL_MARGIN, FormSettings, closed_form, draws_alike, filter_suffices
from mipmap_plugin.adaptation.start.surfel_form import visible_area
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.viewers import find_viewer

MIP = Effects(0, "mip", 0.1)


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


def drawn_by(viewer: str) -> Effects:
    return find_viewer(viewer).effects(Effects(0))


@pytest.mark.parametrize("viewer", ["spark", "antialiased"])
@pytest.mark.parametrize("scale", [1 / 2, 1 / 8])
@pytest.mark.parametrize("size", [(2.0, 0.8), (0.3, 0.05), (0.05, 0.02)])
@pytest.mark.parametrize("opacity", [0.7, 0.05])
def test_a_target_that_compensates_shows_each_splats_light(viewer, scale, size, opacity):
    splat, target = disc(*size, opacity), drawn_by(viewer)
    new = adapted(splat, scale, target=target)
    assert light(new, scale, target) == pytest.approx(light(splat, 1, Effects(0)) * scale**2, rel=1e-6)
    assert new.opacities <= 1


def test_where_only_the_base_was_dilated_light_is_kept_in_distant_views_too():
    """There a base pixel is wider than what the splat was widened by."""
    splat, sharp, views = disc(2.0, 0.8), Effects(0, "mip", 0.0), [VIEW, seen_from(4 * DEPTH)]
    scales, opacities = closed_form(splat, views, 0.9, Effects(0), sharp)
    shown = sum(light(replace(splat, scales=scales, opacities=opacities), 0.9, sharp, view) for view in views)
    assert shown == pytest.approx(0.9**2 * sum(light(splat, 1, Effects(0), view) for view in views), rel=0.02)


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
@pytest.mark.parametrize("viewer", ["playcanvas", "gaussian-splats-3d"])
def test_the_two_longer_axes_stay_clear_of_a_viewers_cull(size, viewer):
    target = drawn_by(viewer)
    variances = (adapted(disc(*size), 1 / 8, target=target).scales[0] / (8 * PIXEL)).square()
    least = CULL_MARGIN * max(target.settings.min_variance - target.eps2d, target.settings.least_spread)
    assert (variances[:2] >= least * (1 - 1e-9)).all() and variances[2] < least


def test_a_splat_that_a_viewer_would_cull_is_seen():
    splat, target = disc(0.8, 0.8), drawn_by("playcanvas")
    shown = [ReferenceBackend().render(each, VIEW.zoomed(1 / 8), target).image.max() for each in (splat, adapted(splat, 1 / 8, target=target))]
    assert shown[0] == 0 and shown[1] > 0.01


def test_the_crispest_surfels_keep_their_size_and_add_as_much_light():
    splat, surfel = disc(0.3, 0.05, opacity=0.02), Effects(0, SURFEL)
    plain, crisp = (adapted(splat, 4, surfel, surfel, crispness) for crispness in (0.0, 1.0))
    torch.testing.assert_close(crisp.scales, splat.scales)
    areas = [visible_area(project(each, VIEW.zoomed(4), 0.2), surfel.eps2d) for each in (plain, crisp)]
    torch.testing.assert_close(crisp.opacities * areas[1], plain.opacities * areas[0])
    opaque = replace(splat, opacities=torch.ones_like(splat.opacities))
    assert torch.equal(*(adapted(opaque, 4, surfel, surfel, crispness).scales[:, :2] for crispness in (0.0, 1.0)))


def test_a_zoom_out_of_surfels_leaves_their_size_and_lowers_opacities_by_a_power_of_the_area():
    splat, surfel = disc(1.0, 0.5), Effects(0, SURFEL)
    new = adapted(splat, 1 / 4, surfel, surfel)
    shown = project(splat, VIEW.zoomed(1 / 4), 0.2)
    assert torch.equal(new.scales, splat.scales)
    larger = visible_area(shown, surfel.eps2d) / visible_area(shown, surfel.eps2d / 16)
    torch.testing.assert_close(new.opacities, splat.opacities / larger**AREA_POWER)
