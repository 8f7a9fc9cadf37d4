"""Report pages, and a browser that opens them."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tiny
from browser import Browser, missing, missing_browser

from mipmap_plugin.cli import main

WIDE = {"width": 1200, "height": 900}

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    if lacking := missing_browser():
        pytest.skip(lacking)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The viewers in a browser."""
    if lacking := missing():
        pytest.skip(lacking)
    with Browser() as started:
        yield started


@pytest.fixture(scope="session")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The JSON of an evaluation at two zooms; its page lies beside it."""
    here = tmp_path_factory.mktemp("evaluation")
    base = tiny.folder(here / "base", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"))
    words = ["--images", tiny.scene(here / "scene"), "--scale", "1/2", "--scale", "1", "--recipe", "instant", "--output", here / "rows.json"]
    assert main([str(word) for word in ("evaluate", base, *words)]) == 0
    return here / "rows.json"


@pytest.fixture(scope="session")
def tradeoff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The JSON of a tradeoff; its page lies beside it."""
    here = tmp_path_factory.mktemp("tradeoff")
    words = ["tradeoff", tiny.folder(here / "base"), "--scale", "1/2", "--output", here / "out", "--recipe", "default", "--steps", "5"]
    assert main([str(word) for word in (*words, "--repeats", "1", "--no-renderers", "--no-picture", "--views", "1", "--report")]) == 0
    return here / "out" / "tradeoff.json"


@pytest.fixture(scope="session")
def ladder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of a ladder; its page lies beside it."""
    here = tmp_path_factory.mktemp("ladder")
    words = ["levels", tiny.folder(here / "base"), "--viewer", "spark", "--coarsest", "1/4", "--ratio", "2", "--steps", "5", "--views", "given"]
    assert main([str(word) for word in (*words, "--output", here / "levels", "--report")]) == 0
    return here / "levels" / "levels.json"


@pytest.fixture
def open_page(chromium: Any) -> Iterator[Open]:
    """Opens a page; fails at the end if it had an error or asked for anything but itself."""
    complaints, contexts = [], []

    def opened(path: Path, **settings: Any) -> Any:
        context = chromium.new_context(**{"viewport": WIDE, **settings})
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda asked: complaints.append(asked.url) if not asked.url.startswith(("file:", "data:")) else None)
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []
