"""Scene: cameras, and photographs for some of them."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.camera import DIGITS, Camera, digest_of
from mipmap_plugin.errors import SceneError, SettingsError, plural
from mipmap_plugin.formats.images import image_size, read_image, shown_turned
from mipmap_plugin.formats.nodes import is_file
from mipmap_plugin.scenes.lenses import Lens, can_undistort

# The word of notes on photographs that are not there.
ABSENT = "absent"

# The word of notes on photographs of which a part is hidden, which is not done here.
MASKED = "masked"

# The words of notes on which views are taken to be for testing.
SPLIT = "is for testing"

# The word of notes on photographs of other proportions than their cameras'.
STRETCHED = "stretched"

# How far the ratio of a photograph's sides may be from that of its camera: some copies are rounded to multiples. Beyond whole pixels a note says so.
SHAPE_TOLERANCE = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """The scene at one path. Cameras without an image are usable views: adaptation needs no photographs.

    Attributes:
        cameras: In the order of the files.
        images: The photographs that were found; there may be none.
        source: The path.
        notes: What was assumed or left out, one sentence each.
        points: [P, 3] float64, the points of structure from motion, where the files hold them.
        applied: [4, 4] float64, transform that nerfstudio applied to COLMAP's world before it wrote the file.
        applied_scale: The scale that it applied then.
        lenses: Of photographs that have to be undistorted.
        numbers: By which a training may order the cameras' images: COLMAP's numbers, or the order of the paths in transforms files; () elsewhere.
        as_4dgaussians: It is a capture that Deformable 3D Gaussians, too, is trained on, but was read as 4DGaussians does (`dynerf`, `hypernerf`).
    """

    cameras: tuple[Camera, ...]
    images: dict[Camera, Path]
    source: Path
    notes: list[str] = field(default_factory=list)
    points: Tensor | None = None
    applied: Tensor | None = None
    applied_scale: float = 1.0
    lenses: dict[Path, Lens] = field(default_factory=dict)
    numbers: tuple[int, ...] = ()
    as_4dgaussians: bool = False

    def __repr__(self) -> str:
        views = f"{len(self.cameras)} of {sizes_of(self.cameras)}" if self.cameras else "none"
        return f"<Scene: cameras {views}, photographs {len(self.images)}, from {self.source}>"

    def digest(self) -> str:
        """A hash of the cameras and of the photographs: of their names and sizes in bytes, not of what they show."""
        sizes = [(path.name, path.stat().st_size) for path in self.images.values()]
        return hashlib.sha256(f"{digest_of(self.cameras)} {sizes}".encode()).hexdigest()[:DIGITS]

    def photographed(self) -> set[tuple[Path, bytes]]:
        """The photographs, each with the pose that it was taken from."""
        return {(path, camera.viewmat.numpy().tobytes()) for camera, path in self.images.items()}

    @property
    def is_capture(self) -> bool:
        """Whether it is what a scene was trained on, and not the cameras.json of a checkpoint."""
        return bool(self.images) or self.points is not None or self.applied is not None

    def warnings(self) -> list[str]:
        """The notes that concern every figure: on photographs that are listed and not there, masked, or of other proportions than their cameras."""
        return [note for note in self.notes if any(f" {word}" in note for word in (ABSENT, MASKED, STRETCHED))]

    def split(self, name: str) -> list[Camera]:
        """The cameras of "train" or "test", in file order. Raises SettingsError for another name."""
        if name not in ("train", "test"):
            raise SettingsError(f"there is no split {name!r}; ask for 'train' or 'test'")
        return [camera for camera in self.cameras if camera.split == name]

    def with_cameras(self, cameras: Sequence[Camera]) -> Scene:
        """The scene with its cameras replaced one by one; the photographs are kept."""
        images = {new: self.images[old] for old, new in zip(self.cameras, cameras, strict=True) if old in self.images}
        return replace(self, cameras=tuple(cameras), images=images)

    def original(self) -> Scene:
        """The scene in COLMAP's original world."""
        if self.applied is None:
            return self
        back = torch.linalg.inv(self.applied)
        return replace(self.with_cameras([camera.moved(back) for camera in self.cameras]), applied=None)

    def numbered_as_upstream(self) -> Scene:
        """The scene with each test view numbered (`Camera.index`) by its position among the test views sorted by name.

        Scaffold-GS and Octree-GS give it the appearance of the training view with that number, which is otherwise unrelated.
        """
        tests = sorted(self.split("test"), key=lambda camera: camera.name)
        numbers = {camera: number for number, camera in enumerate(tests)}
        return self.with_cameras([replace(camera, index=numbers.get(camera, camera.index)) for camera in self.cameras])

    def smaller(self, factor: int) -> tuple[int, int] | None:
        """(width, height) px of the downscaled copies of the photographs in images_<factor>; None if there are none.

        For photographs that have to be undistorted, the size of the undistorted copies.
        """
        camera = next((camera for camera in self.cameras if camera in self.images), None)
        first = Path() if camera is None else self.images[camera]
        folder = next((parent for parent in first.parents if re.fullmatch(r"images(_\d+)?", parent.name)), None)
        if camera is None or folder is None:
            return None
        for name in (f"images_{factor}_png", f"images_{factor}"):
            within = folder.with_name(name) / first.relative_to(folder)
            for copy in (within, within.with_suffix(".png")):
                if is_file(copy):
                    return self._undistorted_size(image_size(copy), camera)
        return None

    def image_size(self, camera: Camera) -> tuple[int, int]:
        """(width, height) px of the photograph of `camera`, undistorted."""
        seen = self.as_photographed(camera)
        return self._undistorted_size(image_size(self.images[camera]), camera) if seen is camera else (seen.width, seen.height)

    def as_photographed(self, camera: Camera) -> Camera:
        """`camera` with the field of view of its photograph: the undistorted size of a smaller copy is rounded by itself, and its field with it."""
        lens, size = self.lenses.get(self.images[camera]), image_size(self.images[camera])
        if lens is None or size == (lens.width, lens.height) or not can_undistort():
            return camera
        return lens.at(size).straightened(camera)

    def _undistorted_size(self, size: tuple[int, int], camera: Camera) -> tuple[int, int]:
        """`size` of the photograph of `camera`, or of a copy of it, scaled by the ratio of the undistorted image to the whole one."""
        whole = self.lenses.get(self.images[camera])
        if whole is None:
            return size
        across, down = camera.width / whole.width, camera.height / whole.height
        return max(1, round(size[0] * across)), max(1, round(size[1] * down))

    def image(self, camera: Camera, background: Sequence[float], least: int | None = None) -> Tensor:
        """The photograph of `camera` on `background` (RGB in 0..1), [H, W, 3] float32, undistorted, at the file's full resolution.

        `least`: it may be smaller, as of `read_image`.

        Raises SceneError if there is none: cameras are compared by identity, so a zoomed copy has none.
        """
        if camera not in self.images:
            raise SceneError(f"{self.source}: camera {camera.name!r} has no image; ask with a camera that is a key of `images`")
        image, lens = read_image(self.images[camera], background, least), self.lenses.get(self.images[camera])
        return image if lens is None else lens.undistorted(image)


