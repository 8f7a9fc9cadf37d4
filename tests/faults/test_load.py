"""Loading takes memory in proportion to the file, and no more than was promised."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks/load.py"
sys.path.insert(0, str(BENCHMARK.parent))
load = pytest.importorskip("load", reason="the benchmarks are not installed with the package")


@pytest.mark.skipif(not load.STATUS.exists(), reason="the system does not report the memory of a process")
def test_a_large_ply_loads_within_three_times_its_size(tmp_path):
    """50 MB: what libraries take at their first use is in the measurement too, and the same for any file."""
    path = load.write(tmp_path / "large.ply", 200_000)
    _, extra, splats = load.measure(path)
    assert splats == 200_000
    assert extra < 3 * path.stat().st_size
