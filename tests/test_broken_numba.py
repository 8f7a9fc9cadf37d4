"""A numba that is installed but does not load is as none: torch renders, slower, and one sentence says why and what to do."""

import os
import subprocess
import sys

import pytest
import tiny

from mipmap_plugin.backends import cpu

REMEDY = f"numba does not load: ImportError: Numba needs NumPy 2.2 or less; {cpu.REINSTALL}"


@pytest.fixture
def run(tmp_path):
    """Adapts a scene in a process with a numba that does not load; returns its exit code, and the lines of its errors."""
    package = tmp_path / "broken" / "numba"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('Numba needs NumPy 2.2 or less.')")
    places = f"{package.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"

    def do(backend):
        words = ["adapt", str(tiny.folder(tmp_path / "base")), "--scale", "1/2", "--steps", "1", "--views", "given", "--backend", backend]
        environment = {**os.environ, "PYTHONPATH": places}
        done = subprocess.run([sys.executable, "-m", "mipmap_plugin", *words], capture_output=True, text=True, env=environment)
        return done.returncode, [line for line in done.stderr.splitlines() if "numba" in line]

    return do


def test_torch_takes_its_place(run):
    said = f"mipmap-plugin: backend cpu cannot do this: {REMEDY}; the backend reference takes its place, many times slower"
    assert run("auto") == (0, [said])


def test_the_backend_that_needs_it_ends_in_a_sentence(run):
    assert run("cpu") == (2, [f"mipmap-plugin: backend 'cpu' cannot do this, but reference can: {REMEDY}"])
