"""Adaptation of every family in the situations in which optimizers and rasterizers break: it ends, finite, and the base stays as it was."""

import hashlib
import importlib.util
from itertools import product

import pytest
import tiny
import torch
from hard_checkpoints import FAMILIES

from mipmap_plugin.wrap import Wrapped, wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

VIEWS = tiny.cameras(3, width=8, height=6)
SMALL = [view.resized(2, 1) for view in VIEWS]

# Cameras, scale and settings, on top of two steps on the given views.
SITUATIONS = {
    "everything pruned": (VIEWS, 1 / 4, dict(min_opacity=0.9999, prune_every=1)),
    "one view": (VIEWS[:1], 1 / 4, {}),
    "one view twice": (VIEWS[:1] * 2, 4, {}),
    "scale 1": (VIEWS, 1, {}),
    "x64": (SMALL, 64, {}),
    "x1/64": (VIEWS, 1 / 64, {}),
    "instant": (VIEWS, 1 / 8, dict(recipe="instant")),
    "paper": (VIEWS, 1 / 4, dict(recipe="paper", densify_gradient=1e-9, prune_every=1)),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A sound checkpoint of each family, with hard rows in it."""
    rows = [("scale", 0, -40.0), ("scale_0", 1, 5.0), ("rot", 2, 0.0), ("opacity", 3, 60.0)]
    return {name: make(tmp_path_factory.mktemp("base") / "m", rows) for name, make in FAMILIES.items()}


def wrapped(folder, cameras, backend="reference") -> Wrapped:
    return wrap_model(folder, cameras=cameras, backend=backend)


def state(model) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in {**model.parameters(), **model.shared_parameters()}.items()}


def digest(folder) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


def some(others, families=("3dgs", "scaffold"), common=("everything pruned", "cpu")):
    """Each family with `others`: two with all of them, and the rest, but for what is common, only among the slow tests."""
    return [
        pytest.param(family, other, marks=[] if family in families or other in common else [pytest.mark.slow])
        for family, other in product(FAMILIES, others)
    ]


@pytest.mark.parametrize(("family", "situation"), some(SITUATIONS))
def test_it_ends_finite_and_leaves_the_base_unchanged(folders, family, situation):
    cameras, scale, settings = SITUATIONS[situation]
    base, files = wrapped(folders[family], cameras), digest(folders[family])
    before = state(base.model)
    recipe = settings.get("recipe", "default")
    steps = {} if recipe == "instant" else {"steps": 2, "views": "given", "check_every": 1}
    adapted = base.adapt(scale, **{**steps, **settings})
    moved = state(adapted.model)
    finite_before = {name for name, tensor in before.items() if tensor.isfinite().all()}
    assert {name for name, tensor in moved.items() if tensor.isfinite().all()} >= finite_before
    assert adapted.render(cameras[0].zoomed(scale)).image.isfinite().all()
    assert len(moved["means"]) >= 1
    after = state(base.model)
    assert all(torch.equal(before[name], after[name]) for name in before) and digest(folders[family]) == files


@pytest.mark.parametrize(("family", "backend"), some(["reference", "cpu"]))
def test_the_same_seed_gives_the_same_numbers(folders, family, backend):
    if backend == "cpu" and importlib.util.find_spec("numba") is None:
        pytest.skip("numba, the extra `cpu`, is not installed")
    brief = dict(steps=2, extra_views=2, returns="last")
    first, again = (state(wrapped(folders[family], VIEWS, backend).adapt(1 / 4, seed=3, **brief).model) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
