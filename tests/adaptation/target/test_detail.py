"""Zoom-in with an upsampler: which part of its image is believed, and that a bad one does no harm."""

import itertools
import math
from types import SimpleNamespace

import pytest
import tiny
import torch
from skimage.metrics import structural_similarity

from mipmap_plugin.adaptation.target import detail as detail_module
from mipmap_plugin.adaptation.target.detail import CONTRAST_POWER, DetailLoss
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.structure import similarity
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import wrap_model

VIEW = tiny.cameras(1)[0]
SIZE = (48, 64)


@pytest.fixture
def upsampler():
    """Register a function as the upsampler `mine`."""
    return lambda function: register_upsampler("mine", function, replace=True)


def picture(height, width, seed=0):
    coarse = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(seed))
    return (0.1 + 0.8 * resize(coarse, (height, width), "pil-bicubic")).clamp(0, 1)


def detail(base, **settings):
    return DetailLoss(lambda view: base, 2, AdaptConfig(upsampler="mine", compare_at="both", **settings))


def test_up_to_what_the_base_samples_the_target_is_the_base(upsampler):
    base = picture(24, 32)
    upsampler(lambda image, size: (resize(image, size, "pil-bicubic") + 0.1).clamp(0, 1))
    target, _ = detail(base)._make_target(VIEW)
    assert psnr(resize(target, (24, 32), "pil-bicubic"), base) > 45


def test_finer_detail_is_the_upsamplers(upsampler):
    truth = (picture(*SIZE) + 0.1 * (torch.arange(64) % 2)[None, :, None] - 0.05).clamp(0, 1)
    base = resize(truth, (24, 32), "pil-bicubic")
    upsampler(lambda image, size: truth)
    target, confidence = detail(base)._make_target(VIEW)
    torch.testing.assert_close(target, truth, atol=1e-3, rtol=0)
    assert confidence.min() > 0.99


def test_a_pixel_is_believed_as_far_as_it_agrees_with_the_base(upsampler):
    base = picture(24, 32)
    wrong = torch.zeros(*SIZE, 1)
    wrong[:, 40:] = 0.5
    upsampler(lambda image, size: resize(image, size, "pil-bicubic") - wrong)
    _, confidence = detail(base)._make_target(VIEW)
    assert confidence.shape == (24, 32, 1)
    assert confidence[:, :18].min() > 0.9 and confidence[:, 22:].max() < 0.1


def test_views_that_deny_what_one_claims_outvote_it(upsampler):
    """The gradient of a difference is the same however large it is: the minimum over views is their median."""
    upsampler(lambda image, size: resize(image, size, "pil-bicubic"))
    base = torch.full((24, 32, 3), 0.5)
    loss = detail(base, detail_weight=1.0, detail_structure=0.0)
    near, far = (torch.full((*SIZE, 3), value, requires_grad=True) for value in (0.6, 0.9))
    for image in (near, far):
        loss(VIEW, image).backward()
    torch.testing.assert_close(near.grad, far.grad)


@pytest.mark.parametrize(("structure", "contrast"), [(0.0, 0.0), (0.3, 0.0), (1.0, 0.0), (0.0, 2.0), (0.4, 3.2)])
def test_the_loss_mixes_differences_structure_and_contrast_where_the_target_is_believed(upsampler, structure, contrast):
    upsampler(lambda image, size: (resize(image, size, "pil-bicubic") + 0.2 * (torch.arange(64) > 40)[None, :, None]).clamp(0, 1))
    settings = dict(detail_structure=structure, detail_contrast=contrast, detail_weight=1.0)
    part, image = detail(picture(24, 32), **settings), picture(*SIZE, seed=1)
    target, confidence = part._make_target(VIEW)
    confidence = resize(confidence, SIZE, "bilinear")
    ssim, as_strong = similarity(image, target)
    mixed = (1 - structure) * (image - target).abs() + structure * (1 - ssim) + contrast * confidence**CONTRAST_POWER * (1 - as_strong)
    torch.testing.assert_close(part(VIEW, image), (confidence * mixed).mean(), atol=4e-4, rtol=0)  # kept in half precision
    assert confidence.std() > 0.1


