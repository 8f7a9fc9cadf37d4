"""What every table measures by: one clock, one list of baselines under one set of names, and poses compared."""

import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import anchor_checkpoints
import pytest
import tiny
import torch
from largest import Largest

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.adaptation.warn import silent, warn
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.evaluation.evaluate import Evaluator, training_free_rows
from mipmap_plugin.evaluation.judged import judged_views
from mipmap_plugin.evaluation.measure import baselines, resized_base, views_seen, warm_stopwatch, warm_up
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.evaluation.tradeoff.measuring import measure
from mipmap_plugin.evaluation.tradeoff.points import Plan
from mipmap_plugin.evaluation.tradeoff.truth import photographs
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.scenes.trajectories import rotation_matrix
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


def wrapped(**options):
    return wrap_model(tiny.model(30, **options), cameras=tiny.cameras(2), backend="reference")


# Rivals


@pytest.mark.parametrize(
    ("scale", "names"),
    [
        (1, ["base"]),
        (1 / 2, ["base", "scaled", "window", "antialiased", "supersampling, 2 x 2", "base, resized"]),
        (1 / 8, ["base", "scaled", "window", "antialiased", "supersampling, 8 x 8", "window, 4 x 4 samples", "base, resized"]),
        (4, ["base", "scaled", "window", "antialiased", "base, resized"]),
    ],
)
def test_everything_that_needs_no_adapting_has_its_name(scale, names):
    assert [baseline.name for baseline in baselines(wrapped(), scale, "area")] == names


def test_the_filter_of_training_is_the_base_and_no_row_of_its_own():
    model = wrapped(trained=TrainedScale("antialiased", 0.3))
    assert [baseline.name for baseline in baselines(model, 2, "area")] == ["base", "scaled", "window", "base, resized"]


def test_a_baseline_counts_the_splats_that_levels_of_detail_show_where_it_draws_the_base(tmp_path):
    view = tiny.cameras(1)[0]
    model = wrap_model(anchor_checkpoints.write(tmp_path / "model", anchor_checkpoints.Layout("octree"), count=80), cameras=[view])
    counts = {baseline.name: baseline.gaussians for baseline in baselines(model, 1 / 4, "area")}
    near, far = (len(model.model.gaussians(view.zoomed(zoom))) for zoom in (1, 1 / 4))
    assert (counts["base, resized"], counts["base"]) == (near, far) and far < near


def test_an_upsampler_stands_beside_the_bicubic_one_at_zoom_in_only():
    register_upsampler("tests/mine", lambda image, size: image.new_zeros(*size, 3))
    shown = {baseline.name: baseline.render for baseline in baselines(wrapped(), 2, "area", upsampler="tests/mine")}
    assert shown["base upsampled by mine"](tiny.cameras(1)[0]).max() == 0 < shown["base, resized"](tiny.cameras(1)[0]).max()
    assert "base upsampled by mine" not in [baseline.name for baseline in baselines(wrapped(), 1 / 2, "area", upsampler="tests/mine")]


def test_a_table_and_a_tradeoff_have_the_same_rivals_under_the_same_names_with_the_same_decibels(tmp_path):
    model, scene = wrapped(), load_scene(tiny.scene(tmp_path / "scene", count=30))
    judge = Evaluator(judged_views(scene, model.cameras, model.background), PROTOCOLS["P3"])
    rows = {row.name: row.psnr_db for row in training_free_rows(model, judge, 1 / 4)}
    plan = Plan(recipes=(), backends=("reference",), supersampling=(4,), renderers=False, repeats=1)
    points = {point.name: point.psnr_db.median for point in measure(model, photographs(model, scene, 1 / 4, None), 1 / 4, plan)}
    assert {name: points.get(name) for name in rows} == pytest.approx(rows)
    assert set(points) - set(rows) == {"mip", "analytic"}


def test_the_base_is_resized_by_the_filter_that_judges_and_clamped_before():
    image = 3 * torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(0)) - 1
    for method, same in (("box", "box"), ("area", "area"), ("pil-bicubic", "pil-bicubic"), ("lanczos", "lanczos")):
        torch.testing.assert_close(resized_base(image, (6, 8), shrink_by=method), resize(image.clamp(0, 1), (6, 8), same))
    torch.testing.assert_close(resized_base(image, (7, 10), shrink_by="box"), resize(image.clamp(0, 1), (7, 10), "area"))
    torch.testing.assert_close(resized_base(image, (48, 64), shrink_by="area"), resize(image.clamp(0, 1), (48, 64), "pil-bicubic"))


def test_samples_are_clamped_before_they_are_averaged():
    splats = tiny.gaussians(30)
    splats.sh.mul_(4)  # highlights beyond 1, which no display shows
    model = wrap_model(VanillaModel.from_gaussians(splats), cameras=tiny.cameras(1), backend="reference")
    show = {baseline.name: baseline.render for baseline in baselines(model, 1 / 4, "area")}
    view = model.cameras[0]
    assert model.render(view).image.max() > 1.2
    torch.testing.assert_close(show["supersampling, 4 x 4"](view), show["base, resized"](view), atol=1e-5, rtol=0)


# The clock


