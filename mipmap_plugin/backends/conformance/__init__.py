"""Conformance: hard cases on which every backend must equal the float64 reference.

`check_backend` returns one `Outcome` per case, and `summary` counts them; the random scenes in `MORE` take some minutes. Authors of a
backend subclass `BackendSuite` (in `.suite`, which needs pytest) in a test file.
"""

from mipmap_plugin.backends.conformance.cases import CASES, MORE, Builder, HardCase
from mipmap_plugin.backends.conformance.checks import LEAST_RUN, Outcome, check_backend, check_case, summary
from mipmap_plugin.backends.conformance.tolerance import TOLERANCE, Tolerance

__all__ = ["CASES", "LEAST_RUN", "MORE", "TOLERANCE", "Builder", "HardCase", "Outcome", "Tolerance", "check_backend", "check_case", "summary"]
