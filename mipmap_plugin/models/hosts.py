"""Other projects whose files hold the splats of 3DGS: what such a file has that a PLY has not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor

from mipmap_plugin.camera import Camera


@dataclass(frozen=True, eq=False)
class Taken:
    """What a scene knows of its photographs besides their cameras."""

    points: Tensor | None = None  # [P, 3] of structure from motion
    smaller: Callable[[int], tuple[int, int] | None] | None = None  # (width, height) px of the copies in images_<factor>; None: no photographs
    applied_scale: float = 1.0  # by which nerfstudio had sized COLMAP's world before it wrote the file


class Host(Protocol):
    """The project that a `VanillaModel` was read from, and into whose file it is written back."""

    @property
    def family(self) -> str:
        """A name in `families.FAMILIES`."""

    def write(self, path: Path, parameters: dict[str, Tensor], comments: Sequence[str], *, overwrite: bool) -> Path:
        """Write raw `parameters`, named as VanillaModel's, to a file or a result folder, atomically; return the file with the splats.

        `comments` (`tags.with_tags`) tell the screen filter and the provenance. Raises OutputExists.
        """

    def holds(self, path: Path) -> str | None:
        """The folder that every result folder written by `write` to `path` has; None where `path` is that of a file. Raises OutputError."""

    def as_trained(self, cameras: Sequence[Camera], taken: Taken, means: Tensor) -> list[Camera]:
        """Views of the photographs' scene in the frame and at the size of the training.

        `means` [N, 3] are those of the splats. Raises SceneError.
        """
