"""exposure.json of 3DGS (since 2024-08): a trained affine transformation of colors for each photograph, by image name.

Every training writes the file; without `--train_test_exp` it holds identities. As in the original, a view gets the exposure of its
name, test views included, since that option trains on half of each.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from os.path import splitext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import EXPOSURE, Effect
from mipmap_plugin.errors import SettingsError, some_of

FILE = "exposure.json"

# What json and torch raise for text, values and shapes that are not matrices.
UNREADABLE = (OSError, ValueError, TypeError, AttributeError, RuntimeError, RecursionError, OverflowError)


@dataclass(frozen=True, eq=False)
class Exposures:
    """The exposures of one checkpoint."""

    matrices: Mapping[str, Tensor] = field(default_factory=dict)  # [3, 4] float64 by image name
    why_none: str = EXPOSURE.reason

    @cached_property
    def _without_suffix(self) -> dict[str, Tensor]:
        return {splitext(name)[0]: matrix for name, matrix in self.matrices.items()}

    @cached_property
    def changed(self) -> int:
        """The number of matrices that are not the identity."""
        return sum(not torch.equal(matrix, torch.eye(3, 4, dtype=matrix.dtype)) for matrix in self.matrices.values())

    def effect(self) -> Effect:
        """The effect `exposure` for a request without it."""
        return replace(EXPOSURE, reason=self.summary() + ", not asked for" * bool(self.changed))

    def of(self, camera: Camera) -> Tensor:
        """The matrix [3, 4] float64 of the image with the name of `camera`, with or without suffix. Raises SettingsError if there is none."""
        if not self.matrices:
            raise SettingsError(f"exposure: {self.summary()}; leave it out")
        matrix = self._known(camera)
        if matrix is None:
            some = ", ".join(list(self.matrices)[:5])
            raise SettingsError(f"view {camera.name!r} has no exposure; the first of {len(self.matrices)} that have one are {some}")
        return matrix

    def applied(self, image: Tensor, camera: Camera) -> Tensor:
        """`image` [..., 3] as the photograph of `camera` was exposed; as it is, where that is not known."""
        matrix = self._known(camera)
        return image if matrix is None else exposed(image, matrix)

    def _known(self, camera: Camera) -> Tensor | None:
        return self.matrices.get(camera.name, self._without_suffix.get(camera.name))

    def summary(self) -> str:
        """A summary, as the beginning of a sentence."""
        if not self.matrices:
            return self.why_none
        if not self.changed:
            return f"{FILE} holds only identities: no exposure was trained"
        return f"{FILE} changes {some_of(self.changed, len(self.matrices), 'image')}"


NO_EXPOSURES = Exposures()


def read_exposures(folder: Path | None) -> Exposures:
    """The exposures of a model folder; empty, with the reason, if the file is missing or cannot be read."""
    if folder is None or not (folder / FILE).is_file():
        return NO_EXPOSURES
    try:
        content = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return Exposures({name: _matrix(name, rows) for name, rows in content.items()}, f"{FILE} names no image")
    except UNREADABLE as error:
        return Exposures(why_none=f"{FILE} cannot be read ({error})")


def exposed(image: Tensor, matrix: Tensor) -> Tensor:
    """Apply an exposure E to `image` [..., 3]: each color as a row times E[:, :3], plus E[:, 3] (gaussian_renderer of 3DGS). Not clamped."""
    matrix = matrix.to(image)
    return image @ matrix[:, :3] + matrix[:, 3]


def _matrix(name: str, rows: Any) -> Tensor:
    matrix = torch.tensor(rows, dtype=torch.float64)
    if matrix.shape != (3, 4) or not matrix.isfinite().all():
        raise ValueError(f"{name!r} is not three rows of four numbers")
    return matrix
