"""Several views at once: where a GPU waits for each operation, weights, truths and checks are found for all of them in one call."""

import pretended
import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.optimization import validation
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.adaptation.parallel import ROWS_OF_VIEWS, together
from mipmap_plugin.adaptation.renderers import Renderer, SteppingRenderer
from mipmap_plugin.adaptation.start import blend_weights as weights
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.backends import register_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects

EFFECTS = Effects(sh_degree=1)


class Together(ReferenceBackend):
    """Notes how many views it is asked for at a time."""

    def __init__(self):
        self.calls = []

    def render_views(self, gaussians, shots):
        self.calls.append(len(shots))
        return [super(Together, self).render(gaussians, *shot) for shot in shots]

    def weigh_views(self, gaussians, shots):
        self.calls.append(len(shots))
        return torch.stack([weights._color_gradient(gaussians, view, ReferenceBackend(), effects) for view, effects in shots])

    def render(self, *_):
        raise AssertionError("a view alone")


@pytest.mark.parametrize(("scale", "settings"), [
    (1 / 4, {}), (1 / 4, {"quantize_truth": True}), (1 / 4, {"truth_oversampling": 2.0}), (2, {"compare_at": "base"}),
])  # fmt: skip
def test_truths_that_are_prepared_are_the_same(scale, settings):
    views, backend = [*tiny.cameras(3), *tiny.cameras(2, width=24, height=16)], Together()
    truths, alone = (PseudoTruth(BaseImages(tiny.model(), each, EFFECTS), scale, AdaptConfig(**settings)) for each in (backend, ReferenceBackend()))
    truths.prepare([*views, views[0]])
    assert backend.calls == [3, 2]  # one for each size
    for view in views:
        assert torch.equal(truths(view), alone(view)) and truths(view).is_contiguous()
    truths.prepare(views)
    assert backend.calls == [3, 2]


def test_truths_beyond_the_room_that_there_is_are_made_again():
    views = tiny.cameras(3)
    alone = PseudoTruth(BaseImages(tiny.model(), ReferenceBackend(), EFFECTS, limit=0), 1 / 4, AdaptConfig())
    images = BaseImages(tiny.model(), Together(), EFFECTS, limit=6 * 3 * views[0].width * views[0].height)  # one of them
    together = images.of_one_size(views)
    assert torch.equal(together, torch.stack([alone._base(view) for view in views]))


def test_truths_that_an_upsampler_makes_are_prepared_one_by_one():
    register_upsampler("plain", lambda image, size: image.new_zeros(*size, 3), replace=True)
    truths = PseudoTruth(BaseImages(tiny.model(), ReferenceBackend(), EFFECTS), 2, AdaptConfig(upsampler="plain", compare_at="target"))
    truths.prepare(tiny.cameras(2))
    assert not truths(tiny.cameras(1)[0]).any()


def test_the_time_of_truths_that_are_prepared_is_that_of_each():
    costs, views = Costs(), tiny.cameras(3)
    costs.prepare(views, lambda some: some)
    assert list(costs.truths) == views and len(set(costs.truths.values())) == 1


def test_truths_that_are_used_next_are_drawn_in_one_call():
    drawn = []

    class Noting(ReferenceBackend):
        name, speed = "noting", -1

        def render_views(self, gaussians, shots):
            drawn.append((shots[0][0].zoom, len(shots)))
            return [self.render(gaussians, *shot) for shot in shots]

    register_backend("noting", Noting, replace=True)
    settings = dict(steps=6, views_per_step=1, extra_views=0, closed_form=False, merge_to=1.0, validation_views=2)
    with pretended.pretending():
        wrapped = wrap_model(tiny.model().to(pretended.DEVICE), cameras=tiny.cameras(6, width=16, height=12), backend="noting")
        wrapped.adapt(1 / 4, **settings)
    assert [count for zoom, count in drawn if zoom == 1] == [6]


def test_weights_of_several_views_are_the_same(monkeypatch):
    monkeypatch.setattr(weights, "together", lambda *_: 2)
    splats, views, backend, parts = tiny.gaussians(40), tiny.cameras(5), Together(), [0, 1, 2, 3, 1]
    found, shown = weights.weighed(splats, views, parts, backend, EFFECTS)
    expected, expected_shown = weights.weighed(splats, views, parts, ReferenceBackend(), EFFECTS)
    torch.testing.assert_close(found, expected)
    assert shown == expected_shown and backend.calls == [2, 2, 1]


def test_views_of_a_step_are_drawn_in_one_call_whatever_their_effects():
    drawn = []

    class Stepper:
        def render_all(self, shots):
            drawn.append(len(shots))
            return [ReferenceBackend().render(tiny.gaussians(8), *shot) for shot in shots]

        def differentiate_all(self, gradients):
            pass

    renderer = SteppingRenderer(lambda raw: Stepper(), [Effects(1), Effects(0)])
    errors = renderer.differentiate(Stepper(), tiny.cameras(2), 0, lambda numbers, images: [(image, image.mean()) for image in images])
    assert drawn == [2] and len(errors) == 2


@pytest.mark.parametrize("fits", [True, False])
def test_a_check_draws_all_views_in_one_call_if_these_fit(fits, monkeypatch):
    monkeypatch.setattr(validation, "together", lambda *_: 9 if fits else 1)
    views, drawn = tiny.cameras(4), []
    backend = Together() if fits else ReferenceBackend()
    for each in (backend, ReferenceBackend()):
        check = Validation(views, [], 1.0, lambda view: torch.full((*view.size, 3), 0.3), [Renderer(each, EFFECTS)], "area")
        drawn.append(check.steer(tiny.model()))
    assert drawn[0] == drawn[1]
    assert not fits or backend.calls == [4]


def test_as_many_views_are_drawn_together_as_there_is_memory_for():
    """Splats and pixels alike bound them; on a processor there is no need to."""
    views = [tiny.cameras(1)[0].resized(512, 512)]
    assert together(torch.zeros(10, 3), views) == 1
    with pretended.pretending():
        few, many = (torch.zeros(count, 3).to(pretended.DEVICE) for count in (10, ROWS_OF_VIEWS // 2))
        assert together(few, views) == ROWS_OF_VIEWS // 512**2
        assert together(many, views) == 2
        assert together(torch.cat([many] * 3), views) == 1
