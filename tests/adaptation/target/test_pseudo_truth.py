"""The teacher and its views: rendered once per view at the base scale, resized, and seen from where the policy says."""

import math

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.adaptation.views import policy as policies
from mipmap_plugin.adaptation.views.policy import choose_views, extent
from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes.orbits import Orbit

TRAINED = Effects(sh_degree=1)


class Recorder(ReferenceBackend):
    """Notes the size and the filter of every image that it renders."""

    def __init__(self):
        self.seen = []

    def render(self, gaussians, camera, effects):
        self.seen.append((camera.width, camera.height, effects.eps2d, torch.is_grad_enabled()))
        return super().render(gaussians, camera, effects)


def teacher(scale, backend=None, model=None, **settings):
    return PseudoTruth(BaseImages(model or tiny.model(), backend or ReferenceBackend(), TRAINED), scale, AdaptConfig(**settings))


def base(view, model=None):
    return ReferenceBackend().render((model or tiny.model()).gaussians(view), view, TRAINED).image


def bright():
    """Splats whose colors go far beyond 1."""
    model = tiny.model()
    model.parameters()["sh0"].add_(3.0)
    return model


# The teacher


def test_each_view_is_rendered_once_at_its_own_scale_without_gradients():
    recorder, views = Recorder(), tiny.cameras(3)
    truth = teacher(1 / 4, recorder)
    first = [truth(view) for view in views]
    again = [truth(view) for view in views]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert recorder.seen == [(32, 24, 0.3, False)] * 3


def test_zoomed_out_it_is_the_clamped_base_resized():
    view = tiny.cameras(1)[0]
    truth = teacher(1 / 4, model=bright(), resize="area")(view)
    image = base(view, bright())
    assert image.max() > 1.5
    torch.testing.assert_close(truth, resize(image.clamp(0, 1), (6, 8), "area"), atol=1e-4, rtol=0)


def test_zoomed_in_it_is_the_clamped_base_upsampled():
    given = []
    register_upsampler("mine", lambda image, size: given.append((image, size)) or image.new_zeros(*size, 3))
    view = tiny.cameras(1)[0]
    truth = teacher(4, model=bright(), upsampler="mine")(view)
    assert truth.shape == (96, 128, 3) and given[0][1] == (96, 128)
    torch.testing.assert_close(given[0][0], base(view, bright()).clamp(0, 1), atol=1e-4, rtol=0)


def test_the_papers_is_in_eight_bits_and_ours_is_not():
    view = tiny.cameras(1)[0]
    images = BaseImages(tiny.model(), ReferenceBackend(), TRAINED)
    levels = PseudoTruth(images, 1 / 4, recipe("paper", 1 / 4))(view) * 255
    ours = PseudoTruth(images, 1 / 4, recipe("default", 1 / 4, resize="pil-bicubic"))(view) * 255
    torch.testing.assert_close(levels, levels.round(), atol=1e-4, rtol=0)
    assert (ours - ours.round()).abs().max() > 0.1


def test_a_coarser_render_costs_less_and_is_nearly_the_same():
    recorder, view = Recorder(), tiny.cameras(1, width=128, height=96)[0]
    coarse = teacher(1 / 16, recorder, truth_oversampling=4)(view)
    assert recorder.seen == [(32, 24, 0.3 / 16, False)]
    assert psnr(coarse, teacher(1 / 16)(view)) > 40


@pytest.mark.parametrize("scale", [1 / 2, 1 / 4])
def test_a_render_is_never_finer_than_the_base(scale):
    recorder = Recorder()
    teacher(scale, recorder, truth_oversampling=4)(tiny.cameras(1)[0])
    assert recorder.seen == [(32, 24, 0.3, False)]


# Which views


def chosen(views, cameras=None, **settings):
    cameras = tiny.cameras(4) + tiny.cameras(2, seed=5, split="test") if cameras is None else cameras
    return choose_views(cameras, Viewpoints(Orbit.around(tiny.gaussians().means), list), AdaptConfig(views=views, **settings)), cameras


@pytest.mark.parametrize(
    ("policy", "picked", "sentence"),
    [
        ("given", slice(0, 6), "the 6 given views"),
        ("train", slice(0, 4), "the 4 train views"),
        ("test", slice(4, 6), "the 2 test views"),
    ],
)
def test_given_views(policy, picked, sentence):
    (views, which), cameras = chosen(policy)
    assert views == cameras[picked] and which == sentence


