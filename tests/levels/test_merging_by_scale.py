"""Splats merged by scale, and the mixtures that they become."""

from dataclasses import replace

import pytest
import tiny
import torch
from levels_by_distance import from_x, with_background

from mipmap_plugin.adaptation.views.pixel_size import pixel_size
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.chunks import Chunks
from mipmap_plugin.levels.distance.coarsening import coarsened, kept_splats, shaped
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.rule import DistanceRule

pytestmark = pytest.mark.usefixtures("few_views")


# Merging by scale


def test_only_splats_smaller_than_the_level_are_merged():
    splats, size = with_background(), 0.1
    pixels = pixel_size(splats.means, tiny.cameras(6))
    far = pixels >= size
    assert 0 < far.sum() < len(splats)
    target = Effects(screen_filter="classic", eps2d=0.3, sh_degree=0)
    made, fixed = coarsened(splats, lambda means: pixel_size(means, tiny.cameras(6)), (0.0, size), torch.ones(len(splats)), 100, target)
    assert fixed == far.sum()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(made, name)[:fixed], getattr(splats, name)[far])
    assert 100 <= len(made) - fixed < (~far).sum()


def test_nothing_is_merged_for_pixels_smaller_than_those_of_training():
    splats = tiny.gaussians(40)
    made, fixed = coarsened(splats, lambda means: torch.ones(len(means)), (0.0, 0.5), torch.ones(40), 10, Effects(0))
    assert fixed == len(made) == 40 and torch.equal(made.means, splats.means)


def test_fewer_are_kept_of_what_is_coarser():
    pixels = torch.tensor([0.01, 0.02, 0.04, 10.0])
    assert kept_splats(pixels.repeat(1000), 0.1, 2.0) < kept_splats(pixels.repeat(1000), 0.05, 2.0)
    assert kept_splats(pixels, 0.001, 2.0) == 0


def test_the_world_form_takes_off_what_the_larger_pixel_adds():
    """With the dilation of its pixel, a splat that is wide enough covers what it did before; a narrow one loses opacity instead."""
    ones = torch.ones(2, 3)
    scales, round_ones = torch.stack([ones[0], 0.01 * ones[0]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
    splats = Gaussians(torch.zeros(2, 3), round_ones, scales, torch.full((2,), 0.5), ones[:, None])
    target = Effects(0, "classic", 0.3)
    scales, opacities = shaped(splats, torch.tensor([0.5, 0.5]), 1.0, target)
    assert torch.allclose(scales[0].square() + 0.3, 1 + 0.3 * 0.25 * ones[0]) and opacities[0] == pytest.approx(0.5)
    assert opacities[1] < 0.2 and scales[1].max() <= 0.011
    same, as_before = shaped(splats, torch.tensor([0.5, 0.5]), 1.0, replace(target, screen_filter="mip"))
    assert same is splats.scales and as_before is splats.opacities


# Mixtures


def mixture():
    """Two chunks beside each other, and three levels that can be told apart by their opacity."""
    splats = tiny.gaussians(40, degree=0)
    left = torch.arange(40) < 20
    splats = replace(splats, means=torch.where(left, 0.0, 10.0)[:, None] + 0.1 * splats.means, scales=0.01 * splats.scales)
    chunks = Chunks.of(splats, extent=2.0, least=1)
    levels = [replace(splats, opacities=torch.full((40,), 0.1 * (number + 1))) for number in range(3)]
    return Mixture.of(DistanceRule(0.05, 2.0, 3), chunks, levels), chunks


def test_a_mixture_has_each_chunk_at_the_level_of_its_distance():
    """From x = -2 the near chunk is 2 away, a pixel of 0.02: level 0; the far one 12, 0.12: level 2."""
    mixed, chunks = mixture()
    splats = mixed.splats(from_x(-2.0))
    near = splats.means[:, 0] < 5
    assert len(chunks) == 2 and len(splats) == 40
    assert torch.allclose(splats.opacities[near], torch.tensor(0.1)) and torch.allclose(splats.opacities[~near], torch.tensor(0.3))
    assert torch.allclose(mixed.splats(from_x(-200.0)).opacities, torch.tensor(0.3))


def test_only_the_level_itself_has_a_gradient_and_only_where_it_is_shown():
    mixed, _ = mixture()
    opacities = torch.full((40,), 0.9, requires_grad=True)
    student = replace(mixed.levels[2], opacities=opacities)
    drawn = mixed.with_student(2, student, from_x(-2.0), fixed=25)
    assert len(drawn) == 40
    drawn.opacities.sum().backward()
    far, moves = student.means[:, 0] > 5, torch.arange(40) >= 25
    assert torch.equal(opacities.grad, (far & moves).float())
