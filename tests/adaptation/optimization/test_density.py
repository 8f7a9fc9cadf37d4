"""Density control: rows, moments and statistics stay together, and an empty model never comes about."""

import math

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.adam import ROWS, Adam
from mipmap_plugin.adaptation.optimization.density import HALF_APART, SPLIT_SHRINK, clone_and_split, halve, prune, reset_opacities
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer, restore_parameters, set_rates
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.bands import lie_in_one_tensor
from mipmap_plugin.splatting.rotations import rotations

COUNT = 6


@pytest.fixture
def student():
    return tiny.model(COUNT).copy()


@pytest.fixture
def optimizer(student):
    """Adam whose moments tell which row they belong to: row i holds i + 1 everywhere."""
    adam = make_optimizer(student, AdaptConfig(), pixel=1.0)
    for tensor in student.parameters().values():
        tensor.grad = torch.zeros_like(tensor)
    adam.step()
    adam.zero_grad()
    for tensor in student.parameters().values():
        for moment in ("exp_avg", "exp_avg_sq"):
            adam.state[tensor][moment] += torch.arange(1.0, COUNT + 1).view(-1, *[1] * (tensor.dim() - 1))
    return adam


def moments(student, optimizer) -> list[float]:
    """The row numbers that the moments tell, after checking that all parameters tell the same ones."""
    told = set()
    for name, tensor in student.parameters().items():
        for moment in ("exp_avg", "exp_avg_sq"):
            held = optimizer.state[tensor][moment]
            assert held.shape == tensor.shape, name
            told.add(tuple(held.flatten(1)[:, 0].tolist() if held.dim() > 1 else held.tolist()))
    assert len(told) == 1
    return list(told.pop())


def mask(*rows: int) -> torch.Tensor:
    return torch.zeros(COUNT, dtype=torch.bool).index_fill(0, torch.tensor(rows, dtype=torch.long), True)


def grow(student, optimizer, grown, extent):
    clone_and_split(student, optimizer, grown, extent, student.gaussians().detach(), torch.Generator().manual_seed(0))


# Pruning


def test_pruning_keeps_rows_and_their_moments(student, optimizer):
    means = student.parameters()["means"].detach().clone()
    prune(student, optimizer, mask(1, 4))
    assert torch.equal(student.parameters()["means"], means[[1, 4]])
    assert moments(student, optimizer) == [2, 5]


def test_what_is_kept_moves_up_in_its_own_memory(student, optimizer, monkeypatch):
    """In pieces of two rows, of which none is written to before it is read; sh0 and shN stay in one tensor."""
    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.density.ROWS_MOVED", 2)
    before = {name: (tensor.detach().clone(), tensor.data_ptr()) for name, tensor in student.parameters().items()}
    kept = [row for row in range(COUNT) if row != 1]
    prune(student, optimizer, mask(*kept))
    for name, tensor in student.parameters().items():
        assert torch.equal(tensor, before[name][0][kept]) and tensor.data_ptr() == before[name][1]
    assert lie_in_one_tensor(student.parameters())


def test_the_optimizer_moves_the_models_own_leaves_after_pruning(student, optimizer):
    prune(student, optimizer, mask(0, 2))
    before = {name: tensor.detach().clone() for name, tensor in student.parameters().items()}
    student.gaussians().sh.sum().backward()
    optimizer.step()
    assert not torch.equal(student.parameters()["sh0"], before["sh0"])
    assert all(tensor.is_leaf and tensor.requires_grad for tensor in student.parameters().values())


def test_pruning_nothing_leaves_the_leaves_as_they_are(student, optimizer):
    before = student.parameters()["means"]
    prune(student, optimizer, torch.ones(COUNT, dtype=torch.bool))
    assert student.parameters()["means"] is before


def test_pruning_everything_keeps_one(student, optimizer):
    prune(student, optimizer, mask())
    assert len(student) == 1 and moments(student, optimizer) == [1]


# Densifying


def test_small_splats_are_cloned(student, optimizer):
    before = student.gaussians().detach()
    grow(student, optimizer, mask(1, 3), extent=1e6)
    after = student.gaussians()
    assert len(student) == COUNT + 2
    torch.testing.assert_close(after.means, before.means[[0, 1, 2, 3, 4, 5, 1, 3]])
    torch.testing.assert_close(after.scales, before.scales[[0, 1, 2, 3, 4, 5, 1, 3]])
    assert moments(student, optimizer) == [1, 2, 3, 4, 5, 6, 0, 0]


def test_large_splats_are_split_into_two_smaller_ones(student, optimizer):
    before = student.gaussians().detach()
    grow(student, optimizer, mask(1, 3), extent=1e-6)
    after, halves = student.gaussians(), [1, 3, 1, 3]
    assert len(student) == COUNT + 2
    torch.testing.assert_close(after.means[:4], before.means[[0, 2, 4, 5]])
    torch.testing.assert_close(after.scales[4:], before.scales[halves] / SPLIT_SHRINK)
    torch.testing.assert_close(after.opacities[4:], before.opacities[halves])
    assert moments(student, optimizer) == [1, 3, 5, 6, 0, 0, 0, 0]
    moved = (after.means[4:] - before.means[halves]).norm(dim=1)
    assert (moved > 0).all() and (moved < 4 * before.scales[halves].max(dim=1).values).all()


