"""Large splats that a viewer leaves out, in parts."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.start import splitting
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.splitting import in_parts, thirds
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.wrap import wrap_model

CLASSIC = Effects(0)
WEB = replace(CLASSIC, settings=RenderSettings(radius=8**0.5, frame=1.2))
VIEWS = [Camera(32, 24, 40.0, 40.0, 16.0 + shift, 12.0, torch.eye(4), f"view {shift}") for shift in (-2.0, -1.0, 0.0, 1.0, 2.0)]


def splats_at(x: float, size: float, opacity: float = 0.8) -> Gaussians:
    """A splat `x` to the right of the axis and `size` long in x, before 50 small ones; world units, of which 10 px have one."""
    small = torch.tensor([[0.02 * number - 0.5, 0.0, 5.0] for number in range(50)])
    means = torch.cat([torch.tensor([[x, 0.0, 4.0]]), small])
    scales = torch.cat([torch.tensor([[size, 0.3, 0.3]]), torch.full((50, 3), 0.03)])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(51, 4)
    return Gaussians(means, quats, scales, torch.full((51,), opacity), torch.ones(51, 1, 3))


def problem_of(splats: Gaussians, target: Effects = WEB, **settings) -> StartProblem:
    backend, model = ReferenceBackend(), VanillaModel.from_gaussians(splats, TrainedScale())

    def drawn_by(student):
        return (model, CLASSIC), (student, target)

    def quality(student) -> Quality:
        truths, images = ([backend.render(each.gaussians().detach(), view, how).image for view in VIEWS] for each, how in drawn_by(student))
        psnr = sum(-10 * float((truth - image).square().mean().log10()) for truth, image in zip(truths, images, strict=True)) / len(VIEWS)
        return Quality(psnr, psnr)

    phase = lambda _: nullcontext()  # noqa: E731
    return StartProblem(model.copy, VIEWS, VIEWS, 1.0, CLASSIC, target, AdaptConfig(**settings), backend, True, quality, phase)


def count_of(problem: StartProblem) -> int:
    return len(problem.base().parameters()["means"])


def opacity_along(splats: Gaussians, x: torch.Tensor) -> torch.Tensor:
    """What all splats together cover of places on the x axis, [X]."""
    away = (x[:, None] - splats.means[:, 0]) / splats.scales[:, 0]
    return 1 - (1 - splats.opacities * torch.exp(-away.square() / 2)).prod(1)


@pytest.mark.parametrize(("opacity", "close"), [(0.1, 0.005), (0.4, 0.02), (0.9, 0.05), (1.0, 0.06)])
def test_the_parts_of_a_splat_cover_together_what_it_covers(opacity, close):
    whole = splats_at(0.0, 2.0, opacity)[:1]
    parts, x = thirds(whole), torch.linspace(-6, 6, 101)
    torch.testing.assert_close(opacity_along(parts, x), opacity_along(whole, x), atol=close, rtol=0)


def test_parts_lie_along_the_longest_axis_wherever_it_points():
    turned = replace(splats_at(0.0, 2.0)[:1], quats=torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]))  # x becomes y
    parts = thirds(turned)
    torch.testing.assert_close(parts.means - turned.means, torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.8, 0.0], [0.0, -1.8, 0.0]]))
    torch.testing.assert_close(parts.scales, torch.tensor([[1.2, 0.3, 0.3]]).expand(3, 3))


def test_a_splat_beside_the_picture_comes_in_parts_which_the_viewer_draws():
    problem = problem_of(splats_at(2.5, 2.0))
    split = in_parts(problem)
    assert count_of(split) > count_of(problem)
    before, after = (problem.quality(each.base()).psnr for each in (problem, split))
    assert after > before + 3


@pytest.mark.parametrize(
    ("splats", "target", "settings"),
    [
        (splats_at(2.5, 2.0), CLASSIC, {}),  # is left out nowhere
        (splats_at(0.5, 0.3), WEB, {}),  # lies in the pictures
        (splats_at(2.5, 2.0), WEB, {"time_budget_s": 1e-6}),
        (splats_at(2.5, 2.0), WEB, {"closed_form": False}),
    ],
)
def test_nothing_is_split_where_nothing_is_left_out_or_it_is_not_asked_for(splats, target, settings):
    problem = problem_of(splats, target, **settings)
    assert in_parts(problem) is problem


def test_nothing_is_split_where_blend_weights_cannot_be_measured(monkeypatch):
    problem = problem_of(splats_at(2.5, 2.0))
    monkeypatch.setattr(splitting, "weighed", None)
    without = replace(problem, has_blend_weights=False)
    assert in_parts(without) is without
    monkeypatch.setattr(problem.backend, "lacking", lambda needs: ["no frame"] if needs.settings.frame < 2 else [], raising=False)
    assert in_parts(problem) is problem


def test_lengths_that_a_viewer_shortens_are_in_pixels_of_its_own_picture():
    target = replace(CLASSIC, settings=RenderSettings(radius=3.0, max_half_axis=8.0, fits_picture=True))
    whole, cut = splitting._cuts(replace(problem_of(splats_at(0.0, 2.0), target), scale=1 / 4))
    assert whole.settings == RenderSettings(radius=3.0) and cut.settings == replace(target.settings, max_half_axis=32.0)


def test_what_a_splat_loses_is_told_in_parts_of_a_picture(monkeypatch):
    """All of its 768 pixels at most, which is more than nothing is worth."""
    monkeypatch.setattr(splitting, "LEAST_LOST", 1.0)
    problem = problem_of(splats_at(2.5, 2.0))
    assert in_parts(problem) is problem


@pytest.mark.parametrize(("opacity", "splits"), [(0.03, True), (0.02, False)])
def test_what_hardly_shows_stays_whole(opacity, splits):
    """Of 4 and 2.4 thousandths of a picture, the first is more than ENOUGH."""
    whole = splats_at(2.5, 2.0)
    whole.opacities[0] = opacity
    problem = problem_of(whole)
    assert (in_parts(problem) is not problem) == splits


def test_a_splat_stays_whole_where_that_looks_no_worse():
    problem = replace(problem_of(splats_at(2.5, 2.0)), quality=lambda _: Quality(30.0, 30.0))
    assert in_parts(problem) is problem


def test_there_are_at_most_so_many_parts(monkeypatch):
    monkeypatch.setattr(splitting, "LEAST_LOST", -1.0)  # each splat loses enough
    monkeypatch.setattr(splitting, "MOST", 1.05)
    assert count_of(in_parts(problem_of(splats_at(2.5, 2.0)))) <= 1.05 * 51


def test_as_many_splats_as_are_allowed_are_not_exceeded():
    assert count_of(in_parts(problem_of(splats_at(2.5, 2.0), most_splats=53))) == 53


def test_a_file_for_a_viewer_begins_with_what_it_would_leave_out_in_parts():
    model = VanillaModel.from_gaussians(splats_at(2.5, 2.0), TrainedScale())
    adapted = wrap_model(model, cameras=VIEWS, backend="reference").adapt(1, viewer="cesium", steps=0, closed_form=True, merge_to=1.0)
    as_it_is, start = adapted.report.validation.values()
    assert adapted.report.gaussians_after > 51 and start > as_it_is + 10
