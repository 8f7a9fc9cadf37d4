"""Matching blend weights: exact for two splats of which one half hides the other, and harmless for the rest."""

from dataclasses import replace
from statistics import fmean
from types import SimpleNamespace

import discs
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.start import matching
from mipmap_plugin.adaptation.start.blend_weights import Wanted, blend_weights
from mipmap_plugin.adaptation.start.candidates import Candidates
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.matching import MAX_FACTOR, PART_PIXELS, SWEEPS, UNMATCHED, WIDE, Matcher, matched_opacities, sweeps_over
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

VIEW = Camera(4, 3, 10.0, 10.0, 2.0, 1.5, torch.eye(4))
PIXELS = 12


def walls(*opacities: float) -> Gaussians:
    """Splats one behind the other, each so wide that it covers the whole view evenly."""
    count = len(opacities)
    means = torch.tensor([[0.0, 0.0, 2.0 + depth] for depth in range(count)], dtype=torch.float64)
    quats, scales = means.new_tensor([[1.0, 0, 0, 0]]).repeat(count, 1), means.new_tensor([[1e3, 1e3, 0.0]]).repeat(count, 1)
    return Gaussians(means, quats, scales, means.new_tensor(opacities), means.new_ones(count, 1, 3))


def weigh(opacities: torch.Tensor) -> torch.Tensor:
    return blend_weights(replace(walls(*opacities.tolist()), opacities=opacities), [VIEW], ReferenceBackend(), Effects(0))


HALF = torch.tensor([PIXELS / 2, PIXELS / 4], dtype=torch.float64)  # px: of two walls that cover half of what they are before

WHOLE = SWEEPS[1].usual  # three times over all views

NOTHING = torch.zeros(2)  # of splats that are seen as a whole, whatever that is


def test_the_weights_of_two_walls_are_known():
    torch.testing.assert_close(weigh(torch.tensor([0.5, 0.5], dtype=torch.float64)), HALF, rtol=1e-4, atol=0)


@pytest.mark.parametrize("opacities", [(0.9, 0.9), (0.8, 0.2), (0.3, 0.3), (0.3, 0.9)])
def test_opacities_become_those_that_were_wanted(opacities):
    new = matched(torch.tensor(opacities, dtype=torch.float64), HALF, NOTHING, weigh)
    torch.testing.assert_close(new, torch.full_like(new, 0.5), rtol=1e-3, atol=0)


def test_every_round_comes_closer():
    tried = []
    matched(torch.tensor([0.95, 0.05], dtype=torch.float64), HALF, NOTHING, lambda opacities: tried.append(opacities) or weigh(opacities))
    far = [float((weigh(each) - HALF).abs().sum()) for each in tried]
    assert len(far) == len(WHOLE) and far == sorted(far, reverse=True)


def test_no_opacity_rises_above_one():
    new = matched(torch.tensor([0.5, 0.5], dtype=torch.float64), 10 * HALF, NOTHING, weigh)
    assert (new == 1).all()


def test_an_opacity_that_overshot_goes_half_of_the_way_back():
    """Of a weight that is the square of the opacity: a ratio of 4 leads from 0.25 to 1, a ratio of 1/4 from there to 0.5, which is right."""
    new = matched(torch.tensor([0.25]), torch.tensor([0.25]), NOTHING[:1], lambda opacities: opacities**2, (1, 1))
    assert new.item() == pytest.approx(0.5, rel=1e-2)


def test_unseen_splats_stay_as_they_are():
    opacities = torch.tensor([0.3, 0.0])
    assert torch.equal(matched(opacities, torch.zeros(2), NOTHING, torch.zeros_like), opacities)


def test_what_is_wanted_of_the_unseen_and_what_nobody_wants_stay_finite():
    wanted, found = torch.tensor([9.0, 0.0]), torch.tensor([0.0, 9.0])
    unseen, unwanted = matched(torch.tensor([1e-6, 0.5]), wanted, NOTHING, lambda tried: found).tolist()
    assert unseen == pytest.approx(1e-6 * MAX_FACTOR ** len(WHOLE)) and unwanted == pytest.approx(0.5 / MAX_FACTOR ** len(WHOLE))


def test_nothing_changes_where_weights_match():
    opacities = torch.tensor([0.7, 0.2], dtype=torch.float64)
    torch.testing.assert_close(matched(opacities, weigh(opacities), NOTHING, weigh), opacities, rtol=1e-9, atol=0)


