"""A start of merged splats: how far splats are merged, as validation views have it, and within a time budget."""

from dataclasses import replace

import pytest
import tiny
import torch
from small_starts import COUNT, SCALE, adapted, start_of

from mipmap_plugin.adaptation.optimization.validation import Quality, Validation
from mipmap_plugin.adaptation.start import candidates, search
from mipmap_plugin.adaptation.start.closed_form import closed_form
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


@pytest.fixture
def worth(monkeypatch):
    """Call it with what a state is worth, in dB, by its place among those that are measured and by its splats; it returns the counts of splats."""

    def give(psnr):
        tried = []

        def quality(self, model):
            tried.append(len(model))
            return Quality(*[float(psnr(len(tried) - 1, len(model)))] * 2)

        monkeypatch.setattr(Validation, "quality", quality)
        monkeypatch.setattr(search.StartSearch, "_matched_as_shown", lambda self, formed, quality: (formed, quality))
        return tried

    return give


def a_decibel_a_splat(place, splats):
    """Every splat less costs 1 dB; the base is worse than anything."""
    return splats if place else -100.0


def test_merging_is_refused_where_it_costs_too_much(worth):
    tried = worth(a_decibel_a_splat)
    report = adapted(merge_to=0.5, merging_costs=0.5).report
    assert (start_of(report), report.gaussians_after) == ("the closed form", COUNT)
    assert tried[:2] == [COUNT, COUNT] and len(tried) == 3  # the mildest merging was tried, in vain, and no other


def test_merging_is_done_as_far_as_it_may_cost(worth):
    tried = worth(a_decibel_a_splat)
    all_of_it = adapted(merge_to=0.5, merging_costs=COUNT / 2).report
    assert (start_of(all_of_it), len(tried)) == ("the closed form of merged splats", 4)
    assert tried[3] < tried[2] < COUNT
    tried.clear()
    less = adapted(merge_to=0.5, merging_costs=COUNT - all_of_it.gaussians_after - 1).report
    assert start_of(less) == "the closed form of merged splats"
    assert all_of_it.gaussians_after < less.gaussians_after < COUNT


def test_merged_splats_that_are_worse_than_the_base_are_not_begun_with(worth):
    worth(lambda _, splats: splats)
    report = adapted(merge_to=0.5, merging_costs=COUNT).report
    assert (start_of(report), report.gaussians_after) == ("the closed form", COUNT)


def test_what_is_merged_furthest_without_being_worse_than_the_base_is_begun_with(worth):
    """Also where the closed form of all splats is worse than both."""
    dbs = dict(enumerate([30.0, 20.0, 35.0, 25.0, 32.0]))  # base, closed form, merging mildly, strongly, in between
    tried = worth(lambda place, _: dbs.get(place, 0.0))  # and beyond the limits
    report = adapted(merge_to=0.5, merging_costs=COUNT).report
    assert (start_of(report), report.gaussians_after) == ("the closed form of merged splats", tried[4])


def test_a_stronger_merging_is_tried_where_the_mildest_gains_but_the_base_looks_better_still(worth):
    worth(lambda place, _: dict(enumerate([30.0, 20.0, 25.0, 35.0])).get(place, 0.0))
    assert start_of(adapted(merge_to=0.5).report) == "the closed form of merged splats"


@pytest.mark.parametrize(("viewer", "costs", "start"), [
    (None, 0.3, "the closed form"), ("spark", 0.3, "the closed form of merged splats"),
    ("spark", 0.1, "the closed form of merged splats"), ("spark", 0.0, "the closed form"),
])  # fmt: skip
def test_the_mildest_merging_may_cost_more_before_steps_for_another_renderer(worth, viewer, costs, start):
    worth(lambda place, _: dict(enumerate([20.0, 30.0, 29.5, 28.0, 28.0])).get(place, 0.0))
    assert start_of(adapted(merge_to=0.5, merging_costs=costs, steps=1, viewer=viewer).report) == start


