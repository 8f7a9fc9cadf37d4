"""Bands: the views of a level, and where a ladder's levels begin and end."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import tiny
import torch
from brief_levels import BRIEF, request, wrapped

from mipmap_plugin import recipes
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.image_store import STEPS
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views.policy import over_band
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.levels.ladder import make_levels
from mipmap_plugin.levels.request import FINEST_RATIO, MERGING_COSTS, NARROW, STEPS_KEPT, WIDE, Band, LadderRequest
from mipmap_plugin.levels.yardstick import Yardstick, shrunk
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")


# Bands of views


def test_views_of_a_band_are_spread_evenly_over_it_in_any_run_of_them():
    views = over_band(tiny.cameras(40), AdaptConfig(band=(0.5, 2.0)))
    zooms = sorted(view.zoom for view in views)
    assert 0.5 < zooms[0] < 0.54 and 1.86 < zooms[-1] < 2
    gaps = [math.log2(high / low) for low, high in pairwise(zooms)]
    assert max(gaps) < 3 * 2 / 40
    for first in (0, 11, 29):
        assert any(view.zoom < 1 for view in views[first : first + 3]) and any(view.zoom > 1 for view in views[first : first + 3])


def test_without_a_band_views_stay_the_same_objects():
    views = tiny.cameras()
    assert all(one is other for one, other in zip(over_band(views, AdaptConfig()), views, strict=True))


def test_the_truth_of_a_zoomed_view_is_the_bases_own_image():
    """The base is rendered with its own pixels and dilation, whatever the view's place in the band."""
    base, view, effects = tiny.model(), tiny.cameras()[0], Effects(sh_degree=1)
    truth = PseudoTruth(BaseImages(base, ReferenceBackend(), effects), 1 / 2, AdaptConfig(band=(0.5, 1.0)))
    image = ReferenceBackend().render(base.gaussians(), view, effects).image.clamp(0, 1)
    torch.testing.assert_close(truth(view.zoomed(0.5)), resize(image, (6, 8), "pil-bicubic"), atol=1 / STEPS, rtol=0)


@pytest.mark.parametrize(("scale", "band", "reason"), [
    (1 / 2, (0.5, 4.0), "a band ends at the base's scale"), (2, (0.1, 0.4), "x2 would be shown up to x2, but a band ends at the base's scale"),
    (1 / 2, (2.0, 1.0), "^setting band: must rise, got"), (1 / 2, (0.0, 1.0), "each a number above 0, got"),
])  # fmt: skip
def test_impossible_bands_are_refused(scale, band, reason):
    with pytest.raises(SettingsError, match=reason):
        recipe("default", scale, band=band)


def test_a_band_is_adapted_to():
    """The report of a run over a band judges it by the band: the base in a viewer, say, is another number there than at one scale."""
    one, band = (wrapped().adapt(1 / 2, viewer="antialiased", band=band, **BRIEF).report for band in ((1.0, 1.0), (0.5, 2.0)))
    assert band.settings.band == (0.5, 2.0)
    assert one.validation["the base as it is"] != band.validation["the base as it is"]


# Bands of a ladder


def test_bands_meet_and_end_at_the_coarsest_scale():
    bands = [Band.first(2.0, as_it_is=False)]
    while bands[-1].low > 0.08:
        bands.append(bands[-1].next(2.0, coarsest=0.08))
    assert [band.scale for band in bands] == pytest.approx([1, 1 / 2, 1 / 4, 1 / 8, 0.08])
    assert all(finer.low == coarser.high for finer, coarser in pairwise(bands))
    assert all(band.low < band.scale <= band.high for band in bands)


def test_levels_of_pictures_of_a_pixel_or_two_are_made_for_means_over_all_of_them_and_measured_so():
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3, width=16, height=16))
    asked, yardstick = LadderRequest.of("classic", steps=0, views="given"), Yardstick(base, 0)
    band = Band(1 / 8, 1 / 8, 1 / 8, 2.0)
    adapted = base.adapt(band.scale, **asked.arguments(band.settings()))
    view, image = yardstick.example()
    assert adapted.report.settings.resize == "area"
    torch.testing.assert_close(shrunk(image, view.zoomed(1 / 8)), resize(image, (2, 2), "area"))
    torch.testing.assert_close(shrunk(image, view.zoomed(1 / 4)), resize(image, (4, 4), "pil-bicubic"))


