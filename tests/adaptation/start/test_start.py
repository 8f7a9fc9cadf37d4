"""The start: the best of base, closed form and merged splats, as validation views have it."""

import weakref

import pytest
import tiny
import torch
from small_starts import COUNT, SCALE, adapted, start_of

from mipmap_plugin.adaptation.optimization.validation import Quality, Validation
from mipmap_plugin.adaptation.parallel import VIEWS_AT_ONCE
from mipmap_plugin.adaptation.report import AS_IT_IS, UNCHANGED, Report
from mipmap_plugin.adaptation.start import base_weights, candidates, compilation
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.closed_form import closed_form
from mipmap_plugin.adaptation.views.pixel_size import mean_pixel_size, pixel_size
from mipmap_plugin.backends.base import Calls
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


def test_what_a_start_was_searched_with_is_gone_during_the_steps(monkeypatch):
    """The pairs of all rounds of merging, for one."""
    found = list[weakref.ref[candidates.MergingRounds]]()

    class Kept(candidates.MergingRounds):
        def __init__(self):
            super().__init__()
            found.append(weakref.ref(self))

    monkeypatch.setattr(candidates, "MergingRounds", Kept)
    left = list[bool]()
    adapted(steps=2, merge_to=0.5, observe=lambda *_: left.append(any(rounds() for rounds in found)))
    assert found and left and not any(left)


@pytest.mark.parametrize(("psnr", "told"), [(30.0, "holds the base as it is, for nothing was better: 30.00 dB"), (31.0, "30.00 -> 31.00 dB")])
def test_a_start_with_which_nothing_was_done_to_the_base_is_told_as_the_base(psnr, told):
    report = Report.model_construct(returned=UNCHANGED, validation={AS_IT_IS: 30.0, UNCHANGED: psnr})
    assert report.gain() == f"{told} on views that nothing was adapted to"


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
    assert (crisp["scales"] <= plain["scales"]).all() and (crisp["opacities"] > plain["opacities"]).any()


@pytest.mark.parametrize(
    ("scale", "tried"), [(1.05, [0.5, 1.0]), (2, [0.5]), (1 / 2, [0.0])], ids=["a small zoom-in", "one that does not tell", "a zoom-out"]
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
    assert UNCHANGED in adapted(closed_form=False).report.validation


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


@pytest.mark.parametrize(("scale", "size"), [(1 / 2, 1.0), (1 / 4, 0.5), (1 / 8, 0.5)])
def test_far_out_the_base_is_weighed_in_pictures_of_half_its_size(scale, size, monkeypatch):
    sizes, real = [], base_weights.weighed
    monkeypatch.setattr(base_weights, "weighed", lambda *given: sizes.append(given[-1]) or real(*given))
    wrap_model(tiny.model(COUNT), cameras=tiny.cameras(6)).adapt(scale, recipe="instant")
    assert set(sizes) == {size}


def test_a_start_is_computed_from_as_many_views_as_show_enough(monkeypatch):
    """By what they show: splats behind others do not count."""
    counts, real = [], base_weights.weighed

    def weighed(gaussians, views, *rest):
        counts.append(len(views))
        return real(gaussians, views, *rest)[0], 0.2 if len(counts) == 1 else 1.0

    monkeypatch.setattr(base_weights, "weighed", weighed)
    wrap_model(tiny.model(COUNT), cameras=tiny.cameras(60)).adapt(SCALE, recipe="instant", extra_views=0)
    assert counts == [12, 36]  # the further ones of 48
