"""One file for several viewers at once: each takes its turn, the worst of them judges, and none of them hides behind another."""

import json
import math
import re
from dataclasses import replace
from statistics import fmean
from types import SimpleNamespace

import pytest
import tiny
import torch

from mipmap_plugin import cli, register_viewer, wrap_model
from mipmap_plugin.adaptation.optimization.run import Task
from mipmap_plugin.adaptation.optimization.validation import VISIBLE_ERROR, Choice, Validation
from mipmap_plugin.adaptation.portable import MERGE_FACTOR, MERGING_COSTS, extreme_targets, median_target
from mipmap_plugin.adaptation.start.search import StartSearch
from mipmap_plugin.adaptation.worse import worse_viewers
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable, PluginError, SettingsError
from mipmap_plugin.evaluation.evaluate import Evaluator, adapted_row, training_free_rows
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models.base import TrainedScale, Traits
from mipmap_plugin.splatting.viewers import BUILT_IN, FURTHER, SUPERSPLAT_VIEWER, find_viewer, viewers_for

BRIEF = dict(steps=2, extra_views=1, merge_to=1.0, warm_up=0, views_per_step=3, validation_views=2)
PAIR = ("classic", "spark")


@pytest.fixture
def pair():
    """The name of two viewers that disagree."""
    register_viewer("pair", PAIR)
    return "pair"


def wrapped(backend="auto", **trained):
    return wrap_model(tiny.model(40, TrainedScale(**trained)), cameras=tiny.cameras(), backend=backend)


def colored(*shades):
    """Renderers of one color each."""
    return [lambda _, camera, shade=shade: torch.full((*camera.size, 3), shade) for shade in shades]


# What a file is for


def test_portable_is_every_built_in_viewer_but_the_further_ones_with_the_usual_one_first():
    assert viewers_for("portable") == tuple(viewer.name for viewer in BUILT_IN if viewer not in (SUPERSPLAT_VIEWER, *FURTHER))
    assert viewers_for("portable")[0] == "classic" and viewers_for("spark") == ("spark",)


