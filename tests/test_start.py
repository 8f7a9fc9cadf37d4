"""The start: the best of base, closed form and merged splats, as validation views have it."""

import weakref
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.validation import Quality, Validation
from mipmap_plugin.adaptation.parallel import VIEWS_AT_ONCE
from mipmap_plugin.adaptation.pixel_size import mean_pixel_size, pixel_size
from mipmap_plugin.adaptation.report import AS_IT_IS, UNCHANGED, Report
from mipmap_plugin.adaptation.start import base_weights, candidates, compilation
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.closed_form import closed_form
from mipmap_plugin.backends.base import Calls
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

SCALE, COUNT = 1 / 4, 80


def adapted(count=COUNT, scale=SCALE, **settings):
    model = wrap_model(tiny.model(count), cameras=tiny.cameras())
    return model.adapt(scale, **{"steps": 0, "merge_to": 1.0, "extra_views": 4, **settings})


def start_of(report) -> str:
    return next(name for name in report.validation if name.startswith("the start, ")).removeprefix("the start, ")


def test_what_a_start_was_searched_with_is_gone_during_the_steps(monkeypatch):
    """The pairs of all rounds of merging, for one."""
    found = list[weakref.ref[candidates.Rounds]]()

    class Kept(candidates.Rounds):
        def __init__(self):
            super().__init__()
            found.append(weakref.ref(self))

    monkeypatch.setattr(candidates, "Rounds", Kept)
    left = list[bool]()
    adapted(steps=2, merge_to=0.5, observe=lambda *_: left.append(any(rounds() for rounds in found)))
    assert found and left and not any(left)


def test_the_closed_form_is_where_a_run_starts():
    assert start_of(adapted().report) == "the closed form"


@pytest.mark.parametrize(("psnr", "told"), [(30.0, "holds the base as it is, for nothing was better: 30.00 dB"), (31.0, "30.00 -> 31.00 dB")])
def test_a_start_with_which_nothing_was_done_to_the_base_is_told_as_the_base(psnr, told):
    report = Report.model_construct(returned=UNCHANGED, validation={AS_IT_IS: 30.0, UNCHANGED: psnr})
    assert report.gain() == f"{told} on views that nothing was adapted to"


def test_a_start_with_which_nothing_was_done_to_the_base_has_its_name():
    [unchanged] = {UNCHANGED} & adapted(closed_form=False).report.validation.keys()
    assert unchanged == UNCHANGED


@pytest.mark.parametrize("steps", [0, 2])
def test_a_start_takes_no_memory_for_what_it_has_of_the_base_and_what_is_returned_has_its_own(monkeypatch, steps):
    seen, choose = {}, Validation.choose

    def start(self, states, allowed):
        seen.update(states)
        return "the start, the closed form", *choose(self, states)[1:]

    monkeypatch.setattr(Validation, "choose", start)
    base = wrap_model(tiny.model(COUNT), cameras=tiny.cameras())
    returned = base.adapt(SCALE, steps=steps, merge_to=1.0, extra_views=4).model

    def places(model):
        return {name: tensor.data_ptr() for name, tensor in model.parameters().items()}

    shared = places(base.model).items() & places(seen["the start, the closed form"]).items()
    assert {name for name, _ in shared} == {"means", "quats", "sh0", "shN"}
    assert not set(places(returned).values()) & set(places(base.model).values())
    assert torch.equal(returned.parameters()["shN"], base.model.parameters()["shN"])  # no step has changed it


def test_the_base_is_chosen_where_the_closed_form_is_worse(monkeypatch):
    monkeypatch.setattr(candidates, "closed_form", lambda gaussians, *_: (10 * gaussians.scales, gaussians.opacities))
    result = adapted(scale=4)
    assert start_of(result.report) == "the base"
    assert torch.equal(result.model.parameters()["scales"], tiny.model(COUNT).parameters()["scales"])


def test_crispness_reaches_the_start():
    plain, crisp = (adapted(scale=4, crispness=each, returns="last").model.parameters() for each in (0.0, 1.0))
    torch.testing.assert_close(crisp["scales"], tiny.model(COUNT).parameters()["scales"], atol=1e-5, rtol=0)
    assert (crisp["opacities"] >= plain["opacities"]).all() and (crisp["scales"] < plain["scales"]).any()


@pytest.mark.parametrize(
    ("scale", "tried"),
    [(1.05, [0.0, 0.5, 1.0]), (2, [0.0]), (1 / 2, [0.0])],
    ids=["a small zoom-in", "one that does not tell", "a zoom-out"],
)
def test_a_start_without_steps_is_as_crisp_as_views_show(scale, tried, monkeypatch):
    """At x1.05 thin wires were up to 0.5 dB worse than in the base."""
    seen = []

    def form(*arguments):
        seen.append(arguments[-1].crispness)
        return closed_form(*arguments)

    monkeypatch.setattr(candidates, "closed_form", form)
    monkeypatch.setattr(Validation, "quality", lambda *_: Quality(30.0 + len(seen), 30.0 + len(seen)))
    adapted(scale=scale, recipe="instant")
    assert seen == tried


