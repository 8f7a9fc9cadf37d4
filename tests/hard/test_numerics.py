"""The claims of docs/numerics.md: errors stay at rounding, and the usual formulas that are measured for comparison are right in ordinary scenes."""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))  # its modules import one another by bare names, as scripts do
numerics = pytest.importorskip("numerics", reason="the benchmarks are not installed with the package")
pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")


@pytest.mark.parametrize("end", [0, -1])
@pytest.mark.parametrize("sweep", numerics.SWEEPS)
def test_errors_stay_at_rounding(sweep, end):
    build, values = numerics.SWEEPS[sweep]
    at = numerics.errors(build, min(values[end], 16) if sweep == "scale" else values[end])
    for name in ("reference", "cpu"):
        image, gradient = at[name]
        assert image < 2e-6 and gradient < 2e-5


@pytest.mark.parametrize("sweep", numerics.SWEEPS)
def test_the_usual_formulas_are_right_in_ordinary_scenes(sweep):
    image, gradient = numerics.errors(numerics.SWEEPS[sweep][0], 1.0)["usual formulas"]
    assert image < 2e-6 and gradient < 2e-5


def test_the_measured_errors_are_those_of_the_usual_formulas_and_not_of_this_package():
    assert [float(own) for _, _, own in numerics.vanishing_gradients()] == pytest.approx([1] * 4, abs=1e-4)
    assert all(float(exact) == pytest.approx(float(own), rel=1e-3) for _, exact, _, own in numerics.compensation_slopes())
    assert all(float(worst) < 1e-6 for _, _, _, worst, _ in numerics.determinants(200))