def test_jittered_views_are_the_training_views_and_new_ones_around_them():
    (views, which), cameras = chosen("jittered", extra_views=7)
    assert views[:4] == cameras[:4] and len(views) == 11
    assert which == "4 train views and 7 around them"
    assert all(view.size == (24, 32) for view in views)
    reach = max(float((a.center - b.center).norm()) for a in cameras for b in cameras)
    assert all(min(float((view.center - camera.center).norm()) for camera in cameras) < reach for view in views)


def test_an_orbit_that_is_asked_for_samples_as_densely_as_the_cameras():
    (views, which), cameras = chosen("orbit", extra_views=5)
    assert len(views) == 5 and all(math.isclose(view.fx, cameras[0].fx, rel_tol=0.05) for view in views)
    assert which == f"5 views of a generated orbit at {views[0].width} px (as requested)"


@pytest.mark.parametrize("policy", ["given", "train", "test", "orbit", "jittered"])
def test_without_cameras_there_is_an_orbit(policy):
    (views, which), _ = chosen(policy, cameras=[], extra_views=5)
    assert which == f"5 views of a generated orbit at {policies.ORBIT_PIXELS} px (the checkpoint came without cameras)"
    assert len(views) == 5


def test_views_are_spread_over_their_order():
    views = tiny.cameras(7)
    assert evenly(views, 3) == [views[0], views[2], views[4]]
    assert evenly(views, 7) == views and evenly(views, 100) == views


def test_views_are_gathered_evenly_and_then_come_in_rounds():
    views, config = tiny.cameras(12), recipe("default", 1 / 4, steps=20, views_per_step=3, gathering=0.5, warm_up=0)
    order, known, growth = ViewSchedule(views, config), set(), []
    for step in range(10):
        taken = order(step, step / 20)
        assert len(taken) == len(set(taken)) == 3
        growth.append(len(set(taken) - known))
        known |= set(taken)
    assert growth[0] == 3 and max(growth[1:]) <= 2 and known == set(views)
    later = [view for step in range(12, 20) for view in order(step, step / 20)]
    assert set(later[:12]) == set(later[12:]) == set(views)
    assert [ViewSchedule(views, config)(step, step / 20) for step in range(20)] == [order(step, step / 20) for step in range(20)]


def test_a_step_takes_few_views_at_first_and_later_rounds_miss_none():
    views, config = tiny.cameras(12), recipe("default", 1 / 4, steps=40, views_per_step=4, gathering=0.2, warm_up=0.4)
    order = ViewSchedule(views, config)
    taken = [order(step, step / 40) for step in range(40)]
    assert [len(step) for step in taken] == [1] * 4 + [2] * 4 + [3] * 4 + [4] * 28
    assert {view for step in taken[:8] for view in step} == set(views)
    drawn = [view for step in taken[8:] for view in step]  # 12 were drawn before them: a whole round
    assert all(set(drawn[start : start + 12]) == set(views) for start in range(0, len(drawn) - 11, 12))


def test_where_time_is_short_views_come_in_faster():
    order = ViewSchedule(tiny.cameras(12), recipe("default", 1 / 4, steps=400, views_per_step=3, warm_up=0, time_budget_s=1.0))
    early, late = ({view for step in range(3) for view in order(step, progress)} for progress in (0.0, 0.25))
    assert len(early) == 3 and len(late) > 5


def test_no_more_views_come_in_than_steps_take():
    order = ViewSchedule(tiny.cameras(9), recipe("default", 1 / 4, steps=4, views_per_step=2, gathering=0.5, warm_up=0))
    assert [len(set(order(0, 0))), len(set(order(0, 0) + order(1, 0.25)))] == [2, 4]


def test_a_step_takes_no_view_twice_where_there_are_few():
    order = ViewSchedule(tiny.cameras(2), recipe("default", 1 / 4, steps=4, views_per_step=3, gathering=0.5, warm_up=0))
    assert [len(set(order(step, step / 4))) for step in range(4)] == [len(order(step, step / 4)) for step in range(4)] == [2, 2, 2, 2]


def test_steps_and_rounds_meet_again_after_the_warm_up():
    views = tiny.cameras(4)
    order = ViewSchedule(views, recipe("default", 1 / 4, steps=400, views_per_step=4, gathering=0.1, warm_up=0.025))
    assert all(set(order(step, step / 400)) == set(views) for step in range(40, 60))


def test_the_extent_is_inrias_and_one_for_a_single_place():
    views = tiny.cameras(4)
    centers = torch.stack([view.center for view in views])
    assert extent(views) == pytest.approx(1.1 * float((centers - centers.mean(0)).norm(dim=1).max()))
    assert extent(views[:1]) == 1.0
