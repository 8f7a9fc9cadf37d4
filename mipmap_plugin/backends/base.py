"""The contract of a backend: Gaussians + Camera + Effects -> Rendered, and the reasons why it cannot serve a request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effect, Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.screen_filters import INTEGRATED

# Render settings other than the default that a backend may support: field of RenderSettings -> its name in messages.
SETTINGS = {
    "min_alpha": "another least alpha",
    "min_transmittance": "another least transmittance",
    "radius": "splats that end at a radius",
    "tile": "another tile size",
    "max_alpha": "another largest alpha",
    "fades": "splats that fade to 0",
    "max_color": "a largest color",
    "color_steps": "rounded colors",
    "radial": "sorting by distance",
    "bucketed": "sorting by buckets of depth",
    "even_buckets": "sorting by even buckets of depth",
    "min_variance": "culling by size",
    "boxed": "culling by size along x and y",
    "min_contribution": "culling by contribution",
    "rooted": "culling by the root of opacity · det",
    "least_spread": "stretching of round splats",
    "level_below": "level stretching",
    "max_half_axis": "a largest splat",
    "fits_picture": "splats no larger than the image",
    "packing": "packing",
    "frozen_beyond": "another limit of the Jacobian",
    "frozen_by_width": "a limit of the Jacobian by the width",
    "frame": "culling by the center",
    "linear_light": "blending in linear light",
    "picture_step": "rounding after each splat",
}

# Those that screen filters that integrate support; the others depend on a splat's weight at a point.
WITH_INTEGRALS = frozenset({
    *("min_alpha", "min_transmittance", "radius", "tile", "max_color", "color_steps"),
    *("radial", "bucketed", "even_buckets", "frozen_beyond", "frozen_by_width", "frame", "packing", "linear_light"),
})

# Incremented when `Backend.render` or the records below change in a way that breaks existing backends.
API_VERSION = 1


class Rendered:
    """One image, differentiable in the Gaussians that it was rendered from.

    Attributes:
        image: [H, W, 3] RGB, background included, not clamped.
        alpha: [H, W], 1 - transmittance; may be given as a function, which is called on first access.
        depth: [H, W] world units, on request (`geometry.depth`); this and the following are added by a wrapped model.
        normals: [H, W, 3] unit vectors in the axes of the world, on request (`geometry.normals`).
        effects: The effects that were simulated, and those that were not.
    """

    def __init__(
        self,
        image: Tensor,
        alpha: Tensor | Callable[[], Tensor],  # or a function that renders it, if that takes another pass
        depth: Tensor | None = None,
        normals: Tensor | None = None,
        effects: tuple[Effect, ...] = (),
    ) -> None:
        self.image, self.depth, self.normals, self.effects, self._alpha = image, depth, normals, effects, alpha

    @property
    def alpha(self) -> Tensor:
        """1 - transmittance, [H, W]; rendered on first access if it takes another pass."""
        if callable(self._alpha):
            self._alpha = self._alpha()
        return self._alpha

    def replaced(self, **changes: Any) -> Rendered:
        """A copy with some of the constructor's arguments replaced."""
        parts: dict[str, Any] = dict(image=self.image, alpha=self._alpha, depth=self.depth, normals=self.normals, effects=self.effects)
        return Rendered(**parts | changes)


