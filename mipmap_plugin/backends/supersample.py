"""N x N supersampling on top of any backend: the ground truth that screen filters are compared with."""

from __future__ import annotations

from dataclasses import replace

from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians


def render(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects, *, clamped: bool = False) -> Rendered:
    """The view of `camera`, averaged over `effects.supersampling`² samples per pixel.

    The screen filter keeps its size in output pixels. With eps2d = 0.3·s² and N = 1/s this is the box-filtered render of the base.
    `clamped`: samples are clamped to 0..1 before they are averaged, as a screen would show them.
    """
    n = effects.supersampling
    if n == 1:
        return backend.render(gaussians, camera, effects)
    fine = camera.resized(camera.width * n, camera.height * n)
    finer = replace(effects, supersampling=1, eps2d=effects.eps2d * n**2, settings=effects.settings.finer(n))
    rendered = backend.render(gaussians, fine, finer)
    samples = (rendered.image.clamp(0, 1) if clamped else rendered.image), rendered.alpha
    return Rendered(*(each.unflatten(1, (-1, n)).unflatten(0, (-1, n)).mean(dim=(1, 3)) for each in samples))


def of_samples(camera: Camera, n: int) -> Camera:
    """The camera with the `zoom` of its n x n samples, by which levels of detail are chosen, but no finer than at the base's scale."""
    zoom = min(camera.zoom * n, max(camera.base_zoom, camera.zoom))
    return camera if zoom == camera.zoom else replace(camera, zoom=zoom)
