"""The contract of a backend: Gaussians + Camera + Effects -> Rendered, and the reasons why it cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import INTEGRATED, USUAL, Effect, Effects, RenderSettings
from mipmap_plugin.gaussians import Gaussians

# What a backend may have beyond the usual, by the names of RenderSettings, and what it is called.
SETTINGS = {
    "min_alpha": "another least alpha",
    "min_transmittance": "another least transmittance",
    "radius": "splats that end at a radius",
    "tile": "other tiles",
    "max_alpha": "another largest alpha",
    "fades": "splats that fade to 0",
    "max_color": "a largest color",
    "color_steps": "rounded colors",
    "radial": "splats in the order of their distance",
    "bucketed": "splats in the order of buckets of depth",
    "min_variance": "culling by size",
    "boxed": "culling by size along x and y",
    "min_contribution": "culling by contribution",
    "least_spread": "stretching of round splats",
    "max_half_axis": "a largest splat",
    "fits_picture": "splats no larger than the picture",
    "packing": "packing",
    "frozen_beyond": "projection that is frozen elsewhere or nowhere",
    "frame": "leaving out by the center",
    "picture_step": "pictures that are rounded after each splat",
}

# Of these, what screen filters that integrate have: the others are about a splat's weight at a point.
OF_INTEGRALS = frozenset(
    {"min_alpha", "min_transmittance", "radius", "tile", "max_color", "color_steps", "radial", "bucketed", "frozen_beyond", "frame", "packing"}
)

# Raised when `Backend.render` or the records below change in a way that an old backend cannot serve.
API_VERSION = 1


class Rendered:
    """One image. Differentiable in the Gaussians that it was rendered from."""

    def __init__(
        self,
        image: Tensor,  # [H, W, 3], background included, not clamped
        alpha: Tensor | Callable[[], Tensor],  # [H, W], 1 - transmittance; or what draws it, where it takes another pass
        depth: Tensor | None = None,  # [H, W] world units, where asked for (`geometry.depth`); a wrapped model adds this and what follows
        normals: Tensor | None = None,  # [H, W, 3] unit, world axes, where asked for (`geometry.normals`)
        effects: tuple[Effect, ...] = (),  # what was simulated for it and what was not
    ) -> None:
        self.image, self.depth, self.normals, self.effects, self._alpha = image, depth, normals, effects, alpha

    @property
    def alpha(self) -> Tensor:
        """[H, W]: 1 - transmittance, drawn when it is first asked for."""
        if callable(self._alpha):
            self._alpha = self._alpha()
        return self._alpha

    def but(self, **changes: Any) -> Rendered:
        """The same with other parts, by the names of the arguments above."""
        parts: dict[str, Any] = dict(image=self.image, alpha=self._alpha, depth=self.depth, normals=self.normals, effects=self.effects)
        return Rendered(**parts | changes)


@dataclass(frozen=True)
class Needs:
    """What a request asks of a backend."""

    device: str  # torch device type: "cpu", "cuda", ...
    dtype: torch.dtype
    gradients: bool
    sh_degree: int
    screen_filter: str
    covariances: bool = False
    settings: RenderSettings = USUAL

    @classmethod
    def of(cls, gaussians: Gaussians, effects: Effects, *, gradients: bool) -> Needs:
        means, given = gaussians.means, gaussians.covariances is not None
        return cls(means.device.type, means.dtype, gradients, effects.sh_degree, effects.screen_filter, given, effects.settings)


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do, as data."""

    devices: frozenset[str] | None  # torch device types; None: any
    dtypes: frozenset[torch.dtype]
    screen_filters: frozenset[str]
    gradients: bool = True
    max_sh_degree: int = 4
    covariances: bool = True
    settings: frozenset[str] = frozenset()  # of SETTINGS, what it has

    def lacking(self, needs: Needs) -> list[str]:
        """One sentence for each need that is not met; empty when all are."""
        reasons = []
        if self.devices is not None and needs.device not in self.devices:
            reasons.append(f"it runs on {', '.join(sorted(self.devices))}, not on {needs.device}")
        if needs.dtype not in self.dtypes:
            reasons.append(f"it computes in {', '.join(sorted(map(str, self.dtypes)))}, not in {needs.dtype}")
        if needs.gradients and not self.gradients:
            reasons.append("it has no gradients")
        if needs.sh_degree > self.max_sh_degree:
            reasons.append(f"it evaluates SH up to degree {self.max_sh_degree}, not {needs.sh_degree}")
        if needs.screen_filter not in self.screen_filters:
            reasons.append(f"it has the screen filters {', '.join(sorted(self.screen_filters))}, not {needs.screen_filter}")
        if needs.covariances and not self.covariances:
            reasons.append("it takes quaternions and scales, not covariances")
        return reasons + self._settings_lacking(needs)

    def _settings_lacking(self, needs: Needs) -> list[str]:
        changed = needs.settings.changed()
        absent = [SETTINGS[name] for name in changed if name not in self.settings]
        reasons = [f"it does not have {', '.join(absent)}, which the reference backend has"] if absent else []
        if needs.screen_filter in INTEGRATED and (pointwise := [SETTINGS[name] for name in changed if name not in OF_INTEGRALS]):
            reasons.append(f"the screen filter {needs.screen_filter} is not drawn with {', '.join(pointwise)}")
        return reasons


class Backend(Protocol):
    """What turns Gaussians into an image. One sample per pixel: supersampling, depth and normals are built on top (`supersample`, `geometry`)."""

    name: str
    api_version: int
    # Rank for `auto`: of those that lack nothing, the highest is taken. On a GPU 40 gsplat, 30 triton, 20 inria, 0 reference: what others
    # have measured before what nobody has, and INRIA's last, whose footprint and gradients are furthest from the reference's.
    speed: int
    # May have `note: str`, said wherever it is listed or taken.

    def lacking(self, needs: Needs) -> list[str]:
        """Why this backend cannot serve `needs`, in sentences; empty when it can."""

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`, [H, W, 3] and [H, W], on the device and in the dtype of `gaussians`."""