def test_a_base_that_the_viewer_draws_as_its_training_did_stays_as_it_is():
    ladder = make_levels(wrapped(), request("classic", coarsest=0.6))
    first = ladder.levels[0].adapted
    assert "the base as it is" in first.report.returned
    for name, tensor in wrapped().model.parameters().items():
        torch.testing.assert_close(first.model.parameters()[name], tensor, rtol=0, atol=0)


def test_the_ratio_suits_the_viewer():
    effects = Effects(sh_degree=1)
    usual = LadderRequest("spark")
    assert usual.first_ratio(replace(effects, screen_filter="mip")) == WIDE
    assert usual.first_ratio(replace(effects, screen_filter="classic", eps2d=0.075)) == WIDE
    assert usual.first_ratio(replace(effects, screen_filter="classic", eps2d=0.3)) == NARROW
    assert request(ratio=1.5).first_ratio(effects) == 1.5


def test_levels_below_a_half_are_denser_unless_a_ratio_is_asked_for():
    usual = LadderRequest("spark")
    assert usual.next_ratio(0.7, WIDE) == WIDE and usual.next_ratio(0.4, WIDE) == NARROW and usual.next_ratio(0.4, FINEST_RATIO) == FINEST_RATIO
    assert request(ratio=1.5).next_ratio(0.4, 1.5) == 1.5


def test_a_level_that_starts_from_a_finer_one_takes_fewer_steps():
    assert LadderRequest("spark").steps(1 / 4)["steps"] == math.ceil(STEPS_KEPT * recipe("default", 1 / 4).steps)
    assert LadderRequest("spark", recipe="instant").steps(1 / 4)["steps"] == 0


@pytest.mark.parametrize(("name", "settings", "costs"), [("instant", {}, 0.3), ("default", {"steps": 0}, 0.3), ("default", BRIEF, MERGING_COSTS)])
def test_a_level_without_steps_is_merged_from_the_base_as_the_recipe_allows(monkeypatch, name, settings, costs):
    """No step regains what merging costs, which would add up from level to level."""
    base, starts = wrapped(), []
    adapt = base.adapt
    monkeypatch.setattr(base, "adapt", lambda scale, **given: starts.append(given.get("start")) or adapt(scale, **given))
    levels = make_levels(base, LadderRequest("antialiased", 1 / 4, 2.0, recipe=name, settings=settings)).levels[1:]
    assert [level.adapted.report.settings.merging_costs for level in levels] == [costs] * len(levels) and len(starts) == 3
    assert [start is None for start in starts[1:]] == [costs < MERGING_COSTS] * 2


def test_levels_of_a_large_scene_take_fewer_steps_unless_asked_for(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", recipes.DEFAULT_OUT | dict(steps=40, most_draws=1.0, extra_views=2))

    def steps(**settings):
        ladder = make_levels(wrapped(), LadderRequest("classic", coarsest=1 / 2, ratio=4.0, settings={"validation_views": 2, **settings}))
        return ladder.levels[1].adapted.report.settings.steps

    assert steps() == math.ceil(STEPS_KEPT * 40 / 4)
    assert steps(steps=5) == 5


@pytest.mark.parametrize(
    ("options", "reason"),
    [({"coarsest": 2.0}, "goes down"), ({"ratio": 1.0}, "ratio: must be"), ({"until_splats": 0}, "until_splats"), ({"band": (0.5, 1)}, "band: set"),
     ({"least_db": math.nan}, "least_db: must be a number of dB"), ({"recipe": "nonsense"}, "there is no recipe"), ({"steps": -1}, "setting steps"),
     ({"most_sh_degree": 3}, "most_sh_degree: set by the ladder"), ({"ratio": "2"}, "ratio: must be a number, got '2'"),
     ({"least_db": "32"}, "least_db: must be a number"), ({"until_splats": [9]}, "until_splats: must be a number")],
)  # fmt: skip
def test_impossible_ladders_are_refused(options, reason):
    with pytest.raises(SettingsError, match=reason):
        request(**options)


def test_a_group_of_viewers_has_no_ladder():
    with pytest.raises(SettingsError, match="portable is a group of viewers"):
        make_levels(wrapped(), request("portable"))