def test_what_hardly_shows_of_a_splat_says_little_of_its_opacity():
    """Of 1,000 px one tenth shows, and a fifth is wanted: the sight of both changes the opacity by a tenth each time."""
    opacities, whole = torch.tensor([0.3]), torch.tensor([1000.0])
    new = matched(opacities, torch.tensor([0.2]), whole, lambda tried: torch.tensor([0.1]))
    assert new.item() == pytest.approx(0.3 * (1.2 / 1.1) ** len(WHOLE), rel=1e-3)


def test_opacities_change_after_each_part_of_the_views():
    """Of a splat that is twice too faint in all views, the first part says so, and the second finds it right."""
    tried = []

    def weights_of(opacities, part, parts):
        tried.append((part, parts, *opacities.tolist()))
        return opacities / parts

    new = matched_opacities(torch.tensor([0.2]), Wanted(torch.tensor([[0.2, 0.2]]), NOTHING[:1], NOTHING[:1]), weights_of, (2,))
    assert tried == [(0, 2, pytest.approx(0.2)), (1, 2, pytest.approx(0.4, rel=1e-2))] and new.item() == pytest.approx(0.4, rel=1e-2)


def test_a_part_that_shows_less_of_a_splat_than_the_others_moves_it_less():
    """It wants four times of what it sees, and has a tenth of what both parts want."""
    seen = torch.tensor([[0.025], [0.9]])
    wanted = Wanted(torch.tensor([[0.1, 0.9]]), NOTHING[:1], NOTHING[:1])
    new = matched_opacities(torch.tensor([0.1]), wanted, lambda _, part, parts: seen[part], (2,))
    assert new.item() == pytest.approx(0.1 * 4 ** (2 * 0.1), rel=1e-2)


@pytest.mark.parametrize(("area", "power"), [(WIDE / 2, 1.0), (WIDE, 1.0), (4 * WIDE, 1 / 4)])
def test_the_opacity_of_a_splat_that_no_filter_changes_hardly_changes(area, power):
    """It shows twice of what is wanted, as what lies before it has become thinner: to make it fainter would show what it hides."""
    wanted = Wanted(torch.tensor([[0.4]]), NOTHING[:1], torch.tensor([area]))
    new = matched_opacities(torch.tensor([0.8]), wanted, lambda *_: torch.tensor([0.8]), (1,))
    assert new.item() == pytest.approx(0.8 * 0.5**power, rel=1e-3)


def test_a_wall_behind_specks_that_become_thinner_stays_opaque():
    """Or what it hides would show to whoever looks past the specks. It fills the picture, and each pixel of the base has a speck of 0.1 px."""
    x, y = torch.meshgrid(torch.arange(-20.0, 21.0), torch.arange(-15.0, 16.0), indexing="xy")
    specks = torch.stack([x.flatten() * discs.PIXEL, y.flatten() * discs.PIXEL, torch.full((x.numel(),), discs.DEPTH)], 1)
    means = torch.cat([torch.tensor([[0.0, 0.0, 2 * discs.DEPTH]]), specks])
    scales, opacities = means.new_full((len(means), 3), 0.1 * discs.PIXEL), means.new_full((len(means),), 0.8)
    scales[0], opacities[0] = 800 * discs.PIXEL, 0.95
    quats, sh = means.new_tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(means), 1), torch.zeros(len(means), 1, 3)
    sh[0] = 1.5
    cameras = [discs.VIEW, replace(discs.VIEW, name="again")]
    model = VanillaModel.from_gaussians(Gaussians(means, quats, scales, opacities, sh), TrainedScale())
    base = wrap_model(model, cameras=cameras, backend="reference")
    wall, *thinned = base.adapt(1 / 4, recipe="instant", merge_to=1.0, extra_views=0).model.gaussians(discs.VIEW).opacities.tolist()
    assert wall == pytest.approx(0.95, abs=0.01) and fmean(thinned) < 0.2


@pytest.mark.parametrize(("views", "width", "parts"), [(24, 100, 4), (23, 100, 2), (12, 100, 2), (11, 100, 1), (24, 20, 1), (100, 20, 4)])
def test_parts_have_some_views_and_some_thousand_pixels(views, width, parts):
    camera = Camera(width, width, 10.0, 10.0, width / 2, width / 2, torch.eye(4))
    assert sweeps_over(views * [camera]) == SWEEPS[parts]
    assert parts == 1 or views * width**2 // parts >= PART_PIXELS