@pytest.mark.parametrize(("scale", "size"), [(2, mean_pixel_size), (1 / 2, pixel_size)])
def test_a_zoom_in_is_formed_for_the_mean_of_the_views(scale, size, monkeypatch):
    forms = []
    monkeypatch.setattr(candidates, "closed_form", lambda *arguments: forms.append(arguments[-1]) or closed_form(*arguments))
    adapted(scale=scale, extra_views=0)
    assert torch.equal(forms[0].pixel, size(tiny.model(COUNT).parameters()["means"], tiny.cameras()))


def test_the_base_is_where_a_run_starts_without_a_closed_form():
    assert start_of(adapted(closed_form=False).report) == "the base"


@pytest.fixture
def a_decibel_a_splat(monkeypatch):
    """Every splat less costs 1 dB; the base is worse than anything."""
    tried = []

    def quality(self, model):
        tried.append(len(model))
        return Quality(*[-100.0 if len(tried) == 1 else float(len(model))] * 2)

    monkeypatch.setattr(Validation, "quality", quality)
    return tried


def test_merging_is_refused_where_it_costs_too_much(a_decibel_a_splat):
    report = adapted(merge_to=0.5, merging_costs=0.5).report
    assert (start_of(report), report.gaussians_after) == ("the closed form", COUNT)
    assert a_decibel_a_splat[:2] == [COUNT, COUNT]
    assert len(a_decibel_a_splat) == 3  # the mildest merging was tried, in vain, and no other


def test_merging_is_done_as_far_as_it_may_cost(a_decibel_a_splat):
    all_of_it = adapted(merge_to=0.5, merging_costs=COUNT / 2).report
    assert (start_of(all_of_it), len(a_decibel_a_splat)) == ("the closed form of merged splats", 4)
    assert a_decibel_a_splat[3] < a_decibel_a_splat[2] < COUNT
    a_decibel_a_splat.clear()
    less = adapted(merge_to=0.5, merging_costs=COUNT - all_of_it.gaussians_after - 1).report
    assert start_of(less) == "the closed form of merged splats"
    assert all_of_it.gaussians_after < less.gaussians_after < COUNT


def test_merged_splats_that_are_worse_than_the_base_are_not_begun_with(monkeypatch):
    monkeypatch.setattr(Validation, "quality", lambda self, model: Quality(float(len(model)), float(len(model))))
    report = adapted(merge_to=0.5, merging_costs=COUNT).report
    assert (start_of(report), report.gaussians_after) == ("the closed form", COUNT)


def test_what_is_merged_furthest_without_being_worse_than_the_base_is_begun_with(monkeypatch):
    """Also where the closed form of all splats is worse than both."""
    tried = []

    def quality(self, model):
        tried.append(len(model))
        # The base, the closed form, and merging mildly, strongly, and in between.
        return Quality(*[[30.0, 20.0, 35.0, 25.0, 32.0][len(tried) - 1]] * 2)

    monkeypatch.setattr(Validation, "quality", quality)
    report = adapted(merge_to=0.5, merging_costs=COUNT).report
    assert (start_of(report), report.gaussians_after) == ("the closed form of merged splats", tried[4])


@pytest.fixture
def told(monkeypatch):
    """The dB of base, closed form, and merging mildly, strongly and in between, as they are given; whatever is measured later is worth nothing."""
    tried, decibels = [], []

    def quality(self, model):
        tried.append(len(model))
        return Quality(*[decibels[len(tried) - 1] if len(tried) <= len(decibels) else 0.0] * 2)

    monkeypatch.setattr(Validation, "quality", quality)
    return decibels


def test_a_stronger_merging_is_tried_where_the_mildest_gains_but_the_base_looks_better_still(told):
    told[:] = [30.0, 20.0, 25.0, 35.0]
    assert start_of(adapted(merge_to=0.5).report) == "the closed form of merged splats"


@pytest.mark.parametrize(("viewer", "costs", "start"), [
    (None, 0.3, "the closed form"), ("spark", 0.3, "the closed form of merged splats"),
    ("spark", 0.1, "the closed form of merged splats"), ("spark", 0.0, "the closed form"),
])  # fmt: skip
def test_the_mildest_merging_may_cost_more_before_steps_for_another_renderer(told, viewer, costs, start):
    told[:] = [20.0, 30.0, 29.5, 28.0, 28.0]
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


@pytest.mark.parametrize(("viewer", "most"), [(None, 0.015), ("antialiased", 0.035)])
def test_a_zoom_in_starts_with_the_blend_weights_of_the_base(viewer, most):
    """Of splats that hide each other opacities are raised by less than the area that a smaller filter takes from each: that is off twice as far."""
    views = tiny.cameras(8, width=64, height=48)
    base = wrap_model(tiny.model(5 * COUNT, spread=0.2), cameras=views)
    adapted = base.adapt(2, viewer=viewer, steps=0, views="given", returns="last", conversion_steps=0)

    def weights(model, shown, scale):
        return blend_weights(model.gaussians(views[0]).detach(), [view.zoomed(scale) for view in views], adapted.backend, shown) / scale**2

    wanted, found = weights(base.model, base.effects(), 1), weights(adapted.model, adapted.effects, 2)
    assert (found - wanted).abs().sum() < most * wanted.sum()


