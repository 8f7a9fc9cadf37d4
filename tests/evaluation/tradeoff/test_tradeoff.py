"""A tradeoff: honest views, honest clocks, everything on the same axes, and nothing lost."""

import csv
import json
import re
import time
from dataclasses import replace
from unittest.mock import Mock

import pytest
import tiny
import torch

from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.commands.resuming import resumable
from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.evaluation.tradeoff import measuring
from mipmap_plugin.evaluation.tradeoff.files import KEPT, Folder, facts, table, write
from mipmap_plugin.evaluation.tradeoff.front import Tradeoff
from mipmap_plugin.evaluation.tradeoff.measuring import OBSERVED_STEPS, RENDERERS, measure
from mipmap_plugin.evaluation.tradeoff.points import Plan
from mipmap_plugin.evaluation.tradeoff.run import run
from mipmap_plugin.evaluation.tradeoff.truth import base_itself, photographs
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.screen_filters import SCREEN_FILTERS
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

PLAN = Plan(recipes=("default",), steps=(6,), backends=("auto",), supersampling=(2,), renderers=False, repeats=2)
BY_REFERENCE = replace(PLAN, backends=("reference",))


def wrapped(views=None, backend="auto"):
    return wrap_model(tiny.model(30), cameras=tiny.cameras(3) if views is None else views, backend=backend)


def poses(cameras):
    return {tuple(camera.viewmat.flatten().tolist()) for camera in cameras}


# What is judged


def test_photographs_are_the_truth_where_there_are_any(tmp_path):
    model, scene = wrapped(), load_scene(tiny.scene(tmp_path / "scene", train=tiny.cameras(2), count=30))
    yardstick = photographs(model, scene, 1 / 4, most=1)
    assert yardstick.label == "real dB, protocol P3 on 1 photograph"
    assert poses(yardstick.views) <= poses(camera for camera in scene.cameras if camera.split == "test")
    good, bad = model.render(yardstick.views[0].zoomed(1 / 4), 1 / 4, "scaled", 4).image, torch.zeros(6, 8, 3)
    assert yardstick.psnr(yardstick.views[0], good) > 30 > yardstick.psnr(yardstick.views[0], bad)


def test_a_backend_is_measured_that_is_registered_by_another_name_than_its_own():
    class Theirs(ReferenceBackend):
        name = "theirs"

    BACKENDS.add("mine", Theirs)
    points = list(measure(wrapped(), base_itself(wrapped(), 1 / 2, 1), 1 / 2, replace(PLAN, recipes=("instant",), backends=("mine",), repeats=1)))
    assert {point.backend for point in points} == {"theirs"}


def test_a_maximum_of_steps_is_one_run_of_a_recipe_without_steps():
    plan = replace(PLAN, recipes=("instant", "default"), steps=(1, 2), repeats=1)
    points = list(measure(wrapped(), base_itself(wrapped(), 1 / 2, 1), 1 / 2, plan))
    assert [(point.name, point.ended_by) for point in points if point.kind == "adapted" and point.ended_by] == [
        ("instant", "0 steps"), ("default, 1 step at most", "1 step"), ("default, 2 steps at most", "2 steps")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("views", "judged"),
    [
        ([*tiny.cameras(3), *tiny.cameras(2, seed=9, split="test")], 2),
        (tiny.cameras(17), 3),
        (tiny.cameras(2), 1),
        (tiny.cameras(1), 8),
        ([], 8),
    ],
    ids=["its own test views", "every eighth", "one of two", "around the only one", "an orbit"],
)
def test_without_photographs_no_view_that_is_judged_on_is_adapted_to(views, judged):
    yardstick = base_itself(wrapped(views), 1 / 4, None)
    assert len(yardstick.views) == judged
    assert poses(yardstick.views).isdisjoint(poses(yardstick.adapt_on))
    assert bool(yardstick.adapt_on) == bool(views)


def test_without_cameras_the_views_that_are_judged_on_look_from_above_what_is_said_to_be_up():
    views = base_itself(wrap_model(tiny.model(30), up="x"), 1 / 4, None).views
    assert all(view.viewmat[2, 0] < 0.18 and view.viewmat[0, 0].abs() < 1e-9 for view in views)


