"""A level starts from a finer one, with so many splats."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from brief_levels import BRIEF, wrapped

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.start import search
from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.candidates import Candidates
from mipmap_plugin.adaptation.start.clock import start_clock
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.base import Traits

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")


# Starts from a finer level


def test_a_run_starts_from_a_finer_level_and_keeps_a_fraction_of_the_base():
    base = wrapped(40)
    finer = base.adapt(1 / 2, viewer="antialiased", steps=0, most_splats=30, validation_views=2).model
    adapted = base.adapt(1 / 4, viewer="antialiased", start=FinerLevel(finer, 1 / 2), steps=0, merge_to=0.25, merging_costs=99, validation_views=2)
    assert len(finer) <= 30 and adapted.report.gaussians_before == 40
    assert any("merged" in name or "finer level" in name for name in adapted.report.validation)
    assert 10 <= adapted.report.gaussians_after <= 30


def test_splats_that_share_no_pixel_are_merged_where_enough_is_left_to_see(monkeypatch):
    def count(least_db):
        monkeypatch.setattr(search, "LEAST_DB", least_db)
        monkeypatch.setattr(search.StartSearch, "_least_psnr", lambda *_: -math.inf)
        settings = dict(steps=0, merge_to=0.05, merging_costs=99, validation_views=2, returns="last")
        return len(base.adapt(0.9, viewer="antialiased", start=FinerLevel(base.model, 1.0), **settings).model)

    base = wrapped(40)
    assert count(-math.inf) == 2 < count(math.inf)


@pytest.mark.parametrize(
    ("coarse_db", "base_db", "steps", "start"),
    [
        (30.0, 32.0, 1, ("merged", 0.1, True)),
        (30.0, 34.0, 1, ("merged", 0.1, False)),
        (26.0, 20.0, 1, ("merged", 0.1, False)),
        (20.0, 20.0, 1, ("merged", 0.1, False)),
        (30.0, 32.0, 0, ("merged", 0.1, False)),
        (30.0, 33.0, 0, ("finer",)),
    ],
)
def test_what_is_merged_too_coarsely_leaves_the_choice_to_plain_merging(monkeypatch, coarse_db, base_db, steps, start):
    """The finer level has 38 dB and may lose 9, as the closed form may; the base itself may lose 3. Without a step, merging leaves half of what the
    closed form, of 34 dB, gains on the base."""

    def quality(model):
        return Quality(*[{"finer": 38.0, "base": base_db, "formed": 34.0}.get(model[0], coarse_db if model[-1] else 33.0)] * 2)

    def candidate(_, fraction=1.0, coarsely=False):
        return Base(("formed",) if fraction == 1 else ("merged", fraction, coarsely))

    class Base(tuple):
        traits = Traits()

        def parameters(self):
            return {"means": torch.zeros(100, 3)}

    config = SimpleNamespace(
        most_splats=None, closed_form=True, crispness=0.0, merge_to=0.1, merging_costs=9.0, returns="best", time_budget_s=None, steps=steps
    )
    problem = SimpleNamespace(
        base=lambda: Base(["finer"]), coarse_base=lambda: Base(["base"]), config=config, quality=quality, may_lose=9.0, name="the finer level",
        views=[], scale=0.5, phase=lambda _: nullcontext(), base_effects=Effects(0), target=Effects(0), has_blend_weights=False,
    )  # fmt: skip
    monkeypatch.setattr(BaseWeights, "measured", lambda *_: None)
    monkeypatch.setattr(Candidates, "make", candidate)
    assert search.StartSearch(problem, start_clock(problem)).best()[0] == start


def test_a_start_has_to_be_finer():
    base = wrapped()
    with pytest.raises(SettingsError, match=r"start: x0.25 is not finer than x0.5; leave it out"):
        base.adapt(1 / 2, viewer="antialiased", start=FinerLevel(base.model, 1 / 4), **BRIEF)


# Counts


@pytest.mark.parametrize("most", [1, 7, 30])
def test_at_most_so_many_splats_are_left_whatever_it_costs(most):
    adapted = wrapped(40).adapt(1 / 2, viewer="antialiased", most_splats=most, steps=2, extra_views=1, validation_views=2)
    assert len(adapted.model) <= most
    assert "the base as it is" in adapted.report.validation and not adapted.report.returned.startswith("the base as it is")


def test_a_count_above_the_bases_merges_nothing_and_says_so():
    options = dict(viewer="antialiased", steps=0, validation_views=2)
    one, other = (wrapped().adapt(1 / 2, **options, **more) for more in ({"merge_to": 1.0}, {"merge_to": 0.5, "most_splats": 12}))
    assert one.report.validation == other.report.validation and "merging" not in other.report.seconds
    assert all(torch.equal(tensor, other.model.parameters()[name]) for name, tensor in one.model.parameters().items())
