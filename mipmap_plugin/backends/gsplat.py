"""gsplat (1.5 and later) as a backend: the user's own CUDA rasterizer, asked for the reference's image.

Never run on a GPU by its author. What gsplat is asked for was proved with its own torch twins in place of its CUDA kernels; what it
draws otherwise than the reference was measured so (`tests/test_gsplat_backend.py`):

- the largest alpha is 0.999 in 1.5 and 0.99, the reference's, in 1.6: an opaque splat's center is up to 0.009 brighter;
- "antialiased" leaves a flat or needle-shaped splat no least share of its light in 1.5, and 0.005, the reference's, in 1.6. "mip", whose
  least share nobody sees, is exact in 1.5 and at most 0.005 of alpha too bright in 1.6;
- needles with axes 10⁶ times apart lose their digits, for the determinant of their covariance is a difference;
- a pixel ends where it would keep at most 1e-4, here less than 1e-4: no image shows it;
- 3.33 standard deviations, where gsplat ends a splat, is where an opaque one falls below 1/255: nothing is cut that the reference draws.

Three differences are taken out here: the eye is subtracted before gsplat sees the splats, so that worlds far from their origin keep
their digits; a splat on the near plane is not drawn; a zero quaternion is the identity, and rows that are not finite are left out.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import shutil
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.guests import NO_CUDA, UNTRIED, Asked, sound, turned
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

NO_GSPLAT = "it needs gsplat: pip install 'mipmap-plugin[gsplat]'"
NOT_COMPILED = "gsplat's CUDA part is not compiled and there is no nvcc to compile it with; install its wheel for your torch and CUDA"


class GsplatBackend:
    """Asks `gsplat.rasterization` for one image. gsplat is imported, and compiled where that was not done, at the first image."""

    name = "gsplat"
    api_version = API_VERSION
    speed = 40
    note = UNTRIED
    capabilities = Capabilities(
        devices=frozenset({"cuda"}), dtypes=frozenset({torch.float32}), screen_filters=frozenset({"classic", "antialiased", "mip"})
    )

    def __init__(self) -> None:
        self._asked = Asked(self)

    def lacking(self, needs: Needs) -> list[str]:
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, where the request is not for this backend.

        The host waits for the GPU twice: here for whether any row is broken, in gsplat for the number of (splat, tile) pairs.
        """
        self._asked.refuse(Needs.of(gaussians, effects, gradients=True))
        gaussians = sound(gaussians)
        if len(gaussians) == 0:
            return ReferenceBackend().render(gaussians, camera, effects)
        image, alpha, _ = importlib.import_module("gsplat").rasterization(**arguments(gaussians, camera, effects))
        return Rendered(image[0], alpha[0, ..., 0])


def missing() -> list[str]:
    """What this machine lacks, in sentences."""
    found = importlib.util.find_spec("gsplat")
    if found is None:
        return [NO_GSPLAT]
    if not torch.cuda.is_available():
        return [NO_CUDA]
    folders = [Path(folder) for folder in found.submodule_search_locations or ()]
    compiled = any(file.suffix in {".so", ".pyd"} for folder in folders for file in folder.glob("csrc.*"))
    return [] if compiled or _nvcc() else [NOT_COMPILED]


def arguments(gaussians: Gaussians, camera: Camera, effects: Effects) -> dict[str, Any]:
    """What `gsplat.rasterization` is to be called with, for N > 0 splats and one camera."""
    viewmat = torch.eye(4, dtype=camera.viewmat.dtype)
    viewmat[:3, :3] = camera.viewmat[:3, :3]
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    means = gaussians.means
    return {
        "means": means - camera.center.to(means),
        "quats": turned(gaussians.quats),
        "scales": gaussians.scales,
        "covars": gaussians.covariances,
        "opacities": gaussians.opacities,
        "colors": gaussians.sh,
        "sh_degree": min(effects.sh_degree, gaussians.sh_degree),
        "viewmats": viewmat.to(means)[None],
        "Ks": means.new_tensor(intrinsics)[None],
        "width": camera.width,
        "height": camera.height,
        "near_plane": _just_above(effects.near_plane),
        "eps2d": effects.eps2d,
        "rasterize_mode": "classic" if effects.screen_filter == "classic" else "antialiased",
        "backgrounds": means.new_tensor(effects.background)[None],
        "packed": False,  # packing saves memory where few splats are in view, and makes the host wait once more
    }


def _just_above(near: float) -> float:
    """The next float32: gsplat draws what is at its near plane, and nothing should be drawn that is at `near`."""
    return float(torch.nextafter(torch.tensor(near), torch.tensor(math.inf)))


def _nvcc() -> bool:
    return shutil.which("nvcc") is not None or importlib.import_module("torch.utils.cpp_extension").CUDA_HOME is not None