@pytest.mark.parametrize(("time", "count", "sweeps"), [(3.0, 40, (1, 1, 1)), (2.9, 40, (1, 1)), (1.4, 20, (1, 1)), (0.4, 1, ())])
def test_there_are_as_many_sweeps_as_splats_pixels_and_views_leave_time_for(time, count, sweeps):
    """Of the base 80 splats were weighed. At half of their size views take a quarter of the time at least, and 24 twice that of the first twelve."""
    problem = SimpleNamespace(base_effects=Effects(0), target=Effects(0, eps2d=0.2), has_blend_weights=True, scale=1 / 2)
    seen = SimpleNamespace(views=24 * [VIEW], size=1.0, of_base=Wanted(*torch.ones(3, 80)), notes=[])
    clock = SimpleNamespace(allows=lambda work, amount: work == "weights" and amount <= time)
    assert Matcher(problem, clock, seen).sweeps_for(torch.ones(count, 4)) == sweeps
    assert seen.notes == ([] if sweeps else [UNMATCHED])


def matched(opacities, wanted, whole, weigh, sweeps=WHOLE):
    """`matched_opacities` for views that are looked at all together."""
    return matched_opacities(opacities, Wanted(wanted[:, None], whole, torch.zeros_like(whole)), lambda tried, part, parts: weigh(tried), sweeps)


@pytest.mark.parametrize("settings", [{}, {"most_splats": 20}], ids=["all splats", "merged ones"])
@pytest.mark.parametrize("factors", [(1.0, 0.2), (0.2, 5.0)], ids=["keeps the first", "keeps the second"])
def test_without_steps_opacities_are_matched_once_more_and_kept_if_that_looks_better(monkeypatch, factors, settings):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference")
    right = opacities_by(monkeypatch, base, [1.0, 1.0], **settings)
    torch.testing.assert_close(opacities_by(monkeypatch, base, factors, **settings), right)


@pytest.mark.parametrize(("factor", "asked"), [(1.0, [WHOLE, WHOLE]), (1e-4, [WHOLE, (1,), WHOLE])], ids=["visible", "faint"])
def test_without_steps_opacities_that_come_out_too_faint_are_matched_in_fewer_sweeps(monkeypatch, factor, asked):
    """None of these is drawn, which looks worse than with one sweep; with none they are the closed form's, which is not matched."""
    base, swept = wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference"), []

    def matched(opacities, wanted, weights_of, sweeps):
        swept.append(sweeps)
        return opacities * (factor if sweeps == WHOLE else 1)

    monkeypatch.setattr(matching, "matched_opacities", matched)
    found = base.adapt(1 / 4, recipe="instant", merge_to=1.0).model.gaussians(tiny.cameras()[0]).opacities
    assert swept == asked and found.mean() > 1e-2


@pytest.mark.parametrize(("screen_filter", "count"), [("classic", 4), ("antialiased", 3)])
def test_a_filter_that_draws_alike_has_no_closed_form_without_matching(monkeypatch, screen_filter, count):
    tried, candidate = [], Candidates.make
    monkeypatch.setattr(Candidates, "make", lambda *given: tried.append(1) or candidate(*given))
    monkeypatch.setattr(matching, "matched_opacities", lambda opacities, *_: opacities * 1e-4)
    wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference", screen_filter=screen_filter).adapt(1 / 4, recipe="instant", merge_to=1.0)
    assert len(tried) == count


def test_before_steps_opacities_are_matched_once(monkeypatch):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference")
    with pytest.raises(StopIteration):
        opacities_by(monkeypatch, base, [1.0])
    opacities_by(monkeypatch, base, [1.0], steps=1)


def opacities_by(monkeypatch, base, factors, **settings):
    """Opacities [N] at x1/4, where each matching multiplies them by the next of these factors; StopIteration if there are too few."""
    left = iter(factors)
    monkeypatch.setattr(matching, "matched_opacities", lambda opacities, *_: opacities * next(left))
    return base.adapt(1 / 4, recipe="instant", merge_to=1.0, **settings).model.gaussians(tiny.cameras()[0]).opacities.detach()


@pytest.mark.filterwarnings("ignore:the time budget")
@pytest.mark.parametrize("viewer", [None, "antialiased"], ids=["as trained", "converted before"])
def test_a_budget_that_ends_before_opacities_are_matched_says_so(monkeypatch, viewer):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference")
    steps = {"steps": 2, "extra_views": 2, "viewer": viewer, "merge_to": 1.0}
    whole = base.adapt(4, **steps).report
    monkeypatch.setattr(Clock, "allows", lambda *_: False)
    short = base.adapt(4, **steps, time_budget_s=60.0).report
    assert UNMATCHED in short.notes and UNMATCHED not in whole.notes
    assert short.psnr_after() >= short.psnr_before()