def test_few_hidden_splats_are_not_worth_a_word(recwarn):
    report = wrap_model(beside(COUNT, COUNT // 4), cameras=tiny.cameras()).adapt(SCALE, steps=0, merge_to=0.5, views="given").report
    assert not report.notes and not recwarn


def test_merging_without_a_closed_form_is_called_so(monkeypatch):
    monkeypatch.setattr(Validation, "quality", lambda self, model: Quality(float(-len(model)), float(-len(model))))
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
def no_time_to_search(monkeypatch):
    """The counts of splats whose closed form is computed, where a time budget is too short for a search; the base is worse than anything."""
    formed = []

    def form(gaussians, *rest):
        formed.append(len(gaussians))
        return closed_form(gaussians, *rest)

    monkeypatch.setattr(candidates, "closed_form", form)
    monkeypatch.setattr(candidates, "SEARCH_PART", -1.0)
    monkeypatch.setattr(Validation, "quality", lambda self, model: Quality(*[-float(len(model))] * 2))
    return formed


IN_TIME = {"time_budget_s": 1000.0, "steps": 2, "merge_to": 0.25}


def test_a_budget_too_short_for_a_search_begins_with_what_is_merged_furthest(no_time_to_search, monkeypatch):
    monkeypatch.setattr(candidates, "REACHED", 3.5)
    report = adapted(**IN_TIME).report
    assert start_of(report) == "the closed form of merged splats"
    assert no_time_to_search == [report.gaussians_after] and report.gaussians_after < COUNT


@pytest.mark.parametrize(
    ("reached", "settings"),
    [(1.0, {}), (3.5, {"merge_to": 0.3}), (3.5, {"steps": 0}), (3.5, {"time_budget_s": None})],
    ids=["splats that can hardly be merged", "few fewer splats", "no steps", "no budget"],
)
def test_otherwise_the_base_is_formed_first(no_time_to_search, monkeypatch, reached, settings):
    monkeypatch.setattr(candidates, "REACHED", reached)
    adapted(**IN_TIME | settings)
    assert no_time_to_search[0] == COUNT


def test_merged_splats_that_are_worse_than_the_base_are_not_begun_with_in_a_short_budget_either(no_time_to_search, monkeypatch):
    monkeypatch.setattr(candidates, "REACHED", 3.5)
    monkeypatch.setattr(Validation, "quality", lambda self, model: Quality(*[float(len(model))] * 2))
    assert start_of(adapted(**IN_TIME).report) == "the closed form"


def test_phases_are_named():
    seconds = adapted(merge_to=0.5).report.seconds
    phases = ["compilation", "blend weights", "closed form", "merging", "validation"]
    assert all(seconds[phase] > 0 for phase in phases)
    assert seconds["total"] == pytest.approx(sum(seconds[phase] for phase in phases), rel=0.2)
    assert "merging" not in adapted().report.seconds
    assert "closed form" not in adapted(closed_form=False).report.seconds


def test_steps_with_the_usual_settings_and_with_others_are_compiled_first(monkeypatch):
    """A backend may have kernels of their own for viewers."""
    stepped, backend = [], ReferenceBackend()
    backend.stepper = None
    monkeypatch.setattr(compilation, "_step", lambda _backend, _splats, effects: stepped.append(effects))
    effects = [Effects(1), Effects(1, "mip"), find_viewer("unity").effects(Effects(1)), find_viewer("spark").effects(Effects(1))]
    compilation.warm_up(backend, tiny.gaussians(3), effects, Calls(gradients=True, merging=False, by_rows=True))
    assert len(stepped) == 2 and effects[0] in stepped and effects[2] in stepped
    compilation.warm_up(backend, tiny.gaussians(3), [find_viewer("metalsplatter").effects(Effects(1))], Calls(True, merging=False, by_rows=True))
    assert len(stepped) == 2  # in linear light the backend takes none


@pytest.mark.parametrize(("views", "by_rows"), [(VIEWS_AT_ONCE, True), (VIEWS_AT_ONCE + 1, False)])
def test_steps_of_more_views_than_are_drawn_at_once_take_autograds_way(views, by_rows, monkeypatch):
    asked = []
    monkeypatch.setattr("mipmap_plugin.adaptation.session.warm_up", lambda *args: asked.append(args[-1].by_rows))
    adapted(views_per_step=views, steps=1)
    assert asked == [by_rows]


def test_a_start_is_computed_from_as_many_views_as_show_enough(monkeypatch):
    """By what they show: splats behind others do not count."""
    counts, real = [], base_weights.weighed

    def weighed(gaussians, views, *rest):
        counts.append(len(views))
        return real(gaussians, views, *rest)[0], 0.2 if len(counts) == 1 else 1.0

    monkeypatch.setattr(base_weights, "weighed", weighed)
    wrap_model(tiny.model(COUNT), cameras=tiny.cameras(60)).adapt(SCALE, recipe="instant", extra_views=0)
    assert counts == [12, 36]  # the further ones of 48
