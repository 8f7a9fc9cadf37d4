"""What a backend draws, after a look at whether it keeps its contract."""

from __future__ import annotations

from torch import Tensor

from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import PluginError
from mipmap_plugin.gaussians import Gaussians


def drawn(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
    """The view of `camera` by a backend. Raises PluginError if it returns anything else than an image of the camera's size."""
    rendered = backend.render(gaussians, camera, effects)
    image, wanted = getattr(rendered, "image", None), (*camera.size, 3)
    if not isinstance(rendered, Rendered) or not isinstance(image, Tensor) or tuple(image.shape) != wanted:
        got = f"an image {list(image.shape)}" if isinstance(image, Tensor) else f"a {type(rendered).__name__}"
        raise PluginError(f"backend {backend.name!r} has to return a Rendered with an image {list(wanted)}; it returned {got}")
    return rendered
