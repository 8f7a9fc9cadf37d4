"""The live view in a real browser: it shows the scene, zooms, switches, adapts and saves, and Ctrl-C ends it."""

import io
import json
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import moving
import numpy as np
import pytest
import torch
from browser import FLAGS
from live import WINDOW, LivePage, embedded, missing, serving
from PIL import Image

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.viewing.screen import Sampling, pose_of
from mipmap_plugin.wrap import Wrapped

pytestmark = pytest.mark.browser

# dB between a screenshot and what is drawn for it: WebGL puts the picture on the canvas, which may be shifted by parts of a pixel.
SAME_PICTURE_DB = 25.0


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Wrapped:
    if lacking := missing():
        pytest.skip(lacking)
    return wrap_model(embedded(tmp_path_factory.mktemp("view") / "demo"))


@pytest.fixture(scope="module")
def others(base: Wrapped) -> list[Path]:
    """A file adapted to x1/4, and a ladder of two levels."""
    folder = base.model.folder.parent
    adapted = base.adapt(1 / 4, recipe="instant").save(folder / "quarter.ply")
    ladder = folder / "ladder"
    ladder.mkdir()
    for name in ("level_0.ply", "level_1.ply"):
        shutil.copy(adapted, ladder / name)
    levels = [{"file": "level_0.ply", "shown_from": 0.7}, {"file": "level_1.ply", "shown_from": None}]
    (ladder / "levels.json").write_text(json.dumps({"levels": levels}))
    return [adapted, ladder]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """The browser."""
    if lacking := missing():
        pytest.skip(lacking)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", *FLAGS])
        yield browser
        browser.close()


@contextmanager
def opened(chromium: Any, words: list[Path]) -> Iterator[LivePage]:
    """The page of the command with these words; fails at the end if it had an error or asked for anything from elsewhere."""
    complaints: list[str] = []
    with serving(words) as (_, address):
        tab = chromium.new_page(viewport=WINDOW)
        tab.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("request", lambda asked: complaints.append(asked.url) if not asked.url.startswith((address, "data:", "blob:")) else None)
        yield LivePage(tab, address)
        tab.close()
    assert complaints == []


@pytest.fixture(scope="module")
def page(chromium: Any, base: Wrapped, others: list[Path]) -> Iterator[LivePage]:
    """The page, which most tests use in turn."""
    with opened(chromium, [base.model.folder, *others]) as page:
        yield page


def image(png: bytes) -> torch.Tensor:
    return torch.from_numpy(np.array(Image.open(io.BytesIO(png)).convert("RGB"), dtype=np.float32) / 255)


def expected(base: Wrapped, shown: torch.Tensor, view: int, time: float | None = None) -> torch.Tensor:
    """The base as our own backend draws it from a view, in as many pixels, at a moment."""
    camera = base.cameras[view]
    pose = pose_of(camera, Sampling(base.model.parameters()["means"], base.cameras, base.effects().near_plane).of(camera).depth)
    return base.render(replace(pose.camera(shown.shape[1], shown.shape[0]), time=time)).image


def like(base: Wrapped, page: LivePage, view: int) -> bool:
    """Whether the page shows what a view of the scene sees."""
    shown = image(page.picture())
    return psnr(shown, expected(base, shown, view)) > SAME_PICTURE_DB


def go(page: LivePage, base: Wrapped, view: int) -> bytes:
    """Go to a view of the scene that no other test goes to, and return the still picture of it."""
    page.choose("Go to view", base.cameras[view].name)
    assert page.becomes(lambda: like(base, page, view))
    return page.still()


def test_the_page_shows_the_scene(page: LivePage, base: Wrapped) -> None:
    assert page.becomes(lambda: like(base, page, 0))
    shown = image(page.still())
    assert f"{shown.shape[1]} × {shown.shape[0]} px" in page.text() and "12,000 of 12,000 splats" in page.text()


def test_a_view_of_the_scene_is_gone_to(page: LivePage, base: Wrapped) -> None:
    go(page, base, 2)
    assert not like(base, page, 0)


def test_dragging_orbits(page: LivePage, base: Wrapped) -> None:
    before, box = go(page, base, 1), page.box()
    page.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + box["width"] / 2 + 120, box["y"] + box["height"] / 2, steps=5)
    page.page.mouse.up()
    assert page.becomes(lambda: page.picture() != before)


def test_keys_fly(page: LivePage, base: Wrapped) -> None:
    before = go(page, base, 4)
    zoom = page.zoom()
    page.page.mouse.click(20, 20)  # the picture, not the panel, hears the keys
    page.page.keyboard.down("KeyS")
    page.page.wait_for_timeout(500)
    page.page.keyboard.up("KeyS")
    assert page.becomes(lambda: page.picture() != before and page.zoom() < zoom)


