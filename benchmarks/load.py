"""How long a large checkpoint takes to load, and how much memory: seconds, and the peak over the size of the file.

    python benchmarks/load.py                        # a generated PLY of a million splats of SH degree 3
    python benchmarks/load.py --splats 100000 --checkpoint output/bicycle

Each load has a process of its own; what Python and torch themselves take is measured in that process before, and taken off.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RUNS = 3
STATUS = Path("/proc/self/status")

# 3DGS's columns of SH degree 3 with normals, 62 of them.
COLUMNS = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
COLUMNS += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def write(path: Path, splats: int, chunk: int = 50_000) -> Path:
    """A binary PLY of random splats, written in pieces, so that writing takes no memory."""
    random = np.random.default_rng(0)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {splats}", *(f"property float {name}" for name in COLUMNS), "end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        for start in range(0, splats, chunk):
            file.write(random.standard_normal((min(chunk, splats - start), len(COLUMNS)), dtype=np.float32).astype("<f4").tobytes())
    return path


def peak_memory() -> int:
    """Peak memory of this process, bytes. On Linux of the process alone; `getrusage` includes that of its parent."""
    if STATUS.exists():
        return 1024 * int(re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def memory_in_use() -> int:
    """Memory of this process now, bytes; its peak where the system does not report it."""
    return 1024 * int(re.search(r"VmRSS:\s+(\d+) kB", STATUS.read_text())[1]) if STATUS.exists() else peak_memory()


def load(path: Path) -> None:
    """Load `path` in this process, and print seconds, bytes at the peak, and splats."""
    from mipmap_plugin import load_model
    from mipmap_plugin.models.reading import load_vanilla  # imports are not billed

    del load_vanilla
    before, began = memory_in_use(), time.perf_counter()
    model = load_model(path)
    print(time.perf_counter() - began, peak_memory() - before, len(model.parameters()["means"]))


def measure(path: Path) -> tuple[float, int, int]:
    """Seconds, bytes and splats of one load, in a new process."""
    done = subprocess.run([sys.executable, __file__, "--load", str(path)], capture_output=True, text=True, check=True)
    seconds, extra, splats = done.stdout.split()
    return float(seconds), int(extra), int(splats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--checkpoint", type=Path, help="a PLY of yours, instead of a generated one")
    parser.add_argument("--load", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.load:
        load(options.load)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = options.checkpoint or write(Path(folder) / "large.ply", options.splats)
        size = path.stat().st_size
        runs = [measure(path) for _ in range(RUNS)]
    seconds = sorted(run[0] for run in runs)
    print("| splats | file | seconds (least-most) | peak over the file's size |\n| ---: | ---: | ---: | ---: |")
    most = max(run[1] for run in runs) / size
    print(f"| {runs[0][2]:,} | {size / 1e6:.0f} MB | {seconds[1]:.1f} ({seconds[0]:.1f}-{seconds[-1]:.1f}) | {most:.2f} |")


if __name__ == "__main__":
    main()