def beside(seen: int, hidden: int) -> VanillaModel:
    """A ball of splats that the cameras look at, and others in pairs far behind all of them."""
    shown, others = tiny.gaussians(seen), tiny.gaussians(hidden, seed=1)
    far = replace(others, means=others.means.repeat_interleave(2, 0)[:hidden] + 1000.0)
    return VanillaModel.from_gaussians(shown.joined(far), TrainedScale())


def test_splats_that_no_view_shows_are_not_merged_and_the_report_tells_of_them():
    base = beside(COUNT, COUNT)
    with pytest.warns(UserWarning, match="no view shows 5[0-9]% of the splats"):
        result = wrap_model(base, cameras=tiny.cameras()).adapt(SCALE, steps=0, merge_to=0.1, merging_costs=99, returns="last", views="given")
    assert COUNT < len(result.model) < 2 * COUNT
    assert torch.equal(result.model.parameters()["means"][-COUNT:], base.parameters()["means"][-COUNT:])
    assert len(result.report.notes) == 1


def test_few_hidden_splats_are_not_worth_a_word(recwarn):
    report = wrap_model(beside(COUNT, COUNT // 4), cameras=tiny.cameras()).adapt(SCALE, steps=0, merge_to=0.5, views="given").report
    assert not report.notes and not recwarn


def test_merging_without_a_closed_form_is_called_so(worth):
    worth(lambda _, splats: -splats)
    assert start_of(adapted(merge_to=0.5, closed_form=False).report) == "merged splats"


def test_a_start_that_takes_the_whole_time_budget_merges_nothing_and_the_report_says_so():
    settings = {"steps": 5, "merge_to": 0.5, "merging_costs": 99, "views": "given"}
    report = adapted(time_budget_s=1e-6, **settings).report
    assert report.ended_by == "time budget of 1e-06 s, all of which the start took"
    assert report.gaussians_after == COUNT and "merging" not in report.seconds
    assert not report.returned.startswith("the last state")  # there is none
    whole = adapted(time_budget_s=1000.0, **settings).report
    assert whole.seconds["merging"] > 0 and whole.ended_by == "5 steps"


@pytest.fixture
def no_time_to_search(monkeypatch, worth):
    """The counts of splats whose closed form is computed, where a time budget is too short for a search; the base is worse than anything."""
    formed = []

    def form(gaussians, *rest):
        formed.append(len(gaussians))
        return closed_form(gaussians, *rest)

    monkeypatch.setattr(candidates, "closed_form", form)
    monkeypatch.setattr(search, "SEARCH_PART", -1.0)
    worth(lambda _, splats: -splats)
    return formed


IN_TIME = {"time_budget_s": 1000.0, "steps": 2, "merge_to": 0.25}


def test_a_budget_too_short_for_a_search_begins_with_what_is_merged_furthest(no_time_to_search, monkeypatch):
    monkeypatch.setattr(search, "REACHED", 3.5)
    report = adapted(**IN_TIME).report
    assert start_of(report) == "the closed form of merged splats"
    assert no_time_to_search == [report.gaussians_after] and report.gaussians_after < COUNT


@pytest.mark.parametrize(
    ("reached", "settings"),
    [(1.0, {}), (3.5, {"merge_to": 0.3}), (3.5, {"steps": 0}), (3.5, {"time_budget_s": None})],
    ids=["splats that can hardly be merged", "few fewer splats", "no steps", "no budget"],
)
def test_otherwise_the_base_is_formed_first(no_time_to_search, monkeypatch, reached, settings):
    monkeypatch.setattr(search, "REACHED", reached)
    adapted(**IN_TIME | settings)
    assert no_time_to_search[0] == COUNT


def test_merged_splats_that_are_worse_than_the_base_are_not_begun_with_in_a_short_budget_either(no_time_to_search, worth, monkeypatch):
    monkeypatch.setattr(search, "REACHED", 3.5)
    worth(lambda _, splats: splats)
    assert start_of(adapted(**IN_TIME).report) == "the closed form"
