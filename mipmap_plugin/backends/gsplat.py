"""gsplat (1.5 and later) as a backend: the user's own installation, called so that it renders the reference's image.

The arguments, and the differences from the reference below, were verified with gsplat 1.5.3 on a GPU, and are with its torch implementations
in place of its CUDA kernels (`tests/backends/test_gsplat_backend.py`):

- the largest alpha is 0.999 in 1.5 and 0.99, as in the reference, in 1.6: an opaque splat's center is up to 0.009 brighter;
- the compensation of "antialiased" has no lower bound in 1.5, and the reference's, 0.005, in 1.6. "mip", whose lower bound is
  invisible, is exact in 1.5; in 1.6 its alpha is at most 0.005 too large;
- splats whose axes differ by a factor of 10⁶ lose precision, because the determinant of their covariance is a difference;
- a pixel stops where its transmittance would be at most 1e-4, here less than 1e-4; this is invisible;
- gsplat ends a splat at 3.33 standard deviations, where an opaque one falls below 1/255: nothing that the reference draws is cut.

Three differences are removed here: the eye is subtracted beforehand, which keeps precision far from the world's origin; a splat on the
near plane is not drawn; a zero quaternion is the identity, and splats that are not finite are left out.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.backends.base import API_VERSION, CachedCheck, Capabilities, Needs, Rendered
from mipmap_plugin.backends.external import NO_CUDA, at_the_origin, finite_splats
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable, brief, install
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import unit_quaternions

NO_GSPLAT = f"it needs gsplat; {install('gsplat')}"
CUDA_PART = "gsplat.cuda._backend"
NOT_COMPILED = "gsplat's CUDA part is not compiled and there is no nvcc to compile it with; install its wheel for your torch and CUDA"


class GsplatBackend:
    """Renders with `gsplat.rasterization`. gsplat is imported, and compiled if necessary, at the first image."""

    name = "gsplat"
    api_version = API_VERSION
    speed = 40
    capabilities = Capabilities(
        devices=frozenset({"cuda"}), dtypes=frozenset({torch.float32}), screen_filters=frozenset({"classic", "antialiased", "mip"})
    )

    def __init__(self) -> None:
        self._check = CachedCheck(self)

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if this backend cannot serve the request.

        The host synchronizes with the GPU twice: here for whether all splats are finite, in gsplat for the number of (splat, tile) pairs.
        """
        self._check.require(gaussians, effects)
        if reason := unloadable():
            raise BackendUnavailable(f"backend 'gsplat' cannot do this: {reason}")
        gaussians = finite_splats(gaussians)
        if len(gaussians) == 0:
            return ReferenceBackend().render(gaussians, camera, effects)
        image, alpha, _ = importlib.import_module("gsplat").rasterization(**arguments(gaussians, camera, effects))
        return Rendered(image[0], alpha[0, ..., 0])


def missing() -> list[str]:
    """What this machine lacks to run the backend; empty if nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None:
        return [NO_GSPLAT]
    if not torch.cuda.is_available():
        return [NO_CUDA]
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    compiled = any(file.suffix in {".so", ".pyd"} for folder in folders for file in folder.glob("csrc.*"))
    return [] if compiled or _nvcc() else [NOT_COMPILED]


@cache
def unloadable() -> str:
    """Why gsplat's CUDA part, which compiles for minutes when it is first imported, does not load; empty if it does."""
    try:
        if importlib.util.find_spec(CUDA_PART) is None:  # in a version that keeps it elsewhere; this imports gsplat
            return ""
        loaded = getattr(importlib.import_module(CUDA_PART), "_C", None) is not None
    except Exception as error:  # compilers and linkers fail in any way
        advice = "install its wheel for your torch and CUDA, or choose another backend"
        return f"gsplat's CUDA part does not compile or load here ({brief(error)}); {advice}"
    return "" if loaded else NOT_COMPILED


def arguments(gaussians: Gaussians, camera: Camera, effects: Effects) -> dict[str, Any]:
    """The arguments of `gsplat.rasterization` for N > 0 splats and one camera."""
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    means = gaussians.means
    return {
        "means": means - camera.center.to(means),
        "quats": unit_quaternions(gaussians.quats),  # the norm, by which gsplat divides, may underflow float32
        "scales": gaussians.scales,
        "covars": gaussians.covariances,
        "opacities": gaussians.opacities,
        "colors": gaussians.sh,
        "sh_degree": min(effects.sh_degree, gaussians.sh_degree),
        "viewmats": at_the_origin(camera).viewmat.to(means)[None],
        "Ks": means.new_tensor(intrinsics)[None],
        "width": camera.width,
        "height": camera.height,
        "near_plane": _just_above(effects.near_plane),
        "eps2d": effects.eps2d,
        "rasterize_mode": "classic" if effects.screen_filter == "classic" else "antialiased",
        "backgrounds": means.new_tensor(effects.background)[None],
        "packed": False,  # packing saves memory where few splats are in view, but synchronizes once more
    }


def _just_above(near: float) -> float:
    """The next float32 above `near`: gsplat draws splats that lie on its near plane, the reference does not."""
    return float(torch.nextafter(torch.tensor(near), torch.tensor(math.inf)))


def _nvcc() -> bool:
    return shutil.which("nvcc") is not None or importlib.import_module("torch.utils.cpp_extension").CUDA_HOME is not None