def test_the_halves_of_a_flat_splat_stay_in_its_plane():
    """They are drawn from the splat itself: a pancake turned a quarter about x is flat along world y."""
    turned, scales = torch.tensor([[math.sqrt(0.5), math.sqrt(0.5), 0, 0]]), torch.tensor([[1.0, 1.0, 1e-9]])
    flat = Gaussians(torch.zeros(1, 3), turned, scales, torch.ones(1) / 2, torch.ones(1, 1, 3))
    student = type(tiny.model(1)).from_gaussians(flat).copy()
    grow(student, make_optimizer(student, AdaptConfig(), 1.0), torch.tensor([True]), extent=1e-6)
    means = student.gaussians().means.detach()
    assert (means[:, 1].abs() < 1e-6).all() and (means[:, [0, 2]].abs() > 1e-3).all()


def test_what_is_put_back_is_as_it_was_bit_by_bit_and_starts_anew(student, optimizer):
    before = {name: tensor.detach().clone() for name, tensor in student.parameters().items()}
    grow(student, optimizer, mask(1, 3), extent=1e6)
    restore_parameters(student, optimizer, before)
    assert all(torch.equal(tensor, before[name]) for name, tensor in student.parameters().items())
    optimizer.param_groups[0]["lr"] = 0.1
    for tensor in student.parameters().values():
        tensor.grad = torch.ones_like(tensor)
    optimizer.step()
    name = optimizer.param_groups[0]["name"]
    torch.testing.assert_close(student.parameters()[name].detach(), before[name] - 0.1)  # the first step of Adam is its rate


def test_large_and_small_together(student, optimizer):
    largest = student.gaussians().scales.detach().max(dim=1).values
    grow(student, optimizer, torch.ones(COUNT, dtype=torch.bool), extent=100 * float(largest.median()))
    split = int((largest > largest.median()).sum())
    assert 0 < split < COUNT and len(student) == 2 * COUNT
    assert moments(student, optimizer).count(0) == COUNT + split


def test_densifying_nothing_keeps_every_row(student, optimizer):
    before = student.gaussians().detach()
    grow(student, optimizer, mask(), extent=1.0)
    assert torch.equal(student.gaussians().means, before.means)
    assert moments(student, optimizer) == [1, 2, 3, 4, 5, 6]


def test_halves_lie_on_either_side_along_the_longest_axis(student, optimizer):
    before = student.gaussians().detach()
    halve(student, optimizer, mask(1, 3), before)
    after, parents = student.gaussians().detach(), [1, 3, 1, 3]
    torch.testing.assert_close(after.means[:4], before.means[[0, 2, 4, 5]])
    longest = [rotations(before.quats)[row, :, before.scales[row].argmax()] * before.scales[row].max() for row in parents]
    sides = torch.tensor([-HALF_APART, -HALF_APART, HALF_APART, HALF_APART])[:, None]
    torch.testing.assert_close(after.means[4:], before.means[parents] + sides * torch.stack(longest))
    assert (after.scales[4:] < before.scales[parents]).all() and (after.opacities[4:] < before.opacities[parents]).all()
    assert moments(student, optimizer) == [1, 3, 5, 6, 0, 0, 0, 0]


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("axis", [0, 2])  # across the view, along it
def test_halves_show_almost_what_the_splat_did(opacity, axis):
    """Clones are brighter by far."""
    scales = torch.full((1, 3), 0.1).index_fill(1, torch.tensor(axis), 0.3)
    splat = Gaussians(torch.tensor([[0.0, 0, 4]]), torch.tensor([[1.0, 0, 0, 0]]), scales, torch.tensor([opacity]), torch.ones(1, 1, 3))
    camera = Camera(viewmat=torch.eye(4), fx=200.0, fy=200.0, cx=32.0, cy=32.0, width=64, height=64)

    def shown(gaussians) -> torch.Tensor:
        return ReferenceBackend().render(gaussians.detach(), camera, Effects()).alpha

    def changed(how) -> torch.Tensor:
        student = type(tiny.model(1)).from_gaussians(splat).copy()
        how(student, make_optimizer(student, AdaptConfig(), 1.0))
        return (shown(student.gaussians()) - shown(splat)) / shown(splat).norm()

    one = torch.tensor([True])
    halved = changed(lambda student, optimizer: halve(student, optimizer, one, splat))
    cloned = changed(lambda student, optimizer: grow(student, optimizer, one, extent=1e6))
    assert halved.norm() < 0.09 and cloned.norm() > 2 * halved.norm()


# Resetting


