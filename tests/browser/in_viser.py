"""viser in a real browser: its server in Python sends splats to a page, and asks the page for pictures.

    with Browser() as browser, in_viser(browser, splats) as shown:
        image = drawn(*shown, camera, background=(1.0, 1.0, 1.0))
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from browser import PATIENCE, Browser, BrowserError

from mipmap_plugin import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import quaternions, rotations

# Seconds in which the page has the splats, and they have grown to their sizes.
GROWING = 3.0

# px: the least side of the page's window; and how many of its frames are awaited once it has another shape.
WINDOW, FRAMES = 400, 5

LATER = "async frames => { while (frames-- > 0) await new Promise(requestAnimationFrame) }"


@contextmanager
def in_viser(browser: Browser, splats: Gaussians) -> Iterator[tuple[Any, Any]]:
    """A page of viser that shows the splats, and its server's handle of it. Raises BrowserError if the page does not connect."""
    import viser

    server = viser.ViserServer(host="localhost", port=0, verbose=False)
    page = browser.visit(f"http://localhost:{server.get_port()}")
    try:
        _wait(page, server.get_clients)
        axes = (rotations(splats.quats) * splats.scales[:, None]).numpy()
        colors = (0.5 + C0 * splats.sh[:, 0]).clamp(0, 1).numpy()
        server.scene.add_gaussian_splats("/splats", splats.means.numpy(), axes @ axes.transpose(0, 2, 1), colors, splats.opacities[:, None].numpy())
        page.wait_for_timeout(1000 * GROWING)
        yield page, next(iter(server.get_clients().values()))
    finally:
        page.close()
        server.stop()


def drawn(page: Any, client: Any, camera: Camera, background: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """[H, W, 3] float32 in 0..1. viser's cameras have square pixels, and the principal point in the middle."""
    rotation, fov = camera.viewmat[:3, :3].T, 2 * math.atan(camera.height / 2 / camera.fy)
    position = (-rotation @ camera.viewmat[:3, 3]).numpy()
    # Whatever the camera of a picture, splats are projected by the window's field of view and shape.
    times = math.ceil(WINDOW / min(camera.width, camera.height))
    size = camera.width * times, camera.height * times
    page.set_viewport_size({"width": size[0], "height": size[1]})
    client.camera.fov = fov
    _wait(page, lambda: (client.camera.image_width, client.camera.image_height) == size)
    page.evaluate(LATER, FRAMES)
    view = {"wxyz": quaternions(rotation[None])[0].numpy(), "position": position, "fov": fov}
    image = client.get_render(camera.height, camera.width, transport_format="png", timeout=PATIENCE / 1000, **view)
    color, alpha = np.split(image.astype(np.float32) / 255, [3], axis=2)
    return color * alpha + (1 - alpha) * np.float32(background)


def _wait(page: Any, condition: Callable[[], Any]) -> None:
    """Until a condition on what the page tells its server holds. Raises BrowserError if that takes longer than PATIENCE."""
    deadline = time.monotonic() + PATIENCE / 1000
    while not condition():
        if time.monotonic() > deadline:
            raise BrowserError(f"viser: its page did not answer in {PATIENCE / 1000:g} s")
        page.wait_for_timeout(100)
