"""INRIA's `diff_gaussian_rasterization` as a backend, in both generations, where the user has built it. Nothing of it is here but its arguments.

Never run on a GPU by its author. What it is asked for was proved with a stand-in that draws what the arguments say
(`tests/test_inria_backend.py`). Its own conventions are fixed; these are served around them:

- its near plane is 0.2: the world is sized so that the one asked for lies there. The eye becomes the origin, so that no digits are lost;
- its dilation is 0.3 px²: the rest is given to each splat as variance along the camera's x and y, which projects to just that;
- "antialiased" is its own in the newer generation at 0.3 px²; else the opacities are dimmed before it sees them, as for "mip";
- its Jacobian freezes around the optical axis, not around the image: where the principal point is far off center, a wider image with
  that point in its middle is drawn, and cut;
- it has no alpha: where one is asked for, the splats are drawn once more, all white.

What stays: a splat ends at three standard deviations of its longer axis, rounded up to whole 16-px tiles, where up to 0.011 of its
opacity is left; alpha's gradient passes through the cap of 0.99; the gradient of a shape fades as det²/(det² + 1e-7) of its
dilated covariance, which matters below 0.1 px²; SH ends at degree 3.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.guests import NO_CUDA, UNTRIED, Asked, sound, turned
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import DILATION, Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.filters import footprint
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.rotations import rotations

PACKAGE = "diff_gaussian_rasterization"
NO_PACKAGE = f"it needs {PACKAGE}, which is built from INRIA's sources (for non-commercial use)"

# The rasterizer's own numbers.
NEAR = 0.2  # world units
NEAREST = 1e-4  # world units: a near plane closer than this is taken to be there, for the world grows as it comes closer
AXIS_MARGIN = 0.3  # of half the image: how far from the optical axis, beyond half the image's width, its Jacobian is exact

OLDER = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix", "sh_degree", "campos",
         "prefiltered", "debug")  # fmt: skip
NEWER = (*OLDER, "antialiasing")


class InriaBackend:
    """Asks `GaussianRasterizer` for one image. Imported when it is asked for and there is a GPU."""

    name = "inria"
    api_version = API_VERSION
    speed = 20
    note = UNTRIED
    capabilities = Capabilities(
        devices=frozenset({"cuda"}),
        dtypes=frozenset({torch.float32}),
        screen_filters=frozenset({"classic", "antialiased", "mip"}),
        max_sh_degree=3,
    )

    def __init__(self) -> None:
        self._asked = Asked(self)

    def lacking(self, needs: Needs) -> list[str]:
        return missing() + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Raises BackendUnavailable, an ImportError, where the request is not for this backend."""
        self._asked.refuse(Needs.of(gaussians, effects, gradients=True))
        gaussians = sound(gaussians)
        if len(gaussians) == 0:
            return ReferenceBackend().render(gaussians, camera, effects)
        package = importlib.import_module(PACKAGE)
        frame = Frame.around(camera)
        camera = at_the_origin(frame.camera)
        gaussians = sized(gaussians, frame.camera, NEAR / max(effects.near_plane, NEAREST))
        native = is_native(effects, package.GaussianRasterizationSettings._fields)
        splats = splats_of(gaussians if native else filtered(gaussians, camera, effects))
        colors = {"shs": gaussians.sh}
        white = {"colors_precomp": torch.ones_like(gaussians.means)}

        def draw(background: tuple[float, float, float], painted: dict[str, Tensor]) -> Tensor:
            settings = package.GaussianRasterizationSettings(**settings_of(camera, effects, gaussians, background, package))
            image = package.GaussianRasterizer(raster_settings=settings)(**splats, **painted)[0]
            return frame.cut(image.permute(1, 2, 0))

        # This rasterizer has no alpha of its own: it is what white splats on black show, in a pass that most never ask for.
        return Rendered(draw(effects.background, colors), lambda: draw((0.0, 0.0, 0.0), white)[..., 0])


def missing() -> list[str]:
    """What this machine lacks, in sentences."""
    if importlib.util.find_spec(PACKAGE) is None:
        return [NO_PACKAGE]
    if not torch.cuda.is_available():
        return [NO_CUDA]
    try:
        fields = importlib.import_module(PACKAGE).GaussianRasterizationSettings._fields
    except Exception as error:  # an extension built for another torch or another GPU may fail in any way
        return [f"{PACKAGE} does not load: {type(error).__name__}: {error}"]
    return [] if fields in (OLDER, NEWER) else [f"the {PACKAGE} here is a fork with other settings: {', '.join(fields)}"]


