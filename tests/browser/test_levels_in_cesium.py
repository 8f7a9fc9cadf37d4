"""3D Tiles of a ladder in a real Cesium: at which zooms it changes levels, and what these look like."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import HERE, Browser, Page, missing, psnr

from mipmap_plugin import Camera, load_model
from mipmap_plugin.adaptation.adapted import render_model
from mipmap_plugin.demo.run import embedded
from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.formats.splat_transform import TOOL, find_tool
from mipmap_plugin.levels.manifest import CANVAS, read_manifest
from mipmap_plugin.levels.tiles import TILES, write_tiles

pytestmark = pytest.mark.browser

WHITE = (1.0, 1.0, 1.0)

# Cesium's focal length in px: 60 degrees along the longer side of 16 x 9.
FOCAL = CANVAS * 16 / 9 / 2 / math.tan(math.radians(30))

# px: of pictures, the middle of such a canvas.
SIZE = 160

# How near a switch levels may change, as a factor of its zoom: the box is as near as in most directions, or there are spheres.
NEARLY = {"ladder": 1.05, "unbounded": 1.01}

# Training views from whose directions the camera looks.
VIEWS = (0, 20, 40)

# dB between our picture of a level and Cesium's, which SPZ's rounding is in; 45 to 59 were measured. Of other levels it is at least so much less.
ALIKE, APART = 43.0, 10.0


@pytest.fixture(scope="module")
def ladder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three levels of the demo's scene, and their tiles."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(HERE / "node_modules" / ".bin"), prepend=":")
        if lacking := missing() or ("" if find_tool() else f"{TOOL} is not installed; `npm ci` in tests/browser brings it"):
            pytest.skip(lacking)
        folder = embedded().levels("cesium", coarsest=1 / 4, ratio=2.0, steps=30).save(tmp_path_factory.mktemp("demo") / "ladder")
        write_tiles(folder)
    return folder


@pytest.fixture(scope="module")
def unbounded(ladder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with two splats so far away that every camera is between them."""
    folder = tmp_path_factory.mktemp("demo") / "unbounded"
    shutil.copytree(ladder, folder, ignore=shutil.ignore_patterns(TILES))
    for level in read_manifest(folder)["levels"]:
        columns = {name: np.concatenate([column[:1], column, column[:1]]) for name, column in read_ply(folder / level["file"]).columns.items()}
        for axis in "xyz":
            columns[axis][[0, -1]] = -200, 200
        write_ply(folder / level["file"], columns, overwrite=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(HERE / "node_modules" / ".bin"), prepend=":")
        write_tiles(folder)
    return folder


def seen_at(ladder: Path, zoom: float, view: int) -> Camera:
    """Cesium's own camera in a training view's direction, from so far away that the ladder's middle is seen at this zoom."""
    manifest, camera = read_manifest(ladder), embedded().cameras[view]
    middle, rotation = torch.tensor(manifest["middle"], dtype=torch.float64), camera.viewmat[:3, :3]
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -(rotation @ middle) + torch.tensor([0, 0, FOCAL * manifest["view_pixel"] / zoom], dtype=torch.float64)
    return replace(camera, width=SIZE, height=SIZE, fx=FOCAL, fy=FOCAL, cx=SIZE / 2, cy=SIZE / 2, viewmat=viewmat)


@pytest.mark.parametrize("name", NEARLY)
def test_levels_change_at_the_zooms_of_the_manifest(browser: Browser, request: pytest.FixtureRequest, name: str) -> None:
    folder = request.getfixturevalue(name)
    page = browser.tiles(folder / TILES)
    for number, switch in enumerate(read_manifest(folder)["switches"]):
        for factor, level in ((NEARLY[name], number), (1 / NEARLY[name], number + 1)):
            cameras = [seen_at(folder, switch["zoom"] * factor, view) for view in VIEWS]
            assert page.chosen(cameras) == [[f"level_{level}.glb"]] * len(VIEWS)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_level_looks_as_we_say_where_it_is_shown(browser: Browser, ladder: Path, level: int) -> None:
    base, manifest = embedded(), read_manifest(ladder)
    page: Page = browser.tiles(ladder / TILES)
    camera = seen_at(ladder, manifest["levels"][level]["scale"], VIEWS[0])
    (real,) = page.draw([camera], WHITE)
    backend, _ = base.backend(viewer="cesium")
    files = [load_model(ladder / each["file"]) for each in manifest["levels"]]
    likeness = [psnr(render_model(file, backend, camera, base.target("cesium")).image.clamp(0, 1).numpy(), real) for file in files]
    assert level == int(np.argmax(likeness)) and likeness[level] > ALIKE
    assert sorted(likeness)[-2] < likeness[level] - APART
