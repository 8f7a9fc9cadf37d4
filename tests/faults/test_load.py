"""Loading takes memory in proportion to the file, and no more than was promised."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks/load.py"
sys.path.insert(0, str(BENCHMARK.parent))
load = pytest.importorskip("load", reason="the benchmarks are not installed with the package")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not tell what a process holds now")
def test_a_large_ply_loads_within_three_times_its_size(tmp_path):
    """25 MB; the numbers of the libraries, which are the same for any file, are in the measurement and count for less in larger ones."""
    path = load.write(tmp_path / "large.ply", 100_000)
    _, extra, splats = load.measure(path)
    assert splats == 100_000
    assert extra < 3 * path.stat().st_size