def test_without_photographs_the_label_says_what_the_truth_is():
    out, between, in_ = (base_itself(wrapped(), scale, 1).label for scale in (1 / 4, 0.3, 4))
    assert between == "dB against the base's image, made smaller (no photographs), 1 view"
    assert out == "dB against the base supersampled 4 x 4 (no photographs), 1 view"
    assert in_ == "dB of the image, shrunk, against the base itself (no photographs), 1 view"


# What is measured


@pytest.fixture(scope="module")
def points():
    """Zoomed out, without photographs."""
    model = wrapped()
    return list(measure(model, base_itself(model, 1 / 4, 1), 1 / 4, replace(PLAN, renderers=True)))


def test_everything_that_needs_no_adapting_stands_beside_the_adapted(points):
    assert [point.name for point in points if point.kind == "base"] == ["base"]
    filters = {point.name for point in points if point.kind == "filter"}
    assert filters == {"scaled", *(SCREEN_FILTERS.keys() - {"classic"})}
    sampled = [point.name for point in points if point.kind == "supersampling"]
    assert sampled == ["supersampling, 2 x 2", "window, 2 x 2 samples"]  # the base, resized, is the truth
    assert all(point.adapt_seconds.high == 0 for point in points if point.kind in ("base", "filter", "supersampling"))


@pytest.mark.parametrize("photographed", [True, False], ids=["photographs", "no photographs"])
def test_where_all_cameras_are_marked_as_for_testing_the_rest_is_adapted_to(tmp_path, photographed):
    """As those of a scene that holds its test part alone: the first run was refused, with advice for another command."""
    views = [replace(view, split="test") for view in tiny.cameras(3)]
    model = wrapped(views)
    truth = photographs(model, load_scene(tiny.scene(tmp_path, views)), 1 / 4, None) if photographed else base_itself(model, 1 / 4, None)
    points = measure(model, truth, 1 / 4, replace(PLAN, steps=(1,), repeats=1))
    assert len(truth.adapt_on) == 2 and "adapted" in [point.kind for point in points]


def test_a_filter_that_the_backend_lacks_is_named(monkeypatch):
    few = replace(ReferenceBackend.capabilities, screen_filters=frozenset({"classic", "antialiased", "mip", "analytic"}))
    monkeypatch.setattr(ReferenceBackend, "capabilities", few)
    model = wrapped(backend="reference")
    [note] = measuring.left_out(model, BY_REFERENCE)
    assert re.match(r"there is no window filter, since backend 'reference' cannot do this(, but cpu can)?: .*not window$", note)
    names = [baseline.name for baseline in measuring._baselines(model, base_itself(model, 1 / 4, 1), 1 / 4, PLAN) if baseline.kind == "filter"]
    assert names == ["scaled", "antialiased", "analytic", "mip"]
    one = measuring.Point(1 / 4, "base", "base", "reference", 30, ms_per_frame=measuring.NOTHING)
    found = Tradeoff(1 / 4, "dB", [one], [note])
    assert table(found).endswith(note) and facts([found], complete=True)["scales"][0]["notes"] == [note]


def test_a_run_is_looked_at_on_its_way_and_at_its_end(points):
    way = [point for point in points if point.kind == "adapted"]
    assert [point.step for point in way] == [step for step in OBSERVED_STEPS if step <= 6] + [None]
    assert [point.ms_per_frame is None for point in way] == [True] * (len(way) - 1) + [False]
    assert way[-1].ended_by == "6 steps" and way[-1].name == "default, 6 steps at most"
    assert way[0].psnr_db.median < way[-1].psnr_db.median
    assert 0 < way[0].adapt_seconds.median < way[-2].adapt_seconds.median <= way[-1].adapt_seconds.median


def test_repeats_have_seeds_of_their_own_and_a_spread(points):
    end = [point for point in points if point.kind == "adapted"][-1]
    assert end.psnr_db.low < end.psnr_db.median < end.psnr_db.high
    assert end.adapt_seconds.low < end.adapt_seconds.high