def test_structural_similarity_is_scikit_images_away_from_the_border():
    image, truth = (picture(*SIZE, seed=seed).double() for seed in (1, 2))
    settings = dict(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True)
    expected = torch.from_numpy(structural_similarity(truth.numpy(), image.numpy(), **settings)[1])
    inside = slice(5, -5), slice(5, -5)
    torch.testing.assert_close(similarity(image, truth)[0][inside], expected[inside])


def test_contrasts_are_as_strong_wherever_they_are_and_weaker_where_blurred():
    stripes = 0.5 + 0.3 * torch.sin(torch.arange(64.0))[None, :, None].expand(48, 64, 3).double()
    inside = slice(5, -5), slice(5, -5)
    ssim, moved = similarity(stripes.roll(3, dims=1), stripes)
    _, faded = similarity(0.5 + (stripes - 0.5) / 2, stripes)
    assert ssim[inside].mean() < 0 and moved[inside].mean() > 0.98
    torch.testing.assert_close(faded[inside], torch.full_like(faded[inside], 0.8), atol=0.02, rtol=0)  # 2·(1/2) / (1 + 1/4)


def test_structural_similarity_has_a_gradient_everywhere_also_on_flat_and_dark_images():
    for truth in (torch.zeros(12, 9, 3), torch.full((12, 9, 3), 0.5), picture(12, 9)):
        image = torch.zeros(12, 9, 3, dtype=torch.float64, requires_grad=True)
        sum(part.sum() for part in similarity(image, truth.double())).backward()
        assert image.grad.isfinite().all()
    image = picture(6, 5).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda image: similarity(image, picture(6, 5, seed=3).double()), image)


def test_each_view_is_enlarged_once_and_beforehand(upsampler):
    given = []
    upsampler(lambda image, size: given.append(size) or resize(image, size, "pil-bicubic"))
    part, views = detail(picture(24, 32)), tiny.cameras(3)
    assert part.prepare(views, math.inf) == views
    part(views[0], torch.zeros(*SIZE, 3))
    assert given == [SIZE] * 3


def test_as_many_views_are_enlarged_as_there_is_time_for(upsampler, monkeypatch):
    clock = SimpleNamespace(time=0.0)

    def slow(image, size):
        clock.time += 5.0
        return resize(image, size, "pil-bicubic")

    upsampler(slow)
    monkeypatch.setattr(detail_module, "now", lambda device: clock.time)
    views = tiny.cameras(8)
    for seconds, count in [(0.1, 1), (14.0, 2), (15.0, 3), (math.inf, 8)]:
        enlarged = detail(picture(24, 32)).prepare(views, seconds)
        assert len(enlarged) == count and enlarged == [view for view in views if view in enlarged]


# In an adaptation


def adapted(upsampler_name, **settings):
    model = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    return model.adapt(2, upsampler=upsampler_name, **settings)


def test_a_network_takes_part_by_default_and_a_kernel_does_not():
    assert recipe("default", 2, upsampler="net.pth").compare_at == "both"
    assert recipe("default", 2, upsampler="lanczos") == recipe("default", 2).model_copy(update={"upsampler": "lanczos"})
    assert recipe("default", 1 / 2, upsampler="net.pth").compare_at == "target"
    assert recipe("paper", 2, upsampler="net.pth").compare_at == "target"


def test_the_report_says_what_was_enlarged(upsampler):
    upsampler(lambda image, size: resize(image, size, "lanczos"))
    report = adapted("mine", steps=4, upsampled_views=4).report
    assert report.views == "the 6 train views, 4 of them upsampled"
    assert "and mine fused with it" in report.filters
    assert any("mine adds detail that the base's image does not have" in str(effect) for effect in report.effects)
    assert report.seconds["upsampling"] > 0


@pytest.mark.parametrize(
    ("scale", "settings", "reason"),
    [
        (2, dict(recipe="instant"), "no steps are taken"),
        (2, dict(steps=0), "no steps are taken"),
        (2, dict(compare_at="base", steps=2), "compare_at is base"),
        (1 / 2, dict(steps=2), "x0.5 is no zoom-in"),
    ],
)
def test_a_network_that_is_not_used_is_told(upsampler, scale, settings, reason):
    upsampler(lambda image, size: pytest.fail("it is not used"))
    model = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    with pytest.warns(UserWarning, match=f"the upsampler mine is not used, because {reason}"):
        model.adapt(scale, upsampler="mine", **settings)