def test_a_reset_cuts_opacities_and_forgets_only_their_moments(student, optimizer):
    with torch.no_grad():
        student.parameters()["opacities"][0] = -9.0  # already fainter
    reset_opacities(optimizer)
    opacities = student.row_opacities()
    assert opacities[0] < 0.001
    torch.testing.assert_close(opacities[1:], torch.full((COUNT - 1,), 0.01))
    state = optimizer.state[student.parameters()["opacities"]]
    assert not state["exp_avg"].any() and not state["exp_avg_sq"].any() and state["step"] == 1
    assert optimizer.state[student.parameters()["means"]]["exp_avg"][3, 0] == 4


# Rates


def test_rates_fall_to_their_share_and_the_means_are_in_pixels(student):
    config = AdaptConfig(steps=10, decay=0.01, rates=LearningRates(means=0.1, sh0=0.5, quats=0))
    adam = make_optimizer(student, config, pixel=3.0)
    rate = lambda name: next(group["lr"] for group in adam.param_groups if group["name"] == name)  # noqa: E731
    assert (rate("means"), rate("sh0"), rate("quats")) == (pytest.approx(0.3), 0.5, 0)
    set_rates(adam, config, 50, 0.5, 1.0)
    assert (rate("means"), rate("sh0")) == (pytest.approx(0.3 * 0.505), pytest.approx(0.5 * 0.505))
    set_rates(adam, config, 100, 1.0, 1.0)
    assert rate("sh0") == pytest.approx(0.005)


def test_every_rate_is_as_bold_as_the_run_may_be(student):
    config = AdaptConfig(steps=16, rates=LearningRates(sh0=0.5, shN=0.2))
    adam = make_optimizer(student, config, pixel=1.0)
    set_rates(adam, config, 0, 0.0, 0.25)
    rates = {group["name"]: group["lr"] for group in adam.param_groups}
    assert (rates["sh0"], rates["shN"], rates["scales"]) == pytest.approx((0.125, 0.05, config.rates.scales / 4))


@pytest.mark.parametrize(("warm_up", "step", "share"), [(0.1, 0, 0.25), (0.1, 8, 0.625), (0.1, 16, 1), (0.1, 90, 1), (0, 0, 1)])
def test_the_rate_of_sh_bands_rises_in_the_first_steps_of_a_run_with_a_warm_up(student, warm_up, step, share):
    config = AdaptConfig(steps=100, decay=1.0, warm_up=warm_up, rates=LearningRates(sh0=0.5, shN=0.2))
    adam = make_optimizer(student, config, pixel=1.0)
    set_rates(adam, config, step, 0.0, 1.0)
    rates = {group["name"]: group["lr"] for group in adam.param_groups}
    assert (rates["sh0"], rates["shN"]) == pytest.approx((0.5, 0.2 * share))


def test_a_step_is_that_of_torchs_adam_bit_by_bit():
    torch.manual_seed(0)
    ours, theirs = ([start.clone().requires_grad_() for start in torch.linspace(-1, 1, 12).view(2, 2, 3)] for _ in range(2))
    groups = [[dict(params=[tensor], lr=rate) for tensor, rate in zip(tensors, (0.1, 0.01), strict=True)] for tensors in (ours, theirs)]
    adams = Adam(groups[0], (0.8, 0.99), 1e-15), torch.optim.Adam(groups[1], betas=(0.8, 0.99), eps=1e-15, fused=True)
    for _ in range(5):
        for tensors, adam in zip((ours, theirs), adams, strict=True):
            torch.stack(tensors).sin().square().sum().backward()
            adam.step()
            adam.zero_grad()
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_a_step_with_nesterovs_momentum_counts_the_newest_gradient_once_more():
    ours, theirs = torch.linspace(-1, 1, 6).double().requires_grad_(), torch.linspace(-1, 1, 6).double()
    adam, first, second = Adam([dict(params=[ours], lr=0.1)], (0.8, 0.99), 1e-15, nesterov=True), torch.zeros(6), torch.zeros(6)
    for count in range(1, 5):
        ours.sin().square().sum().backward()
        gradient = (2 * theirs).sin()
        first, second = 0.8 * first + 0.2 * gradient, 0.99 * second + 0.01 * gradient**2
        ahead = 0.8 * first + 0.2 * gradient
        theirs = theirs - 0.1 * ahead / (1 - 0.8**count) / ((second / (1 - 0.99**count)).sqrt() + 1e-15)
        adam.step()
        adam.zero_grad()
    torch.testing.assert_close(ours.detach(), theirs, rtol=1e-6, atol=1e-7)  # torch counts steps in float32


def test_a_step_of_a_part_of_a_tensor_is_that_of_the_same_numbers_alone():
    generator = torch.Generator().manual_seed(0)
    start, weights = (torch.randn(2 * ROWS + 5, 16, 3, generator=generator) for _ in range(2))
    alone, part = start[:, 1:].clone().requires_grad_(), start.clone()[:, 1:].requires_grad_()
    for tensor in (alone, part):
        adam = Adam([dict(params=[tensor], lr=0.1)], (0.8, 0.99), 1e-15, nesterov=True)
        for _ in range(3):
            (tensor.sin() * weights[:, 1:]).sum().backward()
            adam.step()
            adam.zero_grad()
    assert alone.is_contiguous() and not part.is_contiguous() and torch.equal(alone, part)
