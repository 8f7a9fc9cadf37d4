"""What our renderer says that viser shows, and what it shows."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from browser import ALIKE, Browser, at, missing, psnr
from in_viser import drawn, in_viser

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.demo.run import embedded
from mipmap_plugin.wrap import Wrapped

pytestmark = pytest.mark.browser

# dB of the demo's scene, which has many splats of one size, that viser nearly leaves out: of them some are on the other side of its threshold.
NEARLY_ALIKE = 40.0


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if lacking := missing() or ("" if find_spec("viser") else 'viser is not installed; `pip install ".[view]"` brings it'):
        pytest.skip(lacking)
    with Browser() as started:
        yield started


def test_the_demo_looks_as_we_say(browser: Browser) -> None:
    base = embedded()
    assert likeness(browser, base, at(base.cameras[:1], 1 / 2)) > NEARLY_ALIKE


def test_an_adapted_file_looks_as_we_say(browser: Browser, tmp_path: Path) -> None:
    base = embedded()
    base.adapt(1 / 4, recipe="instant", viewer="viser").save(tmp_path / "adapted.ply")
    adapted = wrap_model(tmp_path / "adapted.ply", background=(1.0, 1.0, 1.0))
    assert likeness(browser, adapted, at(base.cameras[:1], 1 / 4)) > NEARLY_ALIKE


@pytest.mark.parametrize(("name", "scale"), [("bases/lego_200", 1 / 4), ("flowers_r8", 1 / 4)])
def test_a_real_base_looks_as_we_say(browser: Browser, shared_data: Path, name: str, scale: float) -> None:
    base = wrap_model(shared_data / "checkpoints" / name)
    assert likeness(browser, base, at(base.cameras[:1], scale)) > ALIKE


@torch.no_grad()
def likeness(browser: Browser, model: Wrapped, cameras: Sequence[Camera]) -> float:
    """dB between our render and viser's picture, the least of the views, in pixels that are made square."""
    square = [replace(camera, fx=camera.fy) for camera in cameras]
    with in_viser(browser, model.model.gaussians(cameras[0])) as shown:
        real = [drawn(*shown, camera, model.background) for camera in square]
    ours = [model.render(camera, viewer="viser").image.clamp(0, 1).mul(255).round().div(255).numpy() for camera in square]
    return min(psnr(image, picture) for image, picture in zip(ours, real, strict=True))
