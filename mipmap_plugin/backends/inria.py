"""INRIA's `diff_gaussian_rasterization` as a backend, in both generations, if the user has built it. No code of it is included.

The arguments were verified with a stand-in that renders what they say (`tests/backends/test_inria_backend.py`), and on a GPU
with the older generation.
The rasterizer's conventions are fixed; requests are adapted to them:

- its near plane is 0.2: the scene is scaled so that the requested near plane lies there. The eye becomes the origin, so no digits are lost;
- its dilation is 0.3 px²: the difference is added to each splat as variance along the camera's x and y, which projects to just that;
- "antialiased" is native in the newer generation at 0.3 px²; otherwise opacities are compensated beforehand, as for "mip";
- its Jacobian is clamped around the optical axis, not around the image: where the principal point is far off center, a wider image
  that is centered at it is rendered and cropped;
- it returns no alpha: on request the splats are rendered once more, in white.

Remaining differences: a splat ends at three standard deviations of its longer axis, rounded up to whole 16-px tiles, where up to 0.011
of its opacity is left; the gradient of alpha ignores the clamp at 0.99, and that of the depth the clamp of the Jacobian, beyond the image's edge;
the gradient of a shape is attenuated by det²/(det² + 1e-7) of its dilated covariance, which matters below 0.1 px²; SH is limited to degree 3.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, CachedCheck, Capabilities, Needs, Rendered
from mipmap_plugin.backends.external import NO_CUDA, at_the_origin, finite_splats
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import with_type
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.filters import footprint
from mipmap_plugin.splatting.projection import covariances_of, project
from mipmap_plugin.splatting.rotations import unit_quaternions

PACKAGE = "diff_gaussian_rasterization"
NO_PACKAGE = f"it needs {PACKAGE}, which is built from INRIA's sources (for non-commercial use)"

# The rasterizer's constants.
NEAR = 0.2  # world units
NEAREST = 1e-4  # world units: nearer near planes are moved here, because the scene is scaled by NEAR ÷ near plane
AXIS_MARGIN = 0.3  # of half the image: how far beyond the image's edge, measured from the optical axis, the Jacobian is exact

OLDER = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix", "sh_degree", "campos",
         "prefiltered", "debug")  # fmt: skip
NEWER = (*OLDER, "antialiasing")


class InriaBackend:
    """Renders with INRIA's `GaussianRasterizer`, which is imported at first use, and only where there is a GPU."""

    name = "inria"
    api_version = API_VERSION
    speed = 20
    capabilities = Capabilities(
        devices=frozenset({"cuda"}),
        dtypes=frozenset({torch.float32}),
        screen_filters=frozenset({"classic", "antialiased", "mip"}),
        max_sh_degree=3,
    )

    def __init__(self) -> None:
        self._check = CachedCheck(self)

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, if this backend cannot serve the request."""
        self._check.require(gaussians, effects)
        gaussians = finite_splats(gaussians)
        if len(gaussians) == 0:
            return ReferenceBackend().render(gaussians, camera, effects)
        package = importlib.import_module(PACKAGE)
        frame = Frame.around(camera)
        camera = at_the_origin(frame.camera)
        gaussians = rescaled(gaussians, frame.camera, NEAR / max(effects.near_plane, NEAREST))
        native = is_native(effects, package.GaussianRasterizationSettings._fields)
        splats = splats_of(gaussians if native else filtered(gaussians, camera, effects))
        colors = {"shs": gaussians.sh}
        white = {"colors_precomp": torch.ones_like(gaussians.means)}

        def draw(background: tuple[float, float, float], colors: dict[str, Tensor]) -> Tensor:
            settings = package.GaussianRasterizationSettings(**settings_of(camera, effects, gaussians, background, package))
            image = package.GaussianRasterizer(raster_settings=settings)(**splats, **colors)[0]
            return frame.crop(image.permute(1, 2, 0))

        # The rasterizer returns no alpha: it is the image of white splats on black, rendered on first access.
        return Rendered(draw(effects.background, colors), lambda: draw((0.0, 0.0, 0.0), white)[..., 0])


def missing() -> list[str]:
    """What this machine lacks to run the backend; empty if nothing."""
    if importlib.util.find_spec(PACKAGE) is None:
        return [NO_PACKAGE]
    if not torch.cuda.is_available():
        return [NO_CUDA]
    try:
        fields = importlib.import_module(PACKAGE).GaussianRasterizationSettings._fields
    except Exception as error:  # an extension built for another torch or another GPU may fail in any way
        return [f"{PACKAGE} does not load: {with_type(error)}"]
    return [] if fields in (OLDER, NEWER) else [f"the {PACKAGE} here is a fork with other settings: {', '.join(fields)}"]


def is_native(effects: Effects, fields: tuple[str, ...]) -> bool:
    """Whether a rasterizer whose settings have these `fields` supports the screen filter natively."""
    supported = {"classic"} | ({"antialiased"} if "antialiasing" in fields else set())
    return effects.eps2d == DILATION and effects.screen_filter in supported


def settings_of(camera: Camera, effects: Effects, gaussians: Gaussians, background: tuple[float, float, float], package: Any) -> dict[str, Any]:
    """The rasterizer's settings for a camera at the origin. Its matrices act on row vectors, so they are transposed."""
    means = gaussians.means
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, :3] = torch.tensor([2 * camera.fx / camera.width, 0.0, 2 * camera.cx / camera.width - 1])
    projection[1, :3] = torch.tensor([0.0, 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1])
    projection[2:, 2] = 1.0  # the third row is not read, for there is no far plane
    settings = {
        "image_height": camera.height,
        "image_width": camera.width,
        "tanfovx": camera.width / camera.fx / 2,
        "tanfovy": camera.height / camera.fy / 2,
        "bg": means.new_tensor(background),
        "scale_modifier": 1.0,
        "viewmatrix": camera.viewmat.T.to(means).contiguous(),
        "projmatrix": (projection @ camera.viewmat).T.to(means).contiguous(),
        "sh_degree": min(effects.sh_degree, gaussians.sh_degree),
        "campos": means.new_zeros(3),
        "prefiltered": False,
        "debug": False,
    }
    fields = package.GaussianRasterizationSettings._fields
    native = is_native(effects, fields) and effects.screen_filter == "antialiased"
    return settings | ({"antialiasing": native} if "antialiasing" in fields else {})


