"""What several test files need: real data that lies beside the repository, where there is any."""

import math
import signal
from pathlib import Path

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.cli import main
from mipmap_plugin.levels.ladder import NOT_BETTER
from mipmap_plugin.models.families import FAMILIES
from mipmap_plugin.process.garbage import leave_loaded, uncollected
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.splatting.viewers import VIEWERS

pytest.register_assert_rewrite("anchor_models", "commands_run")  # their checks show what they found, as those of tests do

SHARED = Path(__file__).parents[1].parent / "shared"


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Nothing that collecting tests makes is garbage, and looking for some took a quarter of its time."""
    with uncollected():
        result = yield
    leave_loaded()
    return result


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real checkpoints and images; the test skips where it is absent."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip("the real data lie beside the author's repository only")
    return folder


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """Tensors this small cost more to share out than to compute."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="session")
def ctrl_c_is_heard():
    """A shell starts what it runs in the background deaf to Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def nothing_that_is_registered_stays():
    before = {registry: dict(registry._targets) for registry in (BACKENDS, FAMILIES, UPSAMPLERS, VIEWERS, RECIPES)}
    yield
    for registry, targets in before.items():
        registry._targets = targets


@pytest.fixture(autouse=True)
def small_orbits(monkeypatch):
    """Views of a generated orbit have 24 px, in place of 800: no test of a file without cameras is about its pictures."""
    monkeypatch.setattr("mipmap_plugin.adaptation.views.policy.ORBIT_PIXELS", 24)


@pytest.fixture
def run(capsys):
    """Call the command line; return (exit code, what it said on stdout, what on stderr)."""

    def call(*words):
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as leaving:  # how the argument parser ends
            code = leaving.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def few_views():
    """Recipes take 4 views beside the given ones and 4 for validation, in place of 100 and 16: for tests whose dB do not matter."""

    def with_few(usual):
        return lambda scale, network: {**usual(scale, network), "extra_views": 4, "validation_views": 4}

    for name in ("default", "thorough", "paper", "instant"):
        RECIPES.add(name, with_few(RECIPES.get(name)), replace=True)


@pytest.fixture
def brief_ladders(monkeypatch):
    """Levels by zoom are compared in one view and at few zooms, and kept unless they hold the base: for tests of a ladder whose dB do not matter."""
    monkeypatch.setattr("mipmap_plugin.levels.ladder.MOST_LOST", math.inf)
    monkeypatch.setattr("mipmap_plugin.levels.ladder._no_use", lambda level, *_: NOT_BETTER if level.adapted.report.holds_base() else None)
    monkeypatch.setattr("mipmap_plugin.levels.yardstick.VIEWS", 1)
    monkeypatch.setattr("mipmap_plugin.levels.switching.FIRST_STEP", 2.0)
    monkeypatch.setattr("mipmap_plugin.levels.switching.SECOND_STEP", 2.0)


@pytest.fixture
def model_folder(tmp_path):
    """A base of which one view is for testing."""
    return tiny.folder(tmp_path / "base", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"))
