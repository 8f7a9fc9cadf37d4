"""The live view of the embedded scene in Chromium: the command in a process of its own, and what a person does on its page.

    python tests/browser/live.py docs/view.png

takes the picture of docs/view.md.
"""

import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from browser import FLAGS, missing_browser

# Milliseconds that anything on the page may take, with kernels compiled for the first time beside other work.
PATIENCE = 240_000

# The process of the command, in which Ctrl-C is heard also where a shell that started it in the background said not to.
COMMAND = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); from mipmap_plugin.cli import main; sys.exit(main())"

# Looks in a row, half a second apart, at which a picture is the same that is called still.
LOOKS = 4

WINDOW = {"width": 1200, "height": 800}


def missing() -> str:
    """What these tests lack here, in a sentence; empty where nothing is missing."""
    return missing_browser() or ("" if find_spec("viser") else 'viser is not installed; `pip install ".[view]"` brings it')


def embedded(folder: Path) -> Path:
    """A copy of the embedded scene as a model folder."""
    home, ply = Path(str(files("mipmap_plugin.demo"))), folder / "point_cloud/iteration_30000/point_cloud.ply"
    ply.parent.mkdir(parents=True)
    shutil.copy(home / "base.ply", ply)
    shutil.copy(home / "cameras.json", folder)
    (folder / "cfg_args").write_text("Namespace(sh_degree=3, resolution=-1, white_background=True, eval=True)")
    return folder


@contextmanager
def serving(words: Sequence[object]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`mipmap-plugin view` with these words, and the address that it tells."""
    command = [sys.executable, "-c", COMMAND, "view", *map(str, words), "--port", "0", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process, re.match(r"http://\S+", process.stdout.readline())[0]
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


class LivePage:
    """The page, by what is written on it."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        page.set_default_timeout(PATIENCE)
        page.goto(address)
        self.wait_for("splats")
        if (notice := page.get_by_text("Software WebGL rendering detected")).count():  # of viser, as there is no GPU
            notice.locator("xpath=ancestor::*[.//button][1]").get_by_role("button").click()
            notice.wait_for(state="detached")

    def text(self) -> str:
        """The panel's words."""
        return self.page.inner_text("body")

    def wait_for(self, words: str) -> str:
        """Wait until the panel says something (a regular expression), and return the line."""
        end = time.monotonic() + PATIENCE / 1000
        while not (found := re.search(f".*{words}.*", self.text())):
            assert time.monotonic() < end, f"{words!r} is not in {self.text()}"
            time.sleep(0.1)
        return found[0]

    def becomes(self, condition: Callable[[], bool]) -> bool:
        """Whether something holds sooner or later; what is done on the page takes a while to show, longer on a busy machine."""
        end = time.monotonic() + PATIENCE / 1000
        while not (holds := condition()) and time.monotonic() < end:
            time.sleep(0.2)
        return holds

    def zoom(self) -> float:
        """The zoom of the picture."""
        return float(re.search(r"×([\d.e-]+) ·", self.text())[1])

    def stop(self) -> float:
        """Where the slider of zooms is, in powers of two."""
        return float(self.page.get_by_role("slider").first.get_attribute("aria-valuenow"))

    def choose(self, label: str, option: str) -> None:
        """Choose from a list, and wait until it is closed."""
        self.page.get_by_label(label, exact=True).first.click()
        chosen = self.page.get_by_role("option", name=option, exact=True)
        chosen.click()
        chosen.wait_for(state="hidden")

    def press(self, button: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=button, exact=True).click()

    def slide(self, steps: int, slider: int = 0) -> None:
        """Move a slider by keys: that of zooms, or with 1 that of moments. Each key focuses it anew: a list that closes takes the focus."""
        for _ in range(abs(steps)):
            self.page.get_by_role("slider").nth(slider).press("ArrowRight" if steps > 0 else "ArrowLeft")

    def box(self) -> dict[str, float]:
        """Where the picture is, px."""
        return self.page.locator("canvas").first.bounding_box()

    def picture(self) -> bytes:
        """The picture as a PNG, as it is now."""
        return self.page.screenshot(clip=self.box())

    def still(self) -> bytes:
        """The picture as a PNG, once neither it nor the words beside it change any more."""
        looks: list[tuple[bytes, str]] = []
        while len(looks) < LOOKS or len(set(looks[-LOOKS:])) > 1:
            looks.append((self.picture(), self.text()))
            time.sleep(0.5)
        return looks[-1][0]


def take(path: Path) -> None:
    """The picture of docs/view.md: the embedded scene at about x1/2 in Spark, adapted on the page."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright, serving([embedded(Path(folder) / "demo")]) as (_, address):
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", *FLAGS])
        live = LivePage(chromium.new_page(viewport={"width": 1150, "height": 900}), address)
        live.choose("Enlarge pixels", "4")
        live.choose("Drawn by", "spark")
        live.slide(-10)
        live.press("Adapt for this picture")
        live.wait_for("→")
        live.page.mouse.move(200, 700)
        live.still()
        live.page.screenshot(path=path)


if __name__ == "__main__":
    take(Path(sys.argv[1]))
