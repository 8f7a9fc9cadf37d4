"""gsplat as its own users call it, without what our backend adds: the yardstick of all times."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from mipmap_plugin import Camera, Effects, Gaussians
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.base import API_VERSION, Backend, Needs, Rendered

ITSELF = "gsplat itself"


class Itself:
    """One view by `gsplat.rasterization`, whatever the splats hold."""

    name, api_version, speed = ITSELF, API_VERSION, 0

    def lacking(self, needs: Needs) -> list[str]:
        """As our own backend."""
        return get_backend("gsplat").lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`."""
        images, alphas = rasterized(gaussians, (camera,), effects)
        return Rendered(images[0], alphas[0, ..., 0])


def find(name: str) -> Backend:
    """The backend of this name, or gsplat itself."""
    return Itself() if name == ITSELF else get_backend(name)


def with_itself(names: Sequence[str]) -> list[str]:
    """The names, and gsplat itself beside gsplat."""
    return [other for name in names for other in ((name, ITSELF) if name == "gsplat" else (name,))]


def rasterized(gaussians: Gaussians, cameras: Sequence[Camera], effects: Effects) -> tuple[Tensor, Tensor]:
    """Images [C, H, W, 3] and alphas [C, H, W, 1] of cameras of one size, in one call."""
    from gsplat import rasterization

    g, first = gaussians, cameras[0]
    mode = "classic" if effects.screen_filter == "classic" else "antialiased"
    lens = (*lenses(tuple(cameras), g.means.device), first.width, first.height)
    drawn = rasterization(
        g.means, g.quats, g.scales, g.opacities, g.sh, *lens,
        eps2d=effects.eps2d, near_plane=effects.near_plane, sh_degree=effects.sh_degree, packed=False, rasterize_mode=mode,
    )  # fmt: skip
    return drawn[0], drawn[1]


@lru_cache(maxsize=64)
def lenses(cameras: tuple[Camera, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """World-to-camera matrices and intrinsics, which stay on the device, as in gsplat's own trainer."""
    intrinsics = torch.tensor([[[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in cameras], dtype=torch.float32)
    return torch.stack([camera.viewmat for camera in cameras]).float().to(device), intrinsics.to(device)
