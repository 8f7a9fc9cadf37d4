"""How boldly a run steps: rates rise until they do harm, and what does harm is taken back."""

import pytest
import tiny
import torch
from equal_models import SCALE, same

from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer, restore_snapshot
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.steering import FIRST_RATE_FACTOR, LOST_DB, LOST_FRACTION, RATE_REDUCTION, Steering
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, TIE_DB
from mipmap_plugin.recipes import recipe


def steering(**more) -> Steering:
    return Steering(30.0, 30.0, Snapshot.of(tiny.model(2)), **more)


def test_boldness_rises_by_the_same_factor_in_each_step_of_the_warm_up():
    config = recipe("default", SCALE, steps=16, warm_up=0.5)
    risen = [steering().rate_factor(step, config) for step in (0, 2, 4, 6, 8, 12, 16)]
    assert risen == pytest.approx([FIRST_RATE_FACTOR, FIRST_RATE_FACTOR**0.75, FIRST_RATE_FACTOR**0.5, FIRST_RATE_FACTOR**0.25, 1, 1, 1])
    assert steering().rate_factor(0, recipe("default", SCALE, warm_up=0)) == 1


def test_boldness_does_not_rise_above_the_ceiling():
    config, capped = recipe("default", SCALE, steps=16, warm_up=0.5), steering(ceiling=0.25)
    assert [capped.rate_factor(step, config) for step in (0, 8, 16)] == pytest.approx([FIRST_RATE_FACTOR, 0.25, 0.25])


def test_harm_is_less_than_the_start_by_more_than_a_choice_of_views_makes():
    assert not steering().is_harmful(30 - HARM_DB + 1e-6)
    assert steering().is_harmful(30 - HARM_DB - 1e-6)


@pytest.mark.parametrize(("gained", "lost"), [(0.0, LOST_DB), (0.5, LOST_DB), (8.0, 8 * LOST_FRACTION)])
def test_while_rates_rise_harm_is_the_loss_of_much_that_was_gained(gained, lost):
    run, student = steering(), tiny.model(2, seed=1)
    run.update_best(30 + gained, 7, student)
    assert not run.is_harmful(30 + gained - lost + 1e-6, rising=True)
    assert run.is_harmful(30 + gained - lost - 1e-6, rising=True)
    assert run.is_harmful(30 + gained - lost - 1e-6) == (gained == 0)  # later only what is worse than the start


def test_what_is_taken_back_goes_on_with_gentler_steps():
    run = steering()
    run.reduce_rates(0.5)
    run.reduce_rates(run.ceiling)
    assert run.ceiling == 0.5 * RATE_REDUCTION**2


@pytest.mark.parametrize(("best_factor", "rising", "ceiling"), [(0.3, True, 0.3), (0.3, False, 0.4), (0.8, True, 0.4)])
def test_while_rates_rise_those_that_led_to_the_best_state_are_the_limit(best_factor, rising, ceiling):
    run = steering()
    run.update_best(31.0, 7, tiny.model(2, seed=1), rate_factor=best_factor)
    run.reduce_rates(0.8, rising=rising)
    assert run.ceiling == ceiling


@pytest.mark.parametrize(("rising", "ceilings"), [(True, [0.05, 0.1, 0.1, 0.2]), (False, [0.05] * 4)])
def test_a_limit_that_was_found_before_anything_was_gained_rises_with_what_is_gained(rising, ceilings):
    run, student, config = steering(), tiny.model(2, seed=1), recipe("default", SCALE, steps=16, warm_up=0.5)
    run.reduce_rates(0.1, rising=rising)
    found = [run.ceiling]
    for step, visible in enumerate((31.0, 30.9, 32.0), 9):
        assert run.is_rising(step, config) == rising
        run.update_best(visible, step, student, rate_factor=run.ceiling)
        found.append(run.ceiling)
    assert found == pytest.approx(ceilings)
    run.reduce_rates(run.ceiling, rising=rising)
    assert not run.is_rising(12, config)  # a limit that was found after a gain stays


@pytest.mark.parametrize(
    ("gained", "progress", "warm_up", "stuck"),
    [(0.0, 0.25, 0.1, True), (0.2, 0.25, 0.1, True), (0.3, 0.25, 0.1, False), (0.0, 0.24, 0.1, False), (0.0, 0.25, 0.0, False)],
)
def test_where_limited_rates_hardly_gained_high_ones_are_tried_and_nothing_is_taken_back(gained, progress, warm_up, stuck):
    run, config = steering(ceiling=0.1), recipe("default", SCALE, steps=16, warm_up=warm_up)
    run.update_best(30 + gained, 4, tiny.model(2, seed=1))
    assert run.is_stuck(progress, config) == stuck and run.is_harmful(10.0)
    run.dare()
    assert run.ceiling == 1.0 and not run.is_harmful(10.0)


def test_what_is_hardly_to_be_seen_may_be_much_of_what_is_left_of_the_error():
    run = Steering(41.5, 41.6, Snapshot.of(tiny.model(2)), ceiling=0.1)  # 50.3 dB without VISIBLE_ERROR, and 51.1
    assert not run.is_stuck(0.25, recipe("default", SCALE, steps=16))


@pytest.mark.parametrize(("ceiling", "gathering"), [(1.0, 0.25), (0.5, 0.0)], ids=["nothing limits", "no new views come"])
def test_rates_that_had_no_time_to_gain_are_steered_on(ceiling, gathering):
    run = steering(ceiling=ceiling)
    assert not run.is_stuck(1.0, recipe("default", SCALE, gathering=gathering))


@pytest.mark.parametrize("rows", [5, 3])
def test_what_is_taken_back_is_held_without_the_momentum_of_what_was_done_since(rows):
    student, other = tiny.model(5).copy(), tiny.model(rows, seed=1)
    optimizer = make_optimizer(student, recipe("default", 4, rates={"opacities": 0.1}), pixel=1.0)
    before, wanted = student.parameters()["opacities"], other.parameters()["opacities"]

    def step(gradient):
        student.parameters()["opacities"].grad = gradient * torch.ones_like(student.parameters()["opacities"])
        optimizer.step()

    for _ in range(3):
        step(-1.0)
    restore_snapshot(student, optimizer, Snapshot.of(other))
    assert same(other, student) and (student.parameters()["opacities"] is before) == (rows == 5)
    step(1.0)
    # The squares of the same rows are known, so that the step is that of the fourth of four equal gradients, three of them forgotten.
    share = (1 - optimizer.betas[0]) / (1 - optimizer.betas[0] ** 4) if rows == 5 else 1.0
    torch.testing.assert_close(student.parameters()["opacities"].detach(), wanted - 0.1 * share)


@pytest.mark.parametrize(("psnr", "best_db", "step"), [(31.0, 31.0, 7), (30 - TIE_DB / 2, 30.0, 7), (30 - 2 * TIE_DB, 30.0, 0)])
def test_a_state_is_kept_unless_it_is_worse(psnr, best_db, step):
    run, student = steering(), tiny.model(2, seed=1)
    run.update_best(psnr, 7, student)
    assert (run.best_db, run.best_step) == (best_db, step)
    assert torch.equal(run.best.rows["means"], student.parameters()["means"]) == (step == 7)