def test_the_adapted_model_is_drawn_with_every_setting_of_a_renderer(points):
    drawn = {point.name.removeprefix("default, "): point for point in points if point.kind == "renderer"}
    assert list(drawn) == [name for name, _, _ in RENDERERS]
    usual = drawn["as usual"].psnr_db.median
    assert drawn["tile 32"].psnr_db.median == pytest.approx(usual, abs=1e-3)
    assert drawn["float64"].psnr_db.median == pytest.approx(usual, abs=1e-2)
    assert drawn["alpha from 1/16"].psnr_db.median != pytest.approx(usual, abs=1e-3)


@pytest.mark.parametrize(("scale", "samples"), [(1 / 4, [2]), (1 / 2, []), (0.3, [2, 4]), (2, [2])])
def test_the_base_is_not_compared_with_itself(scale, samples):
    """Nor is the truth enlarged and shrunk again, or sampled in as many places as it was. At x0.3 no whole pixels of the base fit into a pixel."""
    model, plan = wrapped(), replace(PLAN, supersampling=(2, 4, 8))
    names = [each.name for each in measuring._baselines(model, base_itself(model, scale, 1), scale, plan)]
    assert "base, resized" not in names
    assert [name for name in names if name.startswith("supersampling")] == [f"supersampling, {n} x {n}" for n in samples]


def test_the_base_resized_stands_beside_photographs(tmp_path):
    model, scene = wrapped(), load_scene(tiny.scene(tmp_path / "scene"))
    yardstick = photographs(model, scene, 1 / 4, 1)
    assert "base, resized" in [point.name for point in measure(model, yardstick, 1 / 4, replace(PLAN, recipes=()))]


def test_photographs_that_the_checkpoint_counts_as_of_training_are_not_adapted_to(tmp_path):
    """Without `eval` in cfg_args every camera of the checkpoint does."""
    photographed, others = [replace(camera, split="train") for camera in tiny.cameras(2, seed=9)], tiny.cameras(2)
    yardstick = photographs(wrapped([*photographed, *others]), load_scene(tiny.scene(tmp_path / "scene")), 1 / 4, 1)
    assert yardstick.adapt_on == others


def test_where_every_camera_has_a_photograph_each_eighth_is_judged(tmp_path):
    views = tiny.cameras(10)
    scene = load_scene(tiny.scene(tmp_path / "scene", test=[replace(view, split="test") for view in views]))
    yardstick = photographs(wrapped(views), scene, 1 / 4, None)
    assert [view.name for view in yardstick.views] == ["view_0", "view_8"]
    assert [view.name for view in yardstick.adapt_on] == [f"view_{n}" for n in range(10) if n % 8]


def test_a_checkpoint_of_which_every_view_is_judged_is_refused(tmp_path):
    scene = load_scene(tiny.scene(tmp_path / "scene", test=[replace(tiny.cameras(1)[0], split="test")]))
    with pytest.raises(SettingsError, match="none is left to adapt to; give photographs of fewer views"):
        photographs(wrapped(tiny.cameras(1)), scene, 1 / 4, None)


def test_measuring_is_not_billed(monkeypatch):
    model = wrapped()
    yardstick = base_itself(model, 1 / 4, 1)
    now, draw = [0.0], ReferenceBackend.render  # seconds: each image takes one, and each look at its quality a thousand

    def passes(seconds, result):
        now[0] += seconds
        return result

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(ReferenceBackend, "render", lambda *scene: passes(1, draw(*scene)))
    slow = replace(yardstick, psnr=lambda *pair: passes(1000, yardstick.psnr(*pair)))
    points = list(measure(model, slow, 1 / 4, replace(BY_REFERENCE, repeats=1)))
    assert points[0].ms_per_frame.median == points[-1].ms_per_frame.median == 1000
    assert 6 <= points[-1].adapt_seconds.median < 1000  # its own looks at validation views are