@dataclass(frozen=True)
class Needs:
    """What a request requires of a backend.

    Attributes:
        device: Torch device type: "cpu", "cuda", ...
        dtype: Of the splats.
        gradients: Whether the image is to be differentiable.
        sh_degree: Of the colors.
        screen_filter: As in `Effects`.
        covariances: Whether splats have them in place of quaternions and scales.
        settings: As in `Effects`.
    """

    device: str
    dtype: torch.dtype
    gradients: bool
    sh_degree: int
    screen_filter: str
    covariances: bool = False
    settings: RenderSettings = USUAL

    @classmethod
    def of(cls, gaussians: Gaussians, effects: Effects, *, gradients: bool) -> Needs:
        """The needs of rendering `gaussians` with `effects`."""
        means, covariances = gaussians.means, gaussians.covariances is not None
        return cls(means.device.type, means.dtype, gradients, effects.sh_degree, effects.screen_filter, covariances, effects.settings)


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do, as data.

    Attributes:
        devices: Torch device types; None: any.
        dtypes: Of the splats; a loaded checkpoint has float32.
        screen_filters: Names of `Effects.screen_filter`.
        gradients: Whether images are differentiable in the splats.
        max_sh_degree: The highest degree of spherical harmonics that is evaluated.
        covariances: Whether splats may have covariances in place of quaternions and scales.
        settings: Fields of `RenderSettings` that may differ from the usual, names of SETTINGS.
    """

    devices: frozenset[str] | None
    dtypes: frozenset[torch.dtype]
    screen_filters: frozenset[str]
    gradients: bool = True
    max_sh_degree: int = 4
    covariances: bool = True
    settings: frozenset[str] = frozenset()

    def lacking(self, needs: Needs) -> list[str]:
        """One reason for each need that is not met; empty if all are."""
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
        missing = [SETTINGS[name] for name in changed if name not in self.settings]
        reasons = [f"it does not support {', '.join(missing)}, which the reference backend does"] if missing else []
        if needs.screen_filter in INTEGRATED and (pointwise := [SETTINGS[name] for name in changed if name not in WITH_INTEGRALS]):
            reasons.append(f"the screen filter {needs.screen_filter} does not support {', '.join(pointwise)}")
        return reasons


@dataclass(frozen=True)
class Calls:
    """What a run will ask of a backend: gradients, blend weights (for merging), steps by rows, and calls of so many pixels."""

    gradients: bool
    merging: bool
    by_rows: bool = False
    pixels: tuple[int, ...] = (1,)


@dataclass(frozen=True)
class AdamStep:
    """A step of Adam (Kingma and Ba 2015) over the raw parameters of 3DGS: log scales, logits, quaternions of any norm.

    By name means [N, 3], quats [N, 4], scales [N, 3], opacities [N], and sh [N, K, 3], which is sh0 and shN in one; all are changed in place.

    Attributes:
        raw: The parameters.
        first: The first moments, by the same names.
        second: The second moments.
        rates: By name, with sh0 and shN apart; over 1 - beta1^t, where this is step t.
        betas: Decay rates of the moments.
        correction: 1 / sqrt(1 - beta2^t).
        eps: Added to the root of the second moment.
        nesterov: With beta1 · first + (1 - beta1) · gradient in place of the first moment (Dozat 2016, without its schedule of beta1).
        means_gradient: [N, 3], where the gradient of the means is written if it is given; splats grow by it.
    """

    raw: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    second: Mapping[str, Tensor]
    rates: Mapping[str, float]
    betas: tuple[float, float]
    correction: float
    eps: float
    nesterov: bool = False
    means_gradient: Tensor | None = None


class Stepper(Protocol):
    """Draws splats of 3DGS and moves them, by their raw parameters, which only it changes.

    Optional: `render_all(shots) -> list[Rendered]` and `differentiate_all(d_images)` draw and differentiate all views of a step, each with effects
    of its own, in one call each. Or `prepare(shots)`, called before several threads may each render one of these views: what threads divide better
    by splats than by views.
    """

    def render(self, number: int, camera: Camera, effects: Effects) -> Rendered:
        """The view of that number in the next step, without gradients. Several threads may each draw and differentiate one."""

    def differentiate(self, number: int, d_image: Tensor, d_alpha: Tensor | None = None) -> None:
        """Take a loss's gradients in the image [H, W, 3] and the alpha [H, W] of that view, once it is drawn."""

    def step(self, step: AdamStep) -> None:
        """Move the raw parameters down the gradient of the views differentiated since the step before, added in the order of their numbers.

        Raises RuntimeError if there is none.
        """


@runtime_checkable
class Backend(Protocol):
    """Renders Gaussians to an image with one sample per pixel; supersampling, depth and normals are built on top (`supersample`, `geometry`).

    A row with NaN or infinity has no effect, and a gradient of 0. An image of nothing may come without gradients.

    Attributes:
        name: As in `--backend`.
        api_version: `API_VERSION` of the contract that it was written for.
        speed: Rank for `auto`, which takes the highest of the backends that can serve a request; 0 is that of the reference.

    Optional members:

    - `note: str`, shown wherever the backend is listed or chosen.
    - `own_threads: bool`: its kernels have threads of their own (`threads.for_kernels`), return the same bytes on any number, and may run in
      several threads at once; then torch has one while adapting.
    - `blend_weights(gaussians, camera, effects) -> Tensor | None`: the sum of each splat's blend weights over the image, [N], or None where it
      has to be found from gradients; `weigh_views(gaussians, shots) -> Tensor`: those of several views, [V, N], each shot a (camera, effects).
    - `render_views(gaussians, shots) -> list[Rendered]`: several views of the same splats in one call; adaptation steps are drawn so.
    - `stepper(raw) -> Stepper`: for splats of 3DGS, with `raw` as `AdamStep.raw`; it keeps gradients from autograd and hands them to Adam
      itself, row by row, which takes less time, and far less memory.
    - `compile_ahead(gaussians, effects, calls)`: compile what such calls need.
    """

    name: str
    api_version: int
    # On a GPU: 50 triton, the fastest and closest to the reference (`benchmarks/results/gpu`); 40 gsplat; 20 inria, whose footprint and gradients
    # differ most; 0 reference.
    speed: int

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`, [H, W, 3] and [H, W], on the device and in the dtype of `gaussians`."""


class CachedCheck:
    """Checks once per kind of request whether a backend can serve it: finding packages and compilers takes longer than a small image."""

    def __init__(self, backend: Backend) -> None:
        self._backend, self._served = backend, set[Needs]()

    def require(self, gaussians: Gaussians, effects: Effects) -> None:
        """Raise BackendUnavailable, an ImportError, with every reason why the backend cannot draw and differentiate `gaussians`."""
        needs = Needs.of(gaussians, effects, gradients=True)
        if needs not in self._served:
            if reasons := self._backend.lacking(needs):
                raise BackendUnavailable(f"backend {self._backend.name!r} cannot do this: {'; '.join(reasons)}")
            self._served.add(needs)