@pytest.mark.parametrize(("by", "view"), [("distance", 5), ("focal length", 6)])
def test_the_slider_zooms(page: LivePage, base: Wrapped, by: str, view: int) -> None:
    before = go(page, base, view)
    zoom = page.zoom()
    assert page.becomes(lambda: 2 ** page.stop() == pytest.approx(zoom, rel=0.05))  # the slider follows the picture
    page.choose("Zoom by", by)
    page.still()  # a list that closes takes the keys
    page.slide(-10)  # tenths of a power of two
    assert page.becomes(lambda: page.zoom() == pytest.approx(zoom / 2, rel=0.1) and page.picture() != before)
    page.slide(10)
    assert page.becomes(lambda: page.zoom() == pytest.approx(zoom, rel=0.1))


def test_what_is_shown_is_switched(page: LivePage, base: Wrapped) -> None:
    shown = go(page, base, 7)
    page.choose("Show", "quarter.ply")
    page.wait_for("· quarter.ply")
    assert page.becomes(lambda: page.picture() != shown)
    page.choose("Show", "ladder")
    page.wait_for("· ladder, level_0.ply")
    page.choose("Show", "base, supersampled")
    page.wait_for("· base, supersampled")
    page.choose("Show", "base")
    assert page.becomes(lambda: page.picture() == shown)


def test_viewers_and_differences_are_switched(page: LivePage, base: Wrapped) -> None:
    shown = go(page, base, 8)
    page.choose("Drawn by", "antimatter15")
    assert page.becomes(lambda: page.picture() != shown)
    page.choose("Drawn by", "as trained")
    assert page.becomes(lambda: page.picture() == shown)
    page.choose("Difference from", "quarter.ply")
    page.wait_for("dB apart")
    assert page.becomes(lambda: page.picture() != shown)
    page.choose("Difference from", "nothing")
    assert page.becomes(lambda: page.picture() == shown)


def test_pixels_are_enlarged_and_levels_follow_the_zoom(page: LivePage, base: Wrapped) -> None:
    go(page, base, 9)
    zoom = page.zoom()
    page.choose("Enlarge pixels", "8")
    page.choose("Show", "ladder")
    page.wait_for("· ladder, level_1.ply")
    assert page.becomes(lambda: page.zoom() == pytest.approx(zoom / 8, rel=0.05))
    page.choose("Show", "base")


def test_the_screen_is_adapted_for_with_a_curve_and_saved(page: LivePage, base: Wrapped) -> None:
    source = base.model.source.read_bytes()
    page.choose("Enlarge pixels", "8")
    page.choose("Go to view", base.cameras[3].name)  # at about x0.6, wherever the tests before have flown to
    page.still()
    assert page.page.locator(".uplot").count() == 0 and page.page.get_by_role("button", name="Save", exact=True).is_disabled()
    page.page.get_by_label("Seconds", exact=True).fill("6")
    page.page.keyboard.press("Enter")
    page.press("Adapt for this picture")
    page.wait_for(r"· adapting, step")
    done = page.wait_for("dB on views that nothing was adapted to")
    page.wait_for("· adapted ×")
    page.page.locator(".uplot").wait_for()
    before, after = (float(part) for part in done.split(": ")[1].split(" dB")[0].split(" → "))
    assert after >= before
    page.press("Save")
    saved = Path(page.wait_for("saved: ").split("saved: ")[1])
    assert saved.relative_to(base.model.folder.parent).parts[0].startswith("demo_x")
    assert len(wrap_model(saved).model.parameters()["means"]) > 0 and base.model.source.read_bytes() == source


def test_a_run_is_stopped(page: LivePage) -> None:
    page.page.get_by_label("Seconds", exact=True).fill("600")
    page.page.keyboard.press("Enter")
    page.press("Adapt for this picture")
    page.wait_for(r": step \d")
    page.press("Stop")
    page.wait_for("dB on views that nothing was adapted to")
    assert page.page.get_by_role("button", name="Stop", exact=True).is_disabled()


def test_the_slider_of_a_moving_scene_shows_a_moment(chromium: Any, tmp_path: Path) -> None:
    far = {name: tensor * (5 if name.startswith("gaussian_warp") else 1) for name, tensor in moving.deform_state().items()}
    scene = wrap_model(moving.write_deformable(tmp_path / "moving", far))

    def moment() -> float:
        """The moment that the picture is most like."""
        shown = image(page.picture())
        return max((0.0, 0.5, 1.0), key=lambda time: psnr(shown, expected(scene, shown, 0, time)))

    with opened(chromium, [scene.model.folder]) as page:
        assert page.becomes(lambda: moment() == 0)
        page.slide(50, slider=1)  # hundredths
        assert page.becomes(lambda: moment() == 0.5)


def test_ctrl_c_ends_it(base: Wrapped) -> None:
    with serving([base.model.folder]) as (process, _):
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=60)
        assert process.returncode == 0 and said.splitlines()[-1] == "ended"
