"""Real viewers in a real browser: a PLY and cameras in, the pixels of their canvas out.

    with Browser() as browser:
        page = browser.open("spark", "output/bicycle.ply")
        images = page.draw(cameras, background=(1.0, 1.0, 1.0))

Needs Debian's `chromium`, Python's `playwright` and `npm ci` in this folder; `missing` says which of them is not there.
"""

from __future__ import annotations

import base64
import json
import shutil
import threading
from collections.abc import Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mipmap_plugin import Camera
from mipmap_plugin.levels.manifest import THREE_JS

HERE = Path(__file__).parent

# Software WebGL and WebGPU, as on a machine without a GPU.
FLAGS = (
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--force-color-profile=srgb"),
    *("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"),
)

# Milliseconds that one view may take: tens of thousands of splats on a processor, beside other work.
PATIENCE = 60_000

# World units between which a viewer's depth buffer lies; nothing of the pictures depends on it.
NEAR, FAR = 0.01, 1000.0

# dB of two pictures that differ by rounding.
ALIKE = 45.0

# Our name of a viewer's convention: its page, and the settings that are not its defaults.
VIEWERS: dict[str, tuple[str, dict[str, Any]]] = {
    "spark": ("spark", {}),
    "playcanvas": ("playcanvas", {}),
    "playcanvas-webgpu": ("playcanvas", {"device": "webgpu"}),
    "playcanvas-aa": ("playcanvas", {"antiAlias": True}),
    "supersplat-viewer": ("supersplat-viewer", {}),
    "gaussian-splats-3d": ("gaussian-splats-3d", {}),
    "babylon": ("babylon", {}),
    "gsplat-js": ("gsplat", {}),
    "three": ("three", {}),
}


class BrowserError(RuntimeError):
    """A viewer that did not draw, and why, in a sentence."""


def missing_browser() -> str:
    """What driving a browser lacks here, in a sentence; empty where nothing is missing."""
    if shutil.which("chromium") is None:
        return "there is no chromium here; `apt-get install chromium` brings it"
    if find_spec("playwright") is None:
        return "Python's playwright is not installed; `pip install playwright` brings it"
    return ""


def missing() -> str:
    """What the tests of viewers lack here, in a sentence; empty where nothing is missing."""
    if lacking := missing_browser():
        return lacking
    if not all((HERE / "node_modules" / package).is_dir() for package in ("playcanvas", "gsplat")):
        return "the viewers are not installed; `npm ci` in tests/browser brings them"
    return ""


class Browser:
    """Chromium without a window, and the local server of its pages. A context manager; raises BrowserError where something is missing."""

    def __enter__(self) -> Browser:
        from playwright.sync_api import sync_playwright

        if lacking := missing():
            raise BrowserError(lacking)
        self._files: dict[str, Path] = {}
        self._server = ThreadingHTTPServer(("localhost", 0), partial(_Handler, self._files))
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._playwright = sync_playwright().start()
        self._chromium = self._playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", *FLAGS])
        self._pages: dict[str, Any] = {}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._chromium.close()
        self._playwright.stop()
        self._server.shutdown()

    def open(self, viewer: str, ply: Path, **settings: Any) -> Page:
        """`ply`, or a .glb, in a viewer (a name of VIEWERS), which stays open; `settings` are the viewer's own, beside those of its name."""
        page, of_name = VIEWERS[viewer]
        url = f"/files/{len(self._files)}{Path(ply).suffix}"
        self._files[url] = Path(ply)
        shown = self._started(page, {**of_name, **settings})
        _told(viewer, shown, "url => viewer.open(url)", url)
        return Page(viewer, shown)

    def stream(self, viewer: str, folder: Path, component: dict[str, Any], **settings: Any) -> Page:
        """A folder of Streamed SOG in a viewer; `component`: settings of its splats, such as lodBaseDistance; `settings` as for `open`."""
        page, of_name = VIEWERS[viewer]
        url = self._served(folder)
        shown = self._started(page, {**of_name, **settings})
        _told(viewer, shown, "([url, component]) => viewer.open(url, component)", [f"{url}/lod-meta.json", component])
        return Page(viewer, shown)

    def alone(self, script: str, folder: Path) -> Any:
        """What the script `pages/{script}.js` tells of a folder."""
        return _told(script, self._started(script, {}), "url => viewer.told(url)", self._served(folder))

    def ladder(self, folder: Path) -> Page:
        """The folder of a ladder in Spark, by the module for three.js in it."""
        url, shown = self._served(folder), self._started("spark-levels", {})
        _told("spark", shown, "url => viewer.open(url)", f"{url}/{THREE_JS}")
        return Page("spark", shown)

    def tiles(self, folder: Path) -> Page:
        """A folder of 3D Tiles in Cesium."""
        url, shown = self._served(folder), self._started("cesium", {})
        _told("cesium", shown, "url => viewer.open(url)", f"{url}/tileset.json")
        return Page("cesium", shown)

    def _served(self, folder: Path) -> str:
        """The address of a folder."""
        url = f"/files/{len(self._files)}"
        self._files[url] = Path(folder)
        return url

    def visit(self, url: str) -> Any:
        """A new page at an address of this machine."""
        page = self._chromium.new_page(viewport={"width": 1000, "height": 1000}, device_scale_factor=1)
        page.set_default_timeout(PATIENCE)
        page.goto(url)
        return page

    def _started(self, page: str, settings: dict[str, Any]) -> Any:
        """The page of a viewer with these settings, started once: compiling its shaders costs more than a view."""
        key = page + json.dumps(settings, sort_keys=True)
        if key not in self._pages:
            self._pages[key] = shown = self.visit(f"http://localhost:{self._server.server_port}/pages/index.html")
            start = f"async settings => {{ window.viewer = await (await import('/pages/{page}.js')).start(settings) }}"
            _told(page, shown, start, settings)
        return self._pages[key]