def sizes_of(cameras: Sequence[Camera]) -> str:
    """The sizes of some cameras' pictures in words: "272 x 480 px", or the smallest and the largest where they differ."""
    sizes = sorted({(camera.width * camera.height, camera.width, camera.height) for camera in cameras})
    ends = [f"{width} x {height}" for _, width, height in (sizes[0], sizes[-1])]
    return f"{ends[0]} px" if len(sizes) == 1 else f"{' and ' if len(sizes) == 2 else ' to '}".join(ends) + " px"


def other_shape(stated: tuple[int, int], photograph: Path, where: str) -> str:
    """The sizes of a photograph and its camera in words, if the ratios of their sides differ by more than copies are rounded; "" if they do not.

    `stated`: (width, height) of the camera, px. Raises SceneError, beginning with `where`, for a photograph that was turned, or cropped by much:
    resized to such a photograph, the camera would show a distorted scene.
    """
    (wide, high), (width, height) = stated, image_size(photograph)
    if _too_far(stated, (width, height)):
        advice = "it was turned or cropped since; give the photographs that the cameras were found in, or leave them out"
        if shown_turned(photograph) and not _too_far(stated, (height, width)):
            advice = "its EXIF says to show it turned, which is not done here; save a copy whose pixels are turned (magick -auto-orient)"
        raise SceneError(f"{where}: its camera is of {wide} x {high} px, but the photograph has {width} x {height} px: {advice}")
    # px of the height: both sides of a smaller copy are rounded, be it the photograph or what the camera was found in.
    rounding = (1 + high / wide) * max(1.0, width / wide) if (width - wide) * (height - high) > 0 else 1.0
    differs = abs(height - high * width / wide) > rounding
    return f"{photograph.name} has {width} x {height} px, its camera {wide} x {high} px" if differs else ""


def note_on_shapes(found: Sequence[str]) -> list[str]:
    """A note on photographs that have another shape than their cameras (`other_shape`), if there are any."""
    if not any(found):
        return []
    others = [each for each in found if each]
    cropped = "if photographs were cropped, every figure is of a distorted scene: give the cameras of the cropped ones"
    return [f"cameras are {STRETCHED} to the shape of {plural(len(others), 'photograph')}, as in 3DGS ({others[0]}); {cropped}"]


def _too_far(stated: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether the ratio of the sides of `size` is far from that of the `stated` one."""
    (wide, high), (width, height) = stated, size
    return abs(math.log(wide * height / (high * width))) > SHAPE_TOLERANCE + 1 / min(width, height)
