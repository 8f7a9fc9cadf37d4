"""Every backend on every hard case, and the suite itself on backends that are wrong on purpose."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import torch

from mipmap_plugin.backends import get_backend, reference, register_backend
from mipmap_plugin.backends.base import Capabilities, Rendered
from mipmap_plugin.backends.conformance import CASES, MORE, TOLERANCE, Outcome, check_backend, summary
from mipmap_plugin.backends.conformance.cases import random_scene
from mipmap_plugin.backends.conformance.checks import check_steps, check_views
from mipmap_plugin.backends.conformance.suite import BackendSuite
from mipmap_plugin.backends.conformance.tolerance import PIXEL_BAND, differing_gradients, differing_images
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation import backends as tables
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import unit_quaternions

CPU = "mipmap_plugin.backends.cpu"
MISSING = next((name for name in ("numba", CPU) if importlib.util.find_spec(name) is None), None)
SINGLE = TOLERANCE[torch.float32]


def test_the_reference_in_float32_is_that_in_float64():
    assert [outcome.message for outcome in check_backend(ReferenceBackend(), CASES) if not outcome.passed] == []


@pytest.mark.skipif(MISSING is not None, reason=f"{MISSING} is not there")
class TestCpu(BackendSuite):
    if MISSING is None:
        backend = importlib.import_module(CPU).CpuBackend()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reference", "cpu"])
def test_random_scenes_and_telescopes_equal_the_reference(name):
    if name == "cpu" and MISSING is not None:
        pytest.skip(f"{MISSING} is not there")
    assert [outcome.message for outcome in check_backend(get_backend(name), MORE) if not outcome.passed] == []


class LongGradients(ReferenceBackend):
    """Right images, gradients 1 % too long: too little for a bound on each entry alone if that had to allow for cut-offs."""

    def render(self, gaussians, camera, effects):
        rendered = super().render(gaussians, camera, effects)
        return Rendered(*(1.01 * part - 0.01 * part.detach() for part in (rendered.image, rendered.alpha)))


class BackToFront(ReferenceBackend):
    def render(self, gaussians, camera, effects):
        right = reference.drawn_rows
        with mock.patch.object(reference, "drawn_rows", lambda *scene: right(*scene).flip(0)):
            return super().render(gaussians, camera, effects)


class SpreadsNan(ReferenceBackend):
    """One broken splat blackens the image, as it does in rasterizers that multiply before they test."""

    def render(self, gaussians, camera, effects):
        rendered = super().render(gaussians, camera, effects)
        return rendered.replaced(image=rendered.image + 0 * gaussians.opacities.sum())


class Raises(ReferenceBackend):
    def render(self, gaussians, camera, effects):
        if len(gaussians) == 0:
            raise IndexError("no splats")
        return super().render(gaussians, camera, effects)


class WithoutGradients(ReferenceBackend):
    capabilities = Capabilities(None, frozenset({torch.float32}), frozenset({"classic"}), gradients=False)

    def render(self, gaussians, camera, effects):
        with torch.no_grad():
            return super().render(gaussians, camera, effects)


FEW = {name: CASES[name] for name in ("no-splat", "one-splat", "sh-degree-1", "nan-in-opacities-classic", "random-1-antialiased-0.3")}


def failed(backend):
    return {outcome.case: outcome.message for outcome in check_backend(backend, FEW) if not outcome.passed}


class ForgetsAView(ReferenceBackend):
    """Draws all views, and differentiates the first of them alone."""

    def render_views(self, gaussians, shots):
        drawn = [self.render(gaussians, *shot) for shot in shots]
        return [drawn[0], *(Rendered(each.image.detach(), each.alpha.detach()) for each in drawn[1:])]


def test_a_view_without_gradient_in_one_call_is_caught():
    outcome = check_views(ForgetsAView(), CASES["sh-degree-3"])
    assert not outcome.passed and "gradient of means" in outcome.message


class ForgetsTheOpacity:
    """Takes the gradients of opacities for those of their logits."""

    def __init__(self, raw):
        self._raw = {name: tensor.requires_grad_() for name, tensor in raw.items()}

    def render(self, number, camera, effects):
        raw = self._raw
        self._opacities = raw["opacities"].detach().sigmoid().requires_grad_()
        splats = Gaussians(raw["means"], unit_quaternions(raw["quats"]), raw["scales"].exp(), self._opacities, raw["sh"])
        self._drawn = ReferenceBackend().render(splats, camera, effects)
        return Rendered(self._drawn.image.detach(), self._drawn.alpha.detach())

    def differentiate(self, number, d_image, d_alpha):
        torch.autograd.backward([self._drawn.image, self._drawn.alpha], [d_image, d_alpha])

    def step(self, step):
        for name, moment in step.first.items():
            moment.copy_((1 - step.betas[0]) * (self._opacities if name == "opacities" else self._raw[name]).grad)
        step.means_gradient.copy_(self._raw["means"].grad)


class TellsNoGradient(ForgetsTheOpacity):
    def step(self, step):
        super().step(replace(step, means_gradient=step.means_gradient.clone()))


def of_steps(stepper) -> str:
    backend = ReferenceBackend()
    backend.stepper = stepper
    return check_steps(backend, CASES["sh-degree-3"]).message


def test_a_step_along_wrong_gradients_is_caught():
    message = of_steps(ForgetsTheOpacity)
    assert message.startswith("gradient of opacities") and "means" not in message


def test_a_step_that_does_not_tell_the_gradient_that_splats_grow_by_is_caught():
    assert of_steps(TellsNoGradient).startswith("gradient of means, by which splats grow: ")


def test_gradients_one_percent_too_long_are_caught():
    wrong = failed(LongGradients())
    assert set(wrong) == set(FEW) - {"no-splat"}
    assert all("gradient of means" in message and "image" not in message for message in wrong.values())


def test_the_wrong_order_is_caught():
    wrong = failed(BackToFront())
    assert set(wrong) == {"sh-degree-1", "nan-in-opacities-classic", "random-1-antialiased-0.3"}
    assert "image, pixels:" in wrong["sh-degree-1"]


def test_nan_in_one_case_is_caught():
    outcomes = {outcome.case: outcome for outcome in check_backend(SpreadsNan(), FEW)}
    assert [name for name, outcome in outcomes.items() if not outcome.passed] == ["nan-in-opacities-classic"]
    assert not outcomes["nan-in-opacities-classic"].finite
    assert "image: 1296 of 1296 values are not finite" in outcomes["nan-in-opacities-classic"].message


def test_an_exception_fails_its_case_only():
    assert failed(Raises()) == {"no-splat": "IndexError: no splats"}


def test_what_a_backend_lacks_is_skipped_with_its_reason():
    outcomes = {outcome.case: outcome for outcome in check_backend(WithoutGradients(), FEW)}
    skipped = [outcome.case for outcome in outcomes.values() if outcome.skipped]
    assert skipped == ["random-1-antialiased-0.3"]
    assert "screen filters classic, not antialiased" in outcomes[skipped[0]].message
    assert all(outcome.passed for outcome in outcomes.values())


class OfDegree0(ReferenceBackend):
    """Constant colors, classic, no gradients."""

    capabilities = Capabilities(None, frozenset({torch.float32}), frozenset({"classic"}), gradients=False, max_sh_degree=0)

    def render(self, gaussians, camera, effects):
        assert effects.sh_degree == 0
        with torch.no_grad():
            return super().render(gaussians, camera, effects)


BANDS = ("sh-degree-0", "sh-degree-1", "sh-degree-3")


class IgnoresTheNearPlane(OfDegree0):
    def render(self, gaussians, camera, effects):
        return super().render(gaussians, camera, replace(effects, near_plane=0.0))


def test_a_backend_of_degree_0_is_run_and_its_faults_are_found():
    of_its_own = [name for name in CASES if name.endswith("-classic") and name != "covariances-classic"]
    outcomes = {outcome.case: outcome for outcome in check_backend(OfDegree0(), {name: CASES[name] for name in [*of_its_own, *BANDS]})}
    assert all(outcome.passed for outcome in outcomes.values())
    assert len(of_its_own) > 40 and not any(outcomes[name].skipped for name in of_its_own)
    assert outcomes["sh-degree-1"].skipped and not outcomes["sh-degree-0"].skipped
    type("Suite", (BackendSuite,), {"backend": OfDegree0()})().test_leaves_its_input_as_it_is()
    near = {name: build for name, build in CASES.items() if "near-plane-classic" in name}
    assert {each.case for each in check_backend(IgnoresTheNearPlane(), near) if not each.passed} == {
        "on-the-near-plane-classic", "just-behind-the-near-plane-classic",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("part", "value", "said"), [("speed", "fast", "speed: a number is needed, got 'fast'"), ("api_version", 0, "it is written for 0")]
)
def test_the_suite_says_what_a_backend_declares_wrong(part, value, said):
    declared = type("Odd", (ReferenceBackend,), {part: value})()
    with pytest.raises(AssertionError, match=said):
        type("Suite", (BackendSuite,), {"backend": declared})().test_declares_itself()
    type("Suite", (BackendSuite,), {"backend": type("Odd", (ReferenceBackend,), {"speed": 0.5})()})().test_declares_itself()


def test_what_a_backend_does_not_have_is_skipped():
    suite = type("Suite", (BackendSuite,), {"backend": ReferenceBackend()})()
    for check in (suite.test_views_in_one_call_are_those_drawn_alone, suite.test_steps_follow_the_gradients):
        with pytest.raises(pytest.skip.Exception):
            check()


class OfDoubles(OfDegree0):
    capabilities = replace(OfDegree0.capabilities, dtypes=frozenset({torch.float64}))


def test_a_suite_in_which_all_is_skipped_does_not_pass():
    suite = type("Suite", (BackendSuite,), {"backend": OfDoubles()})
    with pytest.raises(AssertionError, match=r"can draw 0 of \d+ cases, .*; of the others it says: it computes in torch.float64, not"):
        suite().test_can_be_checked()
    type("OfDoubles", (suite,), {"dtype": torch.float64})().test_can_be_checked()


def test_a_backend_of_float64_alone_is_checked_in_it(monkeypatch):
    monkeypatch.setattr(tables, "CASES", FEW)
    register_backend("doubles", OfDoubles)
    outcomes = tables.check("doubles")
    assert {each.case for each in outcomes if not each.skipped} and all(each.passed for each in outcomes)


def test_a_long_message_does_not_widen_the_lines_of_others():
    lines = tables.check_table([Outcome("a", 0, True, True, ""), Outcome("b", 0, True, False, 500 * "x")]).splitlines()
    assert len(lines[-1]) > 500 and max(map(len, lines[:-1])) < 100


def test_the_table_ends_with_what_failed_after_the_reasons_why_others_were_not_run():
    wrong = Outcome("wrong", 0.5, True, False, "differs")
    skipped = [Outcome(f"no {i}", 0, True, True, "no SH; no colors", skipped=True) for i in (1, 2)]
    first, second, *_, right, failed = tables.check_table([wrong, *skipped, Outcome("right", 0, True, True, "")]).splitlines()
    assert "| right " in right and "FAIL: differs" in failed
    assert [first, second] == ["skipped, 2 times: no SH", "skipped, 2 times: no colors"]


def test_the_summary_counts_what_was_run():
    assert summary(check_backend(WithoutGradients(), FEW)) == "5 cases: 4 run, 1 skipped, 0 failed"
    assert summary(check_backend(Raises(), FEW)) == "5 cases: 5 run, 0 skipped, 1 failed"


def test_a_dtype_without_tolerances_is_refused():
    with pytest.raises(SettingsError, match=r"no tolerances for torch\.float16"):
        check_backend(ReferenceBackend(), FEW, dtype=torch.float16)


def test_cut_offs_forgive_few_pixels_and_little():
    expected = torch.full((40, 32, 3), 0.5, dtype=torch.float64)
    few, many, much = expected.clone(), expected.clone(), expected.clone()
    few[7, :2, 1] += 1 / 255
    many[7, :4, 1] += 1 / 255
    much[7, 3, 1] += 1.1 * PIXEL_BAND
    assert differing_images("image", few, expected, SINGLE) == []
    assert "4 of 1280 differ" in differing_images("image", many, expected, SINGLE)[0]
    assert differing_images("image", much, expected, SINGLE) == [
        "image, pixels: 1 of 1280 differ, the worst by 1.11e-02 at row 7, column 3: [0.5, 0.51111, 0.5] instead of [0.5, 0.5, 0.5]"
    ]


def test_many_small_faults_do_not_hide_in_a_large_row():
    expected = torch.ones(200, 3, dtype=torch.float64)
    expected[0] = 100
    wrong = expected.clone()
    wrong[50:60] *= 1.1
    assert "10 of 200 differ, the worst by 1.00e-01 at 50" in differing_gradients("means", wrong, expected, SINGLE)[0]


def test_builders_give_the_same_case_each_time():
    first, second = random_scene(1, "classic", 0.3), random_scene(1, "classic", 0.3)
    assert torch.equal(first.gaussians.means, second.gaussians.means) and torch.equal(first.gaussians.sh, second.gaussians.sh)


def test_the_example_runs_where_pytest_is_missing():
    """On its first cases."""
    root = Path(__file__).parents[2]
    few = "from mipmap_plugin.backends.conformance import CASES; [CASES.popitem() for _ in range(len(CASES) - 20)]"
    run = f"import runpy, sys; sys.modules['pytest'] = None; {few}; runpy.run_path('examples/register_backend.py', run_name='__main__')"
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", run], cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.rstrip().endswith("20 cases: 4 run, 16 skipped, 0 failed"), done.stdout + done.stderr