def splats_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """The rasterizer's arguments for splats, except colors."""
    shape: dict[str, Tensor]
    if gaussians.covariances is None:
        rotations = unit_quaternions(gaussians.quats).contiguous()
        shape = {"scales": gaussians.scales.contiguous(), "rotations": rotations}  # its backward pass reads them as they lie in memory
    else:
        shape = {"cov3D_precomp": gaussians.covariances.flatten(1)[:, [0, 1, 2, 4, 5, 8]]}
    means = gaussians.means
    return {"means3D": means, "means2D": torch.zeros_like(means), "opacities": gaussians.opacities[:, None], **shape}


def rescaled(gaussians: Gaussians, camera: Camera, factor: float) -> Gaussians:
    """The splats moved so that the eye is the origin, then scaled by `factor`."""
    means = (gaussians.means - camera.center.to(gaussians.means)) * factor
    covariances = None if gaussians.covariances is None else gaussians.covariances * factor**2
    return replace(gaussians, means=means, scales=gaussians.scales * factor, covariances=covariances)


def filtered(gaussians: Gaussians, camera: Camera, effects: Effects) -> Gaussians:
    """Splats with covariances that, dilated by 0.3 px², have the footprints of `gaussians` under the screen filter of `effects`."""
    footprints = footprint(project(gaussians, camera, NEAR), gaussians.opacities, effects.screen_filter, effects.eps2d)
    rotation = camera.viewmat[:3, :3].to(gaussians.means)
    depths = gaussians.means @ rotation[2]
    # 1 px² along x or y at depth z is a variance of (z/fx)² or (z/fy)² along the camera's axes, wherever on the image the splat lies.
    axes = rotation[:2] / rotation.new_tensor([[camera.fx], [camera.fy]])
    added = (effects.eps2d - DILATION) * depths.square()[:, None, None] * (axes.T @ axes)
    return replace(gaussians, opacities=footprints.opacities, covariances=covariances_of(gaussians) + added)


@dataclass(frozen=True)
class Frame:
    """The camera that is rendered in place of another, and where the other's image lies in its image."""

    camera: Camera
    rows: slice
    columns: slice

    @classmethod
    def around(cls, camera: Camera) -> Frame:
        """The camera itself, or a wider one that is centered at the principal point if that is too far off center."""
        left, width = _centered(camera.width, camera.cx)
        top, height = _centered(camera.height, camera.cy)
        wider = replace(camera, width=width, height=height, cx=camera.cx + left, cy=camera.cy + top)
        return cls(wider, slice(top, top + camera.height), slice(left, left + camera.width))

    def crop(self, image: Tensor) -> Tensor:
        """The camera's own image [height, width, ...], cropped from the rendered one."""
        return image[self.rows, self.columns]


def _centered(size: int, center: float) -> tuple[int, int]:
    """(px to add in front, resulting size) so that `center` lies near the middle."""
    offset = 2 * center - size
    if abs(offset) <= AXIS_MARGIN * size:
        return 0, size
    added = math.ceil(abs(offset))
    return (added if offset < 0 else 0), size + added