def test_an_interpolation_that_is_not_used_is_told():
    """Of lanczos, which --upsampler takes and `list` lists, nothing was said where it changed nothing."""
    model = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    with pytest.warns(UserWarning, match="the upsampler lanczos is not used, because compare_at is base; recipe paper uses it"):
        model.adapt(2, upsampler="lanczos", steps=2)


def test_no_more_views_are_enlarged_than_the_steps_use(upsampler):
    enlarged = []
    upsampler(lambda image, size: enlarged.append(size) or resize(image, size, "lanczos"))
    assert adapted("mine", steps=3).report.views == "the 6 train views, 3 of them upsampled" and len(enlarged) == 3


def test_a_network_leaves_half_of_a_time_budget_to_the_steps(upsampler, monkeypatch):
    """Views were all upsampled whatever the budget: with a second for each of 38, a budget of 6 s took 38, and had no step."""
    asked = []

    def prepare(self, views, seconds):
        asked.append(seconds)
        return views[:2]

    upsampler(lambda image, size: resize(image, size, "lanczos"))
    monkeypatch.setattr(DetailLoss, "prepare", prepare)
    report = adapted("mine", time_budget_s=60.0).report
    assert len(asked) == 1 and 0 < asked[0] < 30 and report.views == "the 6 train views, 2 of them upsampled"
    assert report.settings.steps and report.curve[-1].step > 0


def test_a_run_that_goes_on_enlarges_its_views_again_however_long_its_start_takes(upsampler, monkeypatch, tmp_path):
    """Such as one whose kernels are compiled again: all views were enlarged within steps, whatever the time, and the report said nothing of it."""
    upsampler(lambda image, size: resize(image, size, "lanczos"))
    monkeypatch.setattr(DetailLoss, "prepare", lambda self, views, seconds: views[:2])

    def press(step, seconds, render):
        if step == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adapted("mine", steps=4, time_budget_s=60.0, resume=tmp_path / "state", observe=press)
    clock = itertools.count(step=100)
    monkeypatch.setattr("mipmap_plugin.adaptation.session.now", lambda device: float(next(clock)))
    report = adapted("mine", steps=4, time_budget_s=60.0, resume=tmp_path / "state").report
    assert report.curve[-1].step == 4 and report.views == "the 6 train views, 2 of them upsampled"


@pytest.mark.parametrize("keeps", [False, True])
def test_a_network_grows_splats_up_to_a_limit(upsampler, keeps):
    upsampler(lambda image, size: resize(image, size, "lanczos"))
    eager = dict(recipe="thorough", steps=8, prune_every=2, densify_gradient=1e-12, min_opacity=0.0)
    eager |= dict(densify_keeps_image=keeps, densify_on_trial=False, returns="last")
    before = len(tiny.model())
    assert before < adapted("mine", **eager, most_growth=1.5).report.gaussians_after <= 1.5 * before
    assert adapted("mine", **eager).report.gaussians_after > 1.5 * before


@pytest.mark.parametrize("recipe", ["default", "thorough"])
def test_an_upsampler_that_is_all_noise_does_no_harm(upsampler, recipe):
    """Against the base's own larger render: little below the closed form, whatever the target; noise itself is 30 dB below."""
    upsampler(lambda image, size: torch.rand(*size, 3, generator=torch.Generator().manual_seed(int(image.sum() * 1000))))
    base = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    views = tiny.cameras(2, seed=9, split="test")
    truths = [base.render(view.zoomed(2), 2, "scaled").image for view in views]

    def quality(model):
        return sum(psnr(model.render(view.zoomed(2)).image, truth) for view, truth in zip(views, truths, strict=True)) / len(views)

    assert quality(adapted("mine", recipe=recipe, steps=30)) > quality(base.adapt(2, recipe="instant")) - 2.5
