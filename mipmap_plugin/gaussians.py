"""Gaussians: the interface between checkpoint families and backends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError, ShapeError, brief, type_of
from mipmap_plugin.limits import is_out_of_memory


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians:
    """N splats in world space, activated: scales are lengths, opacities lie in 0..1. Raises ShapeError if the tensors do not fit together.

    Attributes:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, of any norm; 0 is no rotation.
        scales: [N, 3] world units, standard deviations along the local axes.
        opacities: [N], 0..1.
        sh: [N, (degree + 1)**2, 3], coefficients of the colors' spherical harmonics, basis-major, as 3DGS has them; degree 0 to 4.
        covariances: [N, 3, 3] world units², override quats and scales where a family needs it; None: they do not. Adaptation starts from quats and
            scales nevertheless, which have to be nearly theirs.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    covariances: Tensor | None = None

    def __post_init__(self) -> None:
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        if wrong := [name for name, tensor in given.items() if not isinstance(tensor, Tensor) and (tensor is not None or name != "covariances")]:
            raise ShapeError(f"{wrong[0]}: expected a torch tensor, got {type(given[wrong[0]]).__name__}")
        if wrong := [name for name, tensor in given.items() if tensor is not None and (tensor.layout != torch.strided or tensor.is_nested)]:
            raise ShapeError(f"{wrong[0]}: expected a dense tensor, got a sparse or nested one; give a dense copy of it")
        if not self.means.is_floating_point():
            raise ShapeError(f"means: expected floating-point numbers, got {self.means.dtype}; give float32")
        n = self.means.shape[0] if self.means.dim() else 0
        bands = math.isqrt(self.sh.shape[1]) if self.sh.dim() == 3 else 0
        expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, max(bands, 1) ** 2, 3)}
        if self.covariances is not None:
            expected["covariances"] = (n, 3, 3)
        for name, shape in expected.items():
            tensor = given[name]
            if tuple(tensor.shape) != shape:
                raise ShapeError(f"{name}: expected shape {list(shape)}, got {list(tensor.shape)}")
            if (tensor.device, tensor.dtype) != (self.means.device, self.means.dtype):
                raise ShapeError(f"{name}: {tensor.dtype} on {tensor.device}, but means are {self.means.dtype} on {self.means.device}")

    def __repr__(self) -> str:
        return f"<Gaussians: splats {len(self):,}, {self._kind()}>"

    def _kind(self) -> str:
        """What splats have in common that can be joined."""
        covariances = "" if self.covariances is None else ", with covariances"
        return f"SH degree {self.sh_degree}, {str(self.means.dtype).removeprefix('torch.')} on {self.means.device}{covariances}"

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, rows: Tensor | slice) -> Gaussians:
        """The splats at `rows`, a boolean mask [N], indices or a slice. Raises IndexError for a mask of another length, ShapeError."""
        if isinstance(rows, Tensor) and rows.dtype == torch.bool:
            if rows.shape != (len(self),):
                raise IndexError(f"a mask of {len(self)} splats has shape [{len(self)}], not {list(rows.shape)}")
            rows = rows.nonzero()[:, 0]  # once for all tensors: a GPU is waited for
        if not isinstance(rows, (slice, list)) and getattr(rows, "ndim", 0) != 1:
            raise ShapeError(f"splats are chosen by a mask, a list of indices or a slice, got {type_of(rows)}; one splat is a list of one index")
        return self._map(lambda tensor: tensor[rows])

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name; without `covariances` where there are none."""
        held = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: tensor for name, tensor in held.items() if tensor is not None}

    def joined(self, other: Gaussians) -> Gaussians:
        """These splats, then those of `other`, which are of the same kind. Raises ShapeError."""
        if not isinstance(other, Gaussians) or self._kind() != other._kind():
            raise ShapeError(f"only splats of one kind can be joined ({self._kind()}), got {other!r}")
        return replace(self, **{name: torch.cat([tensor, getattr(other, name)]) for name, tensor in self.tensors().items()})

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """The same splats on `device` in `dtype`. Raises SettingsError for a device that is not here, ShapeError for integers."""
        try:
            return self._map(lambda tensor: tensor.to(device=device, dtype=dtype))
        except (RuntimeError, TypeError, AssertionError) as error:  # by which torch tells of a build without CUDA
            if is_out_of_memory(error):
                raise
            raise SettingsError(f"splats cannot be moved (device={device!r}, dtype={dtype!r}): {brief(error)}") from error

    def detach(self) -> Gaussians:
        """The same splats outside the gradient graph."""
        return self._map(Tensor.detach)

    @property
    def sh_degree(self) -> int:
        """SH degree of `sh`, whether or not its coefficients are zero."""
        return math.isqrt(self.sh.shape[1]) - 1

    def used_sh_degree(self) -> int:
        """The highest SH degree with a non-zero coefficient; bands above it need no evaluation."""
        if len(self) == 0:
            return 0
        sh = self.sh.detach()
        bands = range(self.sh_degree, 0, -1)
        return next((degree for degree in bands if sh[:, degree**2 : (degree + 1) ** 2].count_nonzero()), 0)

    def _map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        return replace(self, **{name: function(tensor) for name, tensor in self.tensors().items()})