def is_native(effects: Effects, fields: tuple[str, ...]) -> bool:
    """Whether a rasterizer with these settings has the screen filter itself."""
    has = {"classic"} | ({"antialiased"} if "antialiasing" in fields else set())
    return effects.eps2d == DILATION and effects.screen_filter in has


def settings_of(camera: Camera, effects: Effects, gaussians: Gaussians, background: tuple[float, float, float], package: Any) -> dict[str, Any]:
    """The rasterizer's settings for a camera in the origin. Matrices are for row vectors, so they are transposed."""
    means = gaussians.means
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, :3] = torch.tensor([2 * camera.fx / camera.width, 0.0, 2 * camera.cx / camera.width - 1])
    projection[1, :3] = torch.tensor([0.0, 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1])
    projection[2:, 2] = 1.0  # nobody reads the third row: no far plane is asked for
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
    """The rasterizer's words for splats, colors aside."""
    shape: dict[str, Tensor]
    if gaussians.covariances is None:
        quats = turned(gaussians.quats)
        shape = {"scales": gaussians.scales, "rotations": quats / quats.norm(dim=1, keepdim=True)}
    else:
        shape = {"cov3D_precomp": gaussians.covariances.flatten(1)[:, [0, 1, 2, 4, 5, 8]]}
    means = gaussians.means
    return {"means3D": means, "means2D": torch.zeros_like(means), "opacities": gaussians.opacities[:, None], **shape}


def at_the_origin(camera: Camera) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = camera.viewmat[:3, :3]
    return camera.looking_from(viewmat, camera.name)


def sized(gaussians: Gaussians, camera: Camera, size: float) -> Gaussians:
    """The splats of a world `size` times as large, with the eye in its origin."""
    means = (gaussians.means - camera.center.to(gaussians.means)) * size
    given = gaussians.covariances
    return replace(gaussians, means=means, scales=gaussians.scales * size, covariances=None if given is None else given * size**2)


def filtered(gaussians: Gaussians, camera: Camera, effects: Effects) -> Gaussians:
    """Splats that look, under a dilation of 0.3 px² alone, as `gaussians` do under the screen filter of `effects`; covariances [N, 3, 3]."""
    feet = footprint(project(gaussians, camera, NEAR), gaussians.opacities, effects.screen_filter, effects.eps2d)
    rotation = camera.viewmat[:3, :3].to(gaussians.means)
    depths = gaussians.means @ rotation[2]
    # px² along x and y of a splat at depth z are (z/fx)² and (z/fy)² of the world's along the camera's axes, wherever it is on the image.
    axes = rotation[:2] / rotation.new_tensor([[camera.fx], [camera.fy]])
    more = (effects.eps2d - DILATION) * depths.square()[:, None, None] * (axes.T @ axes)
    given = gaussians.covariances
    if given is None:
        factor = rotations(gaussians.quats) * gaussians.scales[:, None, :]
        given = factor @ factor.mT
    return replace(gaussians, opacities=feet.opacities, covariances=given + more)


@dataclass(frozen=True)
class Frame:
    """What is drawn for a camera, and where the camera's own image lies in it."""

    camera: Camera
    left: int  # px
    top: int  # px
    width: int  # px
    height: int  # px

    @classmethod
    def around(cls, camera: Camera) -> Frame:
        """The camera itself, or one with its principal point in the middle where that would lie too far off."""
        left, width = _centered(camera.width, camera.cx)
        top, height = _centered(camera.height, camera.cy)
        wider = replace(camera, width=width, height=height, cx=camera.cx + left, cy=camera.cy + top)
        return cls(wider, left, top, camera.width, camera.height)

    def cut(self, image: Tensor) -> Tensor:
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


def _centered(size: int, center: float) -> tuple[int, int]:
    """px to add before, and the size that results, so that `center` lies near the middle."""
    off = 2 * center - size
    if abs(off) <= AXIS_MARGIN * size:
        return 0, size
    more = math.ceil(abs(off))
    return (more if off < 0 else 0), size + more