def test_the_first_use_of_a_backend_is_not_billed(monkeypatch):
    asked, real = [], measuring.Wrapped.adapt

    def adapt(*args, observe=None, **settings):
        asked.append((settings["steps"], "measured" if observe else "warm-up"))
        return real(*args, observe=observe, **settings)

    monkeypatch.setattr(measuring.Wrapped, "adapt", adapt)
    model = wrapped()
    list(measure(model, base_itself(model, 1 / 4, 1), 1 / 4, PLAN))
    assert asked == [(1, "warm-up"), (6, "measured"), (6, "measured")]


def test_scale_one_has_nothing_to_trade(tmp_path, monkeypatch):
    monkeypatch.setattr(measuring, "_measured", lambda *_: pytest.fail("it is refused before anything is measured"))
    with pytest.raises(SettingsError, match="give another scale"):
        run(wrapped(), None, [1 / 4, 1], PLAN, 1, Folder(tmp_path, picture=False, overwrite=False))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (dict(repeats=0), "repeats must be 1 to 1000, got 0"),
        (dict(repeats=10**11), "repeats must be 1 to 1000, got 100000000000"),
        (dict(supersampling=(4, 1)), "supersampling must be at least 2, for 2 x 2 samples a pixel, got 1"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(wrong, told):
    with pytest.raises(SettingsError, match=f"^{told}$"):
        Plan(**wrong)


# What is written


def test_json_csv_and_table_hold_every_point(tmp_path):
    found = run(wrapped(), None, [1 / 4, 2], replace(PLAN, repeats=1), 1, Folder(tmp_path / "new", picture=False, overwrite=False))
    told = json.loads((tmp_path / "new/tradeoff.json").read_text())
    assert told == json.loads(json.dumps(facts(found, complete=True)))
    assert [each["scale"] for each in told["scales"]] == [0.25, 2] and told["complete"]
    rows = list(csv.DictReader((tmp_path / "new/tradeoff.csv").open()))
    assert len(rows) == sum(len(each.points) for each in found)
    assert {row["truth"] for row in rows} == {each.truth for each in found}
    assert float(rows[0]["psnr_db_median"]) == found[0].points[0].psnr_db.median
    text = table(found[0])
    assert found[0].truth in text and all(sentence in text for sentence in found[0].sentences())
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["tradeoff.csv", "tradeoff.json"]


def test_a_plot_does_not_outlive_its_results(tmp_path):
    (tmp_path / "tradeoff.png").write_bytes(b"of an earlier command")
    write(Folder(tmp_path, picture=False, overwrite=True), [], complete=True)
    assert (tmp_path / "tradeoff.png").exists()  # there are no results that it is of
    write(Folder(tmp_path, picture=False, overwrite=True), [], complete=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tradeoff.csv", "tradeoff.json"]


def test_ctrl_c_keeps_what_was_measured_and_says_where(tmp_path, monkeypatch, capsys):
    left = iter(range(4))

    def tired(point, show, yardstick, repeats, judged=measuring._measured):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return judged(point, show, yardstick, repeats)

    monkeypatch.setattr(measuring, "_measured", tired)
    with pytest.raises(KeyboardInterrupt), resumable(tmp_path / KEPT, "cell"):
        run(wrapped(), None, [1 / 4, 4], PLAN, 1, Folder(tmp_path, picture=False, overwrite=False))
    assert f"the 4 points measured so far: {tmp_path}" in capsys.readouterr().err
    told = json.loads((tmp_path / "tradeoff.json").read_text())
    assert not told["complete"] and [len(each["points"]) for each in told["scales"]] == [4]


def test_ctrl_c_before_the_first_point_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(measuring, "_measured", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(wrapped(), None, [1 / 4], PLAN, 1, Folder(tmp_path / "new", picture=False, overwrite=False))
    assert not (tmp_path / "new").exists()


def test_a_picture_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    run(wrapped(), None, [1 / 4], replace(PLAN, repeats=1), 1, Folder(tmp_path, picture=True, overwrite=False))
    assert (tmp_path / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]


def test_an_existing_result_is_refused_by_the_library_too(tmp_path):
    (tmp_path / "tradeoff.json").write_text("{}")
    with pytest.raises(OutputExists):
        run(wrapped(), None, [1 / 4], replace(PLAN, recipes=()), 1, Folder(tmp_path, picture=False, overwrite=False))