class Page:
    """A viewer that shows one file, until another is opened in it."""

    def __init__(self, viewer: str, shown: Any) -> None:
        self._viewer, self._shown = viewer, shown

    def draw(self, cameras: Sequence[Camera], background: Sequence[float] = (0.0, 0.0, 0.0)) -> list[np.ndarray]:
        """[H, W, 3] float32 in 0..1 for each camera, in the canvas' own 8 bits. Raises BrowserError when a view takes over a minute."""
        return [self._drawn(camera, background) for camera in cameras]

    def levels(self) -> list[int]:
        """How many splats of each level the last picture has, of a streamed file."""
        return list(_told(self._viewer, self._shown, "() => viewer.levels()", None))

    def shown(self) -> tuple[int, float]:
        """Which level of a ladder in Spark the last picture shows, and at which zoom."""
        level, zoom = _told(self._viewer, self._shown, "() => viewer.shown()", None)
        return int(level), float(zoom)

    def place(self, position: Sequence[float], quaternion: Sequence[float], scale: float) -> None:
        """Put a ladder in Spark at a position, turned by a quaternion (x, y, z, w) and enlarged."""
        _told(self._viewer, self._shown, "place => viewer.place(...place)", [list(position), list(quaternion), scale])

    def chosen(self, cameras: Sequence[Camera]) -> list[list[str]]:
        """The tiles that Cesium shows from each camera: the names of their files."""
        return list(_told(self._viewer, self._shown, "views => viewer.chosen(views)", [_view(camera, (0.0, 0.0, 0.0)) for camera in cameras]))

    def _drawn(self, camera: Camera, background: Sequence[float]) -> np.ndarray:
        text = _told(self._viewer, self._shown, "view => viewer.draw(view)", _view(camera, background))
        pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(camera.height, camera.width, 4)
        return pixels[::-1, :, :3].astype(np.float32) / 255


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(image - other).mean(), 1e-12)))


def at(cameras: Sequence[Camera], scale: float) -> list[Camera]:
    return [camera.zoomed(scale) for camera in cameras]


def projection(camera: Camera) -> np.ndarray:
    """[4, 4]: OpenGL's projection matrix of a pinhole, from fx, fy, cx, cy."""
    width, height = camera.width, camera.height
    depth = [-(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)]
    return np.array([
        [2 * camera.fx / width, 0, 1 - 2 * camera.cx / width, 0],
        [0, 2 * camera.fy / height, 2 * camera.cy / height - 1, 0],
        [0, 0, *depth],
        [0, 0, -1, 0],
    ])  # fmt: skip


def opengl(camera: Camera) -> np.ndarray:
    """[4, 4]: world to camera with OpenGL's axes, y up and z backwards."""
    return np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.viewmat.numpy()


def _view(camera: Camera, background: Sequence[float]) -> dict[str, Any]:
    """What the pages call a view."""
    matrices = {"projection": projection(camera), "viewmat": opengl(camera)}
    view = {name: matrix.T.ravel().tolist() for name, matrix in matrices.items()}
    return view | {"width": camera.width, "height": camera.height, "background": list(background)}


def _told(viewer: str, shown: Any, script: str, argument: Any) -> Any:
    """What a script on a page answers. Raises BrowserError when it throws, or has not answered after PATIENCE."""
    bounded = f"""argument => Promise.race([
        Promise.resolve(argument).then({script}),
        new Promise((_, reject) => setTimeout(() => reject(new Error('no picture after {PATIENCE / 1000:g} s')), {PATIENCE})),
    ])"""
    from playwright.sync_api import Error

    try:
        return shown.evaluate(bounded, argument)
    except Error as error:
        raise BrowserError(f"{viewer}: {error.message.splitlines()[0]}") from error


class _Handler(SimpleHTTPRequestHandler):
    """This folder, and the files that were opened."""

    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm"}

    def __init__(self, files: dict[str, Path], *arguments: Any) -> None:
        self._files = files
        super().__init__(*arguments, directory=str(HERE))

    def translate_path(self, path: str) -> str:
        if path in self._files:
            return str(self._files[path])
        folder, _, name = path.removeprefix("/files/").partition("/")
        opened = self._files.get(f"/files/{folder}")
        return str(opened / name) if opened and name else super().translate_path(path)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: a test's output is its own."""
