"""Host projects: other projects whose files contain the splats of 3DGS, and what such a file has beyond a PLY."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from torch import Tensor

from mipmap_plugin.camera import Camera


@dataclass(frozen=True, eq=False)
class Capture:
    """Facts about a captured scene besides its cameras."""

    points: Tensor | None = None  # [P, 3] of structure from motion
    smaller: Callable[[int], tuple[int, int] | None] | None = None  # (width, height) px of the copies in images_<factor>; None: no photographs
    applied_scale: float = 1.0  # scale that nerfstudio applied to COLMAP's world before it wrote the file
    numbers: Sequence[int] = ()  # of the cameras' images (`scenes.Scene`)


class Host(Protocol):
    """The project that a `VanillaModel` was read from, and in whose format it is written back."""

    @property
    def family(self) -> str:
        """A name in `families.FAMILIES`."""

    def write(self, path: Path, parameters: dict[str, Tensor], comments: Sequence[str], *, overwrite: bool) -> Path:
        """Write raw `parameters`, named as VanillaModel's, to a file or a result folder, atomically; return the file with the splats.

        `comments` (`tags.with_tags`) name the screen filter and the provenance. Raises OutputExists.
        """

    def holds(self, path: Path) -> str | None:
        """The subfolder that `write` creates in a result folder at `path`; None if `path` is a file. Raises OutputError."""

    def as_trained(self, cameras: Sequence[Camera], capture: Capture, means: Tensor) -> list[Camera]:
        """The cameras of a scene in the coordinate frame, at the image size and with the test views of the training.

        `means` [N, 3] are those of the splats. Raises SceneError.
        """


def as_file(name: str) -> str:
    """The key that sorts names of views, which lack the files' endings, as the files are sorted: `a-1.jpg` and `a (2).jpg` come before `a.jpg`."""
    return f"{name}."


def held_out(cameras: Sequence[Camera], tests: Collection[int], numbers: Sequence[int] = ()) -> list[Camera]:
    """The cameras with their splits: those at the places `tests`, in the order of their `numbers` or else of their files' names, are for testing."""
    ordered = sorted(range(len(cameras)), key=lambda place: numbers[place] if numbers else as_file(cameras[place].name))
    chosen = {ordered[place] for place in tests}
    return [replace(camera, split="test" if number in chosen else "train") for number, camera in enumerate(cameras)]