def test_the_command_does_not_draw_as_several(tmp_path, capsys):
    words = ["render", tiny.folder(tmp_path / "base"), "--output", tmp_path / "out", "--viewer", "portable"]
    assert cli.main([str(word) for word in words]) == 2
    assert re.search("portable is a group of viewers, .*; name one of them: classic, antialiased, mip", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_group_is_made_of_names():
    for wrong in ((), (find_viewer("spark"),), ("spark", "nobody")):
        register_viewer("wrong", wrong, replace=True)
        with pytest.raises(PluginError, match="viewer group 'wrong' must contain names of registered viewers"):
            viewers_for("wrong")


def test_a_model_is_drawn_by_the_viewers_that_it_is_for():
    adapted = wrapped().adapt(1 / 4, viewer="spark", recipe="instant")
    with pytest.raises(SettingsError, match="not made for the viewer 'mip', but for spark"):
        adapted.render(tiny.cameras(1)[0], viewer="mip")


def test_the_extremes_speak_for_all():
    every = {name: find_viewer(name).effects(Effects(3)) for name in viewers_for("portable")}
    assert list(extreme_targets(every)) == ["classic", "spark", "playcanvas-webgpu", "gaussian-splats-3d", "antimatter15"]
    assert median_target(every) is every["playcanvas"]


@pytest.mark.parametrize("name", ["classic", "spark", "mip"])
def test_one_viewer_speaks_for_itself(name):
    alone = {name: find_viewer(name).effects(Effects(3))}
    assert extreme_targets(alone) == alone and median_target(alone) is alone[name]


def test_settings_for_several_give_way_to_those_that_are_asked_for():
    def settings(viewer, **asked):
        return wrapped().adapt(1 / 4, viewer=viewer, steps=1, extra_views=1, **asked).report.settings

    alone, several, asked = settings("spark"), settings("portable"), settings("portable", merge_to=0.5, loss="l1", merging_costs=0.2)
    assert several.merge_to == pytest.approx(alone.merge_to * MERGE_FACTOR) and (alone.loss, several.loss) == ("psnr", "l2")
    assert (alone.merging_costs, several.merging_costs) == (0.3, MERGING_COSTS)
    assert (asked.merge_to, asked.loss, asked.merging_costs) == (0.5, "l1", 0.2)


@pytest.mark.parametrize(("viewer", "steps", "may_lose"), [("spark", 1, 0.0), ("portable", 1, MERGING_COSTS), ("portable", 0, 0.0)])
def test_merged_splats_may_be_worse_than_the_base_where_steps_regain_it_in_several_viewers(monkeypatch, viewer, steps, may_lose):
    problems = []

    def watched(self, problem, clock):
        problems.append(problem)
        begin(self, problem, clock)

    begin = StartSearch.__init__
    monkeypatch.setattr(StartSearch, "__init__", watched)
    wrapped().adapt(1 / 4, viewer=viewer, steps=steps, extra_views=1)
    assert [problem.may_lose for problem in problems] == [may_lose]
    assert problems[0].config.merging_costs == (may_lose or 0.3)  # without steps nothing is regained


# Turns, and the judgement


def test_viewers_take_turns():
    first, *_ = renders = colored(0.0, 0.5, 1.0)
    task = Task([], 1.0, first, renders, False, Validation([], [], 1.0, first, renders, "area"))
    assert [float(image.mean()) for image in task.images(None, tiny.cameras(5), draw=1)] == [0.5, 1.0, 0.0, 0.5, 1.0]


def test_each_viewer_draws_for_the_gradient(monkeypatch, pair):
    drawn, render = [], ReferenceBackend.render

    def watched(self, gaussians, camera, effects):
        if torch.is_grad_enabled() and gaussians.means.requires_grad and camera.width > 1:
            drawn.append((effects.screen_filter, effects.eps2d))
        return render(self, gaussians, camera, effects)

    model = wrapped("reference")
    monkeypatch.setattr(ReferenceBackend, "render", watched)
    model.adapt(1 / 4, viewer=pair, **BRIEF)
    first, second = ((find_viewer(name).screen_filter, find_viewer(name).eps2d) for name in PAIR)
    assert drawn == [first, second, first, second, first, second]


def test_the_mean_square_over_viewers_steers_and_the_worst_chooses():
    cameras, shows = tiny.cameras(2), colored(0.4, 0.1, 0.49)
    judge = Validation(cameras, cameras, 1.0, lambda view: torch.full((*view.size, 3), 0.5), shows, "area")
    model = SimpleNamespace(gaussians=lambda camera: None, parameters=lambda: {"means": torch.zeros(1, 3)}, traits=Traits())
    assert judge.viewer_psnrs(model, cameras) == pytest.approx([20.0, 7.9588, 40.0], abs=1e-3)
    assert judge.steer(model) == pytest.approx(-10 * math.log10((0.1**2 + 0.4**2 + 0.01**2) / 3 + VISIBLE_ERROR), abs=1e-3)
    assert judge.choose({"it": model})[1] == pytest.approx({"it": 7.9588}, abs=1e-3)


def test_a_backend_has_to_have_what_each_viewer_asks_for():
    usual = Needs("cpu", torch.float32, gradients=True, sh_degree=0, screen_filter="classic")
    soft = replace(usual, screen_filter="soft")
    assert choose_backend("reference", usual, usual)[0].name == "reference"
    for several in ((usual, soft), (soft, usual)):
        with pytest.raises(BackendUnavailable, match="not soft"):
            choose_backend("reference", *several)


# A model and its file


def test_a_file_for_two_viewers_is_better_in_its_worst_than_one_for_either(pair):
    def worst(viewer):
        adapted = wrapped().adapt(1 / 2, viewer=viewer, steps=120, extra_views=8, merge_to=1.0, views_per_step=2, warm_up=0, validation_views=4)
        files, found = wrap_model(adapted.model), []
        for view in tiny.cameras(2, seed=9):  # that nothing was adapted to
            truth = wrapped().render(view.zoomed(1 / 2), 1 / 2, "scaled", supersampling=2).image
            found.append([psnr(files.render(view.zoomed(1 / 2), viewer=name).image, truth) for name in PAIR])
        return min(map(fmean, zip(*found, strict=True)))

    assert worst(pair) > max(worst(name) for name in PAIR) + 1


def test_the_report_has_each_viewer_and_the_file_says_what_it_is(tmp_path):
    adapted = wrapped().adapt(1 / 4, viewer="portable", **BRIEF)
    assert tuple(adapted.report.viewers) == tuple(adapted.viewers) == viewers_for("portable")
    returned = next(name for name in adapted.report.validation if adapted.report.returned.startswith(name))
    worst = min(adapted.report.viewers[name] for name in extreme_targets(adapted.viewers))
    assert worst == pytest.approx(adapted.report.validation[returned], abs=1e-6)
    assert {effect.name: effect.on for effect in adapted.report.effects}["contribution cull"]  # of one of them
    assert adapted.effects == Effects(1)  # classic
    comments = read_ply(adapted.save(tmp_path / "new.ply")).comments
    assert provenance_of(comments)["viewer"] == "portable" and "SplatRenderMode: default" in comments


def test_viewers_that_a_file_for_several_suits_less_than_the_base_are_told_of():
    """Of four two: another loses too little to count, and the first gains."""
    told = worse_viewers(("classic", "spark", "three", "mip"), [20.0, 36.5, 38.0, 41.0], [30.0, 35.5, 37.95, 38.0])
    assert told == [
        "of the 4 viewers that it was chosen by, spark and mip show the file worse than the base, by up to 3.0 dB as far as differences can be seen "
        "(41.0 -> 38.0): for such a viewer make a file of its own (--viewer mip)"
    ]
    assert not worse_viewers(("spark",), [36.0], [30.0]) and not worse_viewers(PAIR, [20.0, 36.0], [30.0, 36.0])


def test_the_report_tells_of_such_viewers(monkeypatch, pair):
    """In the first the file gains 10 dB, in the second it loses 4."""

    def choose(self, states, allowed):
        *_, last = states
        dbs = {name: (30.0, 32.0) if name == last else (20.0, 36.0) for name in states}
        return Choice(last, dict.fromkeys(states, 20.0), {name: [20.0 for _ in self.choosing] for name in states}, dbs)

    monkeypatch.setattr(Validation, "choose", choose)
    with pytest.warns(UserWarning, match=r"spark shows the file worse than the base, by up to 4.0 dB") as told:
        report = wrapped().adapt(1 / 4, viewer=pair, **BRIEF).report
    assert any(str(each.message) in report.notes for each in told)


def test_a_file_for_one_viewer_has_no_table_of_viewers():
    adapted = wrapped().adapt(1 / 4, viewer="spark", recipe="instant")
    assert adapted.report.viewers == {} and tuple(adapted.viewers) == ("spark",)


def test_an_adapted_model_is_drawn_by_each_of_its_viewers(pair):
    adapted, camera = wrapped().adapt(1 / 4, viewer=pair, recipe="instant"), tiny.cameras(1)[0].zoomed(1 / 4)
    first, second = (adapted.render(camera, viewer=name).image for name in PAIR)
    assert torch.equal(first, adapted.render(camera).image) and not torch.allclose(first, second)


def test_the_command_writes_a_portable_file_beside_another(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(3))
    words = ["adapt", base, "--scale", "1/4", "--viewer", "spark", "--viewer", "portable", "--recipe", "instant"]
    assert cli.main([str(word) for word in (*words, "--log", tmp_path / "log")]) == 0
    what, where = capsys.readouterr().out.splitlines()[2:]
    assert what.startswith("x0.25 in portable: ") and where.startswith(str(tmp_path / "base_x0.25_portable")) and where.endswith("made for portable")
    [line] = [line for line in (tmp_path / "log").read_text().splitlines() if "  in each viewer: classic " in line]
    assert all(f"{name} " in line for name in viewers_for("portable"))
    assert json.loads(next((tmp_path / "base_x0.25_portable").rglob("*.adaptation.json")).read_text())["viewer"] == "portable"


def test_what_is_evaluated_is_the_viewer_that_shows_it_worst(pair):
    model, camera = wrapped(), tiny.cameras(1, seed=9)[0]
    view = SimpleNamespace(camera=camera, truth=lambda scale, protocol: model.render(camera.zoomed(scale), viewer="classic").image)
    judge = Evaluator([view], PROTOCOLS["P3"])
    *_, row = training_free_rows(model, judge, 1 / 4, viewer=pair)
    assert row.name == "base in spark, worst of 2"
    adapted = model.adapt(1 / 4, viewer=pair, recipe="instant")
    assert adapted_row("instant", adapted, judge).name in {f"instant in {name}, worst of 2" for name in PAIR}
    assert adapted_row("instant", model.adapt(1 / 4, viewer="spark", recipe="instant"), judge).name == "instant"
