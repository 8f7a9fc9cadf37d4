"""Other projects whose files hold the splats of 3DGS: what such a file has that a PLY has not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from torch import Tensor

from mipmap_plugin.camera import Camera


class Host(Protocol):
    """The project that a `VanillaModel` was read from, and into whose file it is written back."""

    @property
    def family(self) -> str:
        """A key of `detect.FAMILIES`."""

    def write(self, path: Path, parameters: dict[str, Tensor], comments: Sequence[str], *, overwrite: bool) -> Path:
        """Write raw `parameters`, named as VanillaModel's, to a file or a result folder, atomically; return the file with the splats.

        `comments` (`tags.with_tags`) tell the screen filter and the provenance. Raises OutputExists.
        """

    def holds(self, path: Path) -> str | None:
        """The folder that every result folder written by `write` to `path` has; None where `path` is that of a file. Raises OutputError."""

    def as_trained(self, cameras: Sequence[Camera], points: Tensor | None, means: Tensor) -> list[Camera]:
        """Views of the photographs' scene, with its SfM `points` [P, 3], in the frame and at the size of the training.

        `means` [N, 3] are those of the splats. Raises SceneError.
        """
