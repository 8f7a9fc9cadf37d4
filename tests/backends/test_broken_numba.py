"""A numba that is absent, or installed but does not load: torch renders, slower, and one sentence says why and what to do."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import tiny
import torch
from samples import camera, gaussians

from mipmap_plugin.backends import choose_backend, cpu
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable

REMEDY = f"numba does not load: ImportError: Numba needs NumPy 2.2 or less; {cpu.REINSTALL}"


# Adapts by one backend after the other, and prints for each the exit code and what was said of numba.
BY_BACKENDS = """
import contextlib, io, json, sys
from mipmap_plugin.cli import main
told = {}
for backend in ("auto", "cpu"):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main([*sys.argv[1:], "--backend", backend])
    told[backend] = [code, [line for line in said.getvalue().splitlines() if "numba" in line]]
print(json.dumps(told))
"""


def by_backends(folder, variables):
    """What a process with these environment variables tells by `BY_BACKENDS`."""
    words = ["adapt", str(tiny.folder(folder / "base")), "--scale", "1/2", "--steps", "1", "--views", "given", "--overwrite"]
    command = [sys.executable, "-c", BY_BACKENDS, *words]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What a process whose numba does not load tells by `BY_BACKENDS`."""
    folder = tmp_path_factory.mktemp("broken_numba")
    package = folder / "broken" / "numba"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('Numba needs NumPy 2.2 or less.')")
    return by_backends(folder, {"PYTHONPATH": f"{package.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"})


def test_torch_takes_its_place(told):
    said = f"mipmap-plugin: backend cpu cannot do this: {REMEDY}; the backend reference takes its place, many times slower"
    assert told["auto"] == [0, [said]]


def test_the_backend_that_needs_it_ends_in_a_sentence(told):
    assert told["cpu"] == [2, [f"mipmap-plugin: backend 'cpu' cannot do this, but reference can: {REMEDY}"]]


def test_a_numba_without_threads_is_told_of(tmp_path):
    pytest.importorskip("numba")
    [said] = by_backends(tmp_path, {"NUMBA_NUM_THREADS": "0"})["auto"][1]
    assert said == f"mipmap-plugin: backend cpu cannot do this: {cpu.NO_THREADS}; the backend reference takes its place, many times slower"


def test_without_numba_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(cpu, "missing", lambda: [cpu.NO_NUMBA])
    g = gaussians(2, dtype=torch.float32)
    needs = Needs.of(g, Effects(1), gradients=True)
    assert cpu.CpuBackend().lacking(needs) == [cpu.NO_NUMBA]
    with pytest.raises(BackendUnavailable, match=r'pip install "mipmap-plugin\[cpu\]"'):
        cpu.CpuBackend().render(g, camera(), Effects(1))
    with pytest.warns(UserWarning, match="numba, which some .* have no wheels of; .*; the backend reference takes its place, many times slower"):
        assert choose_backend("auto", needs)[0].name == "reference"


@pytest.mark.filterwarnings("error")
def test_numba_is_not_missed_where_it_would_not_do(monkeypatch):
    monkeypatch.setattr(cpu, "missing", lambda: [cpu.NO_NUMBA])
    usual = Needs.of(gaussians(2, dtype=torch.float32), Effects(1), gradients=True)
    assert choose_backend("auto", usual, replace(usual, screen_filter="surfel"))[0].name == "reference"


@pytest.mark.parametrize(("value", "missing"), [("1", [cpu.DISABLED]), ("0", [])])
def test_a_numba_that_is_kept_from_compiling_is_told_of(monkeypatch, value, missing):
    """Kernels are made of what numba makes, so that it was a traceback."""
    pytest.importorskip("numba")
    monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
    assert cpu.missing.__wrapped__() == missing  # which is cached for the process
