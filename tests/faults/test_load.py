"""Loading takes memory in proportion to the file, and no more than was promised."""

import subprocess
import sys
from pathlib import Path

import ply_files
import pytest

STATUS = Path("/proc/self/status")

# Prints the splats of a file, and by how many bytes loading it raises the memory of a process: at its peak, which Linux tells of the process alone.
LOAD = """
import re, sys
from mipmap_plugin import load_model
import mipmap_plugin.models.reading  # what imports take is not counted
told = lambda name: 1024 * int(re.search(name + r":\\s+(\\d+) kB", open("/proc/self/status").read())[1])
before = told("VmRSS")
print(len(load_model(sys.argv[1]).parameters()["means"]), told("VmHWM") - before)
"""


@pytest.mark.skipif(not STATUS.exists(), reason="the system does not report the memory of a process")
def test_a_large_ply_loads_within_three_times_its_size(tmp_path):
    """50 MB: what libraries take at their first use is in the measurement too, and the same for any file."""
    path = ply_files.write_splats(tmp_path / "large.ply", 200_000)
    done = subprocess.run([sys.executable, "-c", LOAD, str(path)], capture_output=True, text=True, check=True)
    splats, extra = map(int, done.stdout.split())
    assert splats == 200_000
    assert extra < 3 * path.stat().st_size
