"""A pytest suite for the authors of backends. Only this module needs pytest."""

from __future__ import annotations

import pytest
import torch

from mipmap_plugin.backends.base import API_VERSION, Backend
from mipmap_plugin.backends.conformance.cases import CASES
from mipmap_plugin.backends.conformance.checks import LEAST_RUN, check_case, check_steps, check_views, fitted, lowered
from mipmap_plugin.backends.conformance.usual_faults import usual_fault


class BackendSuite:
    """Subclass it in a test file, and pytest compares your backend with the reference::

        class TestMine(BackendSuite):
            backend = MyBackend()

    Cases that it says it lacks something for are skipped.

    Attributes:
        backend: An instance of your backend.
        dtype: Of the splats that it is given.
        device: Where they are.
    """

    backend: Backend
    dtype: torch.dtype = torch.float32
    device: str = "cpu"

    def test_declares_itself(self) -> None:
        assert self.backend.name, "name: it has none"
        assert isinstance(self.backend.speed, (int, float)), f"speed: a number is needed, got {self.backend.speed!r}"
        assert self.backend.api_version == API_VERSION, f"api_version: it is written for {self.backend.api_version}, and this is {API_VERSION}"

    def test_can_be_checked(self) -> None:
        """Otherwise all is skipped, which looks like a success."""
        reasons = [reasons for build in CASES.values() if (reasons := fitted(self.backend, build, dtype=self.dtype, device=self.device)[1])]
        few = f"it can draw {len(CASES) - len(reasons)} of {len(CASES)} cases, too few to tell whether it is right"
        assert len(CASES) - len(reasons) >= LEAST_RUN * len(CASES), f"{few}; of the others it says: {'; '.join(reasons[0])}"

    def test_makes_no_usual_mistake(self) -> None:
        """Such as pixel centers at whole numbers, which a sentence tells sooner than the numbers of many cases."""
        fault = usual_fault(self.backend, dtype=self.dtype, device=self.device)
        assert not fault, fault

    @pytest.mark.parametrize("case", CASES)
    def test_equals_the_reference(self, case: str) -> None:
        outcome = check_case(self.backend, case, CASES[case], dtype=self.dtype, device=self.device)
        if outcome.skipped:
            pytest.skip(outcome.message)
        assert outcome.passed, outcome.message

    def test_leaves_its_input_as_it_is(self) -> None:
        """The splats may be the base's own tensors."""
        case = lowered(self.backend, CASES["sh-degree-3"](), dtype=self.dtype, device=self.device)
        splats = case.gaussians
        copies = {name: tensor.clone() for name, tensor in splats.tensors().items()}
        with torch.no_grad():
            self.backend.render(splats, case.camera, case.effects)
        assert [name for name, tensor in copies.items() if not torch.equal(getattr(splats, name), tensor)] == []

    def test_views_in_one_call_are_those_drawn_alone(self) -> None:
        if not hasattr(self.backend, "render_views"):
            pytest.skip("it draws one view at a time")
        outcome = check_views(self.backend, CASES["sh-degree-3"], dtype=self.dtype, device=self.device)
        assert outcome.passed, outcome.message

    def test_steps_follow_the_gradients(self) -> None:
        if not hasattr(self.backend, "stepper"):
            pytest.skip("it leaves steps to the optimizer")
        outcome = check_steps(self.backend, CASES["sh-degree-3"], dtype=self.dtype, device=self.device)
        assert outcome.passed, outcome.message
