"""On a GPU: every family, recipe and command with each backend there, and the same on the processor. Run with `pytest -m gpu`.

Without a GPU they are skipped, or with TRY_WITHOUT_GPU=1 done by another backend of the processor.
"""

import os
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest
import surfel_checkpoints
import tiny
import torch
from torch import Tensor

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))  # its modules import one another by bare names, as scripts do

from family_scenes import FAMILIES, views

from mipmap_plugin import load_model, wrap_model
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.cli import main
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.viewing.sources import File, Supersampled
from mipmap_plugin.viewing.stage import Look, Stage
from mipmap_plugin.wrap import Wrapped

TRIED = os.environ.get("TRY_WITHOUT_GPU") == "1"
DEVICE = "cpu" if TRIED else "cuda"
BACKENDS = ("cpu",) if TRIED else ("triton", "gsplat", "inria")
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not (TRIED or torch.cuda.is_available()), reason="there is no GPU")]

FEW = dict(steps=12, extra_views=4, views_per_step=2, validation_views=3, check_every=6, conversion_steps=6)
SAME_DB = 0.1

# dB between images of the same splats. The largest alpha of gsplat 1.5 is 0.999; INRIA's rasterizer ends a splat at three standard deviations.
ALIKE = {"triton": 70.0, "gsplat": 40.0, "inria": 36.0, "cpu": 70.0}


class Shown(NamedTuple):
    """What a model looks like at several scales, and what an adaptation to one of them reports."""

    images: list[Tensor]
    reports: list[Report]


@pytest.fixture(autouse=True)
def served(request):
    """Skip where the backend of the test is not installed."""
    name = request.node.callspec.params.get("backend") if hasattr(request.node, "callspec") else None
    if name and (reasons := get_backend(name).lacking(Needs(DEVICE, torch.float32, gradients=True, sh_degree=1, screen_filter="classic"))):
        pytest.skip("; ".join(reasons))


def shown(wrapped: Wrapped, cameras, scales=(1 / 2, 1.0, 2.0), **settings) -> Shown:
    images = [wrapped.render(camera.zoomed(scale), scale).image.cpu() for scale in scales for camera in cameras[:2]]
    return Shown(images, [wrapped.adapt(scale, **FEW | settings).report for scale in scales if scale != 1])


def base_of(family: str, folder: Path):
    (surfel_checkpoints.folder if family == "2dgs" else FAMILIES[family].write)(folder)
    return load_model(folder), [view.resized(32, 24) for view in views(4, "train", family in FAMILIES and FAMILIES[family].moves)]


@cache
def on_processor(family: str) -> Shown:
    with TemporaryDirectory() as folder:
        model, cameras = base_of(family, Path(folder) / "base")
        return shown(wrap_model(model, cameras=cameras, backend="reference"), cameras)


def assert_same(there: Report, here: Report) -> None:
    """The dB of the base and of what is returned."""
    for before, after in ((here.psnr_before(), there.psnr_before()), (here.psnr_after(), there.psnr_after())):
        assert after == pytest.approx(before, abs=SAME_DB), (here.gain(), there.gain(), there.returned)
    assert (there.peak_memory_mib is not None) == (DEVICE == "cuda")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("family", [*FAMILIES, "2dgs"])
def test_every_family_is_drawn_and_adapted_as_on_the_processor(family, backend, tmp_path):
    model, cameras = base_of(family, tmp_path / "base")
    wrapped = wrap_model(model.to(DEVICE), cameras=cameras, backend=backend)
    try:
        there = shown(wrapped, cameras)
    except BackendUnavailable as error:
        pytest.skip(str(error))
    here = on_processor(family)
    assert min(psnr(one, other) for one, other in zip(there.images, here.images, strict=True)) > ALIKE[backend]
    for reports in zip(there.reports, here.reports, strict=True):
        assert_same(*reports)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("recipe", "scale"), [(recipe, scale) for recipe in RECIPES.names() for scale in (1 / 2, 2.0)])
