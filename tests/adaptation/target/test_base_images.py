"""The base's images: kept in 16 bits under a bound, and drawn once for all scales."""

import math

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.image_store import ImageStore
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.wrap import wrap_model

LIKE = torch.zeros(1)
TRAINED = Effects(sh_degree=1)


@pytest.fixture
def drawn(monkeypatch):
    """The poses and sizes of all base images that are drawn."""
    seen, draw = [], BaseImages._drawn

    def noted(self, views, fraction):
        seen.extend((view.viewmat.numpy().tobytes(), view.size, fraction) for view in views)
        return draw(self, views, fraction)

    monkeypatch.setattr(BaseImages, "_drawn", noted)
    return seen


def noise(seed=0):
    return torch.rand(40, 50, 3, generator=torch.Generator().manual_seed(seed))


def test_eight_bit_images_come_back_exactly():
    image = noise().mul(255).round().div(255)
    assert torch.equal(ImageStore(1 << 20, LIKE)("image", lambda: image), image)


def test_overshoots_are_kept_and_rounding_is_far_below_what_is_measured():
    image = 3 * noise() - 1
    stored = ImageStore(1 << 20, LIKE)("image", lambda: image)
    error = (stored - image).square().mean()
    assert -10 * math.log10(error) > 94
    at_65_db = 10**-6.5
    assert abs(10 * math.log10((at_65_db + float(error)) / at_65_db)) < 0.01


def test_an_image_beyond_the_limit_is_made_again_and_looks_the_same():
    made = []
    store = ImageStore(limit=noise().numel() * 2, like=LIKE)
    for _ in range(2):
        first, second = (store(seed, lambda seed=seed: (made.append(seed), noise(seed))[1]) for seed in (0, 1))
    assert made == [0, 1, 1]
    assert torch.equal(first, store(0, noise)) and torch.equal(second, ImageStore(1 << 20, LIKE)(1, lambda: noise(1)))


def test_images_that_were_made_together_are_forgotten_one_by_one():
    store = ImageStore(1 << 20, LIKE)
    store.of_one_size([0, 1, 2], lambda numbers: torch.stack([noise(number) for number in numbers]))
    store.keep_only(lambda key: key == 1)
    [kept] = store._images.values()
    assert kept.untyped_storage().nbytes() == kept.nbytes == store._bytes
    assert torch.equal(store(1, lambda: 1 / 0), ImageStore(1 << 20, LIKE)(1, lambda: noise(1)))


def test_the_dtype_is_the_models():
    model = tiny.model()
    model.replace_parameters({name: tensor.double() for name, tensor in model.parameters().items()})
    with torch.no_grad():
        assert BaseImages(model, ReferenceBackend(), TRAINED)(tiny.cameras(1)[0]).dtype == torch.float64


def test_cameras_that_see_the_same_share_an_image_and_others_do_not(drawn):
    images, view = BaseImages(tiny.model(), ReferenceBackend(), TRAINED), tiny.cameras(1)[0]
    for again in (view, view.looking_from(view.viewmat, "another name"), view.resized(16, 12), tiny.cameras(1, seed=2)[0]):
        images(again)
    assert len(drawn) == 3


def test_each_base_image_is_drawn_once_for_all_scales(drawn):
    wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(3))
    wrapped.adapt(1 / 2, steps=2, extra_views=1, validation_views=2)
    first = list(drawn)
    wrapped.adapt(1 / 4, steps=2, extra_views=1, validation_views=2)
    assert len(set(first)) == len(first) > 0 and drawn == first


def test_where_the_time_is_measured_all_images_are_drawn_again(drawn):
    wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(3))
    for _ in range(2):
        adapt_alone(wrapped, 1 / 2, steps=1, extra_views=1, validation_views=2)
    assert len(drawn) == 2 * len(set(drawn)) > 0


def test_a_scale_is_adapted_alike_whether_or_not_another_came_before():
    def adapted(*scales):
        wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(3))
        return [wrapped.adapt(scale, steps=2, extra_views=1, validation_views=2) for scale in scales][-1].model.parameters()

    alone, after = adapted(1 / 4), adapted(1 / 2, 1 / 4)
    assert all(torch.equal(tensor, after[name]) for name, tensor in alone.items())


def test_a_base_that_is_adapted_once_keeps_no_images(drawn):
    def adapted(keeps):
        wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(3))
        wrapped.keeps_images = keeps
        parameters = wrapped.adapt(1 / 2, steps=4, extra_views=1, validation_views=2).model.parameters()
        return wrapped.images._store._bytes, parameters

    (kept, usual), first = adapted(True), len(drawn)
    none, once = adapted(False)
    assert kept > 0 == none and len(drawn) == 2 * first  # no image is drawn twice for one scale
    assert all(torch.equal(tensor, once[name]) for name, tensor in usual.items())


def test_views_that_are_not_used_any_more_make_room(drawn):
    first, second = tiny.cameras(2)
    images = BaseImages(tiny.model(), ReferenceBackend(), TRAINED, limit=32 * 24 * 3 * 2)
    for view in (first, second, second):
        images(view)
    images.keep_only([second])
    for _ in range(2):
        images(second)
    assert [pose for pose, *_ in drawn] == [view.viewmat.numpy().tobytes() for view in (first, second, second, second)]