def test_the_first_image_of_a_row_is_not_billed(monkeypatch):
    now, calls = [0.0], []

    def show(view):
        calls.append(view)
        now[0] += 1000 if len(calls) == 1 else 1  # seconds; the first compiles
        return torch.zeros(*view.size, 3)

    class Black:
        camera = tiny.cameras(1)[0]

        def truth(self, scale, protocol):
            now[0] += 10  # judging is not drawing
            return torch.ones(*self.camera.size, 3)

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    row = Evaluator([Black(), Black()], PROTOCOLS["P3"]).row("black", 1, show, gaussians=0)
    assert row.ms_per_view == 1000 and len(calls) == 3


def test_the_watch_waits_for_the_device_that_draws(monkeypatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)

    class OnGpu:
        device = torch.device("cuda")

    with warm_stopwatch(lambda view: OnGpu(), tiny.cameras(1)[0]):
        pass
    assert waited == [torch.device("cuda")] * 2


def test_warming_up_takes_one_step_on_one_view(monkeypatch):
    drawn, draw = set(), ReferenceBackend.render

    def render(self, gaussians, camera, effects):
        drawn.add(tuple(camera.viewmat.flatten().tolist()))
        return draw(self, gaussians, camera, effects)

    monkeypatch.setattr(ReferenceBackend, "render", render)
    model = wrapped()
    warm_up(model, 2, model.cameras)
    assert tuple(model.cameras[0].viewmat.flatten().tolist()) in drawn
    assert len(drawn) == 1 + 2 + 1  # two of validation, and where a splat is drawn to have kernels compiled


# Poses


def turned(camera, degrees):
    viewmat = camera.viewmat.clone()
    viewmat[:3] = rotation_matrix(torch.tensor([0.0, degrees * torch.pi / 180, 0.0], dtype=torch.float64)) @ viewmat[:3]  # about its own eye
    return replace(camera, viewmat=viewmat)


def shifted(camera, by):
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += by
    return replace(camera, viewmat=viewmat)


def test_a_warm_up_warns_of_nothing_and_leaves_pythons_filters_alone(monkeypatch):
    said = lambda *_, **__: warn("no view shows these")  # noqa: E731
    model = wrapped()
    monkeypatch.setattr(model, "adapt", said)
    before = list(warnings.filters)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warm_up(model, 1 / 4, tiny.cameras(2))
        assert not caught
        with ThreadPoolExecutor(1) as pool, silent():
            pool.submit(said).result()  # another thread's adaptation
        said()
    assert [str(each.message) for each in caught] == 2 * ["no view shows these"] and warnings.filters == before


def test_a_warm_up_on_one_view_of_many_does_not_say_what_that_view_leaves_out():
    model = wrap_model(tiny.model(30), cameras=[turned(tiny.cameras(1)[0], 45), *tiny.cameras(3)], backend="reference")
    with pytest.warns(UserWarning, match="no view shows"):
        model.adapt(1 / 4, cameras=model.cameras[:1], views="given", steps=1, validation_views=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warm_up(model, 1 / 4, model.cameras)


def test_a_warm_up_is_on_a_view_that_shows_something():
    """As before a whole comparison, whose other views show the scene."""
    model = wrap_model(tiny.model(30), cameras=[turned(tiny.cameras(1)[0], 180), *tiny.cameras(2)], backend="reference")
    warm_up(model, 1 / 4, model.cameras)


def test_a_view_is_known_again_by_its_pose_whatever_its_name_lens_and_digits():
    views = tiny.cameras(5)
    as_written = [replace(view.zoomed(3), viewmat=(view.viewmat * 1e4).round() / 1e4, name="other") for view in views]
    assert views_seen(views, as_written[1:3]) == views[1:3]


def test_a_single_view_far_from_the_origin_is_known_again_but_for_its_digits():
    view = tiny.cameras(1)[0]
    far = replace(view, viewmat=view.viewmat + torch.tensor([0, 0, 0, 1e4]) * torch.tensor([1, 1, 1, 0])[:, None])
    assert views_seen([far], [replace(far, viewmat=far.viewmat.float().double())]) == [far]


@pytest.mark.parametrize("change", [lambda view: turned(view, 1.0), lambda view: shifted(view, 0.02)], ids=["turned", "shifted"])
def test_a_view_beside_another_is_another(change):
    views = tiny.cameras(5)
    assert views_seen(views, [change(view) for view in views]) == []
    assert views_seen(views, []) == views_seen([], views) == []


def test_views_are_known_again_without_a_number_for_each_pair():
    """A capture has up to 10,000 cameras, of which 100 million pairs took seconds and gigabytes."""
    views = tiny.cameras(60)
    with Largest() as largest:
        assert views_seen(views, views[1:]) == views[1:]
    assert largest.numbers < 60 * 20


def test_the_same_pose_at_another_time_is_another_view():
    still = tiny.cameras(1)[0]
    at = [replace(still, time=time) for time in (0.0, 0.5)]
    assert views_seen(at, [at[1]]) == [at[1]]
    assert views_seen(at, [still]) == at  # at which time it was adapted to is not known


@pytest.mark.parametrize("recipe", ["instant", "default", "paper"])
def test_an_adapted_model_knows_the_views_that_it_was_adapted_to(recipe):
    model = wrapped()
    adapted = model.adapt(1 / 4, recipe=recipe, steps=0 if recipe == "instant" else 1, extra_views=3, views="jittered", validation_views=4)
    assert len(adapted.adapted_to) == 5 + 4 and views_seen(model.cameras, adapted.adapted_to) == model.cameras