def test_every_recipe_ends_as_on_the_processor(recipe, scale, backend):
    settings = dict(recipe=recipe) | (dict(steps=0) if recipe == "instant" else {})
    here, there = (
        shown(wrap_model(tiny.model().to(device), cameras=tiny.cameras(), backend=name), tiny.cameras(), (scale,), **settings)
        for device, name in (("cpu", "reference"), (DEVICE, backend))
    )
    assert_same(there.reports[0], here.reports[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_adapting_by_command_writes_the_same_file(backend, tmp_path):
    base = tiny.folder(tmp_path / "base")
    words = ["adapt", str(base), "--scale", "1/2", "--steps", "4"]
    for name in ("reference", backend):
        assert main([*words, "--backend", name, "--output", str(tmp_path / f"{name}.ply"), "--report"]) == 0
    here, there = (load_model(tmp_path / f"{name}.ply") for name in ("reference", backend))
    assert there.family == here.family and abs(len(there) - len(here)) <= 2
    camera = tiny.cameras()[0].zoomed(0.5)
    drawn = [wrap_model(model, cameras=[camera], backend="reference").render(camera).image for model in (here, there)]
    assert psnr(*drawn) > 30


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "words",
    [
        "render BASE --output OUT --scale 1/2 --depth --normals --supersampling 2",
        "evaluate BASE --images SCENE --scale 1/2 --steps 4 --output OUT.json",
        "tradeoff BASE --scale 1/2 --steps 4 --output OUT --no-picture --repeats 1 --report",
        "levels BASE --viewer classic --output OUT --coarsest 1/4 --steps 4 --report",
        "adapt BASE --scale 1/2 --scale 2 --steps 4 --viewer classic --viewer antialiased --output OUT --report",
    ],
    ids=["render", "evaluate", "tradeoff", "levels", "many"],
)
def test_every_command_ends_well(words, backend, tmp_path):
    named = {"BASE": tiny.folder(tmp_path / "base"), "SCENE": tiny.scene(tmp_path / "scene")}
    named |= {name: tmp_path / name.lower() for name in ("OUT", "OUT.json")}
    assert main([*(str(named.get(word, word)) for word in words.split()), "--backend", backend]) == 0
    assert list(tmp_path.glob("out*"))


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name != "cpu"])
def test_tiles_which_need_the_processor_are_refused(backend, tmp_path, capsys):
    base = tiny.folder(tmp_path / "base")
    assert main(["adapt", str(base), "--scale", "1/2", "--tiles", "2", "--output", str(tmp_path / "out"), "--backend", backend]) == 2
    assert "it runs on cuda, not on cpu" in capsys.readouterr().err


def test_the_demo_runs_there(tmp_path, capsys):
    assert main(["demo", "--scale", "1/4", "--output", str(tmp_path / "demo"), "--no-report"]) == 0
    assert "dB" in capsys.readouterr().out


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_live_view_draws_there(backend):
    pictures, screen = [], tiny.cameras()[0].resized(40, 30)
    for device, name in (("cpu", "reference"), (DEVICE, backend)):
        base = wrap_model(tiny.model().to(device), cameras=tiny.cameras(), backend=name)
        stage = Stage(base, [File("base", base)], Supersampled("supersampled", base))
        pictures.append(stage.draw(Look("base", against="supersampled"), screen))
    here, there = pictures
    assert there.psnr_db == pytest.approx(here.psnr_db, abs=SAME_DB) and there.seconds > 0
    assert psnr(here.image, there.image.cpu()) > 30


@pytest.mark.parametrize("viewer", ["playcanvas", "spark"])
def test_a_file_for_a_viewer_is_made_by_what_serves_it(viewer):
    model, cameras = tiny.model(), tiny.cameras()
    here, there = (
        wrap_model(model.to(device), cameras=cameras, backend=backend).adapt(1 / 2, viewer=viewer, **FEW).report
        for device, backend in (("cpu", "reference"), (DEVICE, "auto"))
    )
    assert_same(there, here)
