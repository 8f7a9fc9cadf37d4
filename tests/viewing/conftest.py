"""A small scene in the live view, without a browser: its stage, a screen, and the page with something in the place of viser's server."""

from dataclasses import replace
from unittest.mock import MagicMock

import pytest
import tiny
from live_screen import SIZE

from mipmap_plugin import wrap_model
from mipmap_plugin.viewing import page as live_page
from mipmap_plugin.viewing.page import Page, PageSettings
from mipmap_plugin.viewing.server import served, without_words
from mipmap_plugin.viewing.sources import File, Supersampled
from mipmap_plugin.viewing.stage import Stage


@pytest.fixture
def base():
    return wrap_model(tiny.model(), cameras=tiny.cameras(4))


@pytest.fixture
def stage(base):
    return Stage(base, [File("base", base)], Supersampled("supersampled", base))


@pytest.fixture
def screen(base):
    return base.cameras[0].resized(SIZE[1], SIZE[0])


@pytest.fixture
def page(stage, base, monkeypatch, tmp_path):
    element = lambda *_, initial_value=None, **__: MagicMock(value=initial_value)  # noqa: E731
    server = MagicMock(**{f"gui.add_{kind}.side_effect": element for kind in ("dropdown", "slider", "number")})
    monkeypatch.setattr(live_page, "served", lambda *_: server)
    base.cameras = [replace(view, name="r_0") for view in base.cameras]
    return Page(stage, PageSettings("127.0.0.1", 8080, "scene", [None], ["default"], lambda *_: tmp_path / "new.ply"))


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("viser", reason="viser is not installed")
    server = served("127.0.0.1", 0)
    yield server
    with without_words():
        server.stop()
