"""What the options of a training (cfg_args) say of its views: of what size they are, where they lie, which are held out, and their numbers."""

from __future__ import annotations

import math
import re
from typing import Any

from mipmap_plugin.errors import SceneError
from mipmap_plugin.formats.json_file import MAX_SIDE

# INRIA's reader holds out every eighth photograph of a COLMAP scene.
TEST_EVERY = 8

# Scaffold-GS's option `lod` (scene/dataset_readers.py): up to this number it holds out the first views by name, from it on those behind.
LOD_OF_FIRST = 50

# Options by which the projects are known that read a scene otherwise than 3DGS does: of anchors (Scaffold-GS, Octree-GS), Deformable 3D Gaussians,
# which of those that read captures of HyperNeRF alone has it, and 4DGaussians.
ANCHORS, DEFORMABLE, FOUR_D = "n_offsets", "is_6dof", "kplanes_config"

# The lenses that bend which these take for pinholes.
UNBENT = {ANCHORS: ("SIMPLE_RADIAL",), FOUR_D: ("SIMPLE_RADIAL", "OPENCV")}

# `-r`: these divide the size; -1 caps the width; any other number is a width.
DIVISORS = (1, 2, 4, 8)
WIDTH_CAP = 1600  # px


def tests_by_lod(count: int, cfg: dict[str, Any]) -> set[int] | None:
    """The places by name of the views that Scaffold-GS's `lod` holds out of `count`; None without it, and where that leaves none to train on."""
    lod = cfg.get("lod")
    if not cfg.get("eval") or not isinstance(lod, int) or lod <= 0:
        return None
    tests = set(range(min(lod + 1, count)) if lod < LOD_OF_FIRST else range(lod + 1, count))
    return tests if len(tests) < count else None


def numbers_views(cfg: dict[str, Any], split: str) -> bool:
    """Whether a view of a scene has a number in the training (`Camera.index`): only a model with appearances asks for it.

    Without `eval` all views were trained on.
    """
    return bool(cfg.get("appearance_dim")) and (split == "train" or not cfg.get("eval"))


def photographs_folder(cfg: dict[str, Any]) -> str:
    """The name of the folder of training photographs. Octree-GS, which has the option `fork`, uses `ds` instead of `images`."""
    ds = cfg.get("ds", 1)
    if "fork" in cfg and isinstance(ds, int):
        return f"images_{ds}" if ds > 1 else "images"
    return str(cfg.get("images", "images"))


def trained_size(width: int, height: int, cfg: dict[str, Any]) -> tuple[int, int]:
    """(width, height) in px after INRIA's `-i images_N` and `-r`, from the size in cameras.json.

    For COLMAP scenes the file states the full resolution, whatever the size of the training photographs. The folders
    images_2, images_4 and images_8 contain photographs shrunk by that factor, by ImageMagick, which rounds halves up. Rounding of `-r` is that of
    `loadCam`: divisors round halves to even numbers, the cap and the target width truncate. Raises SceneError for another `resolution`.
    """
    shrunk = re.fullmatch(r"images_(\d{1,9})", photographs_folder(cfg))
    if shrunk and int(shrunk[1]) > 0:
        width, height = (max(1, math.floor(side / int(shrunk[1]) + 0.5)) for side in (width, height))
    resolution = cfg.get("resolution", 1)
    if not isinstance(resolution, (int, float)) or not (resolution == -1 or 0 < resolution <= MAX_SIDE):
        raise SceneError(f"cfg_args: resolution={resolution!r} is no training size; use 1, 2, 4, 8, -1 or a width in pixels")
    if resolution in DIVISORS:
        return max(1, round(width / resolution)), max(1, round(height / resolution))
    target = min(width, WIDTH_CAP) if resolution == -1 else resolution
    shrink = width / target
    return max(1, int(width / shrink)), max(1, int(height / shrink))


def unbent_by(cfg: dict[str, Any]) -> set[str]:
    """The models of lenses that bend which the project with these cfg_args takes for pinholes."""
    return {model for option, models in UNBENT.items() if option in cfg for model in models}
