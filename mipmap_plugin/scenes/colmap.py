"""COLMAP scenes, read by pycolmap: cameras sorted by name, as text (10 before 2), every eighth for testing, as in mip-NeRF 360 and by INRIA."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError, brief, plural, some_of, warn
from mipmap_plugin.formats.images import image_size
from mipmap_plugin.formats.json_file import pixels
from mipmap_plugin.formats.nodes import is_file
from mipmap_plugin.scenes.base import ABSENT, MASKED, SPLIT, Scene, note_on_shapes, other_shape
from mipmap_plugin.scenes.colmap_sizes import refuse_truncated
from mipmap_plugin.scenes.lenses import INSTALL, Lens, note
from mipmap_plugin.scenes.listed_images import WHOLE, image_file
from mipmap_plugin.scenes.training_options import TEST_EVERY, numbers_views, photographs_folder, tests_by_lod, trained_size, unbent_by

if TYPE_CHECKING:
    import pycolmap

# Folders of a model, in the order in which graphdeco-inria and gsplat search them.
MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".", "0")  # the last: the folder `sparse` itself was given

# Folders between a model and the folder of photographs, which is beside the highest: nerfstudio has all of them.
BETWEEN = ("0", "sparse", "colmap")

# Folders beside that of photographs: of masks, as Brush reads them, and of what 3DGS's convert.py undistorts.
MASKS, BENT = "masks", "input"


def read_colmap(path: str | Path, cfg: dict[str, Any] | None = None) -> Scene:
    """The scene of a folder with `sparse/0` and images, or of the folder of the model itself.

    Of several models (sparse/0, sparse/1, ...) the first is read, as by 3DGS, gsplat and nerfstudio; a larger one is warned of, for Brush takes that.
    `cfg` is the checkpoint's cfg_args: `images` names the folder of photographs and `resolution` the training size; the principal
    point is moved to the center, as projects with cfg_args do, and lenses that the project takes for pinholes are (`unbent_by`). Without it, the
    photographs in `images` are used at their full size; where only copies are there (images_4), their cameras keep the full size. A camera whose
    photograph is missing stays a usable view; `notes` count them.

    Raises:
        SceneError: no pycolmap, no readable model, a lens that cannot be undistorted, or an invalid `resolution`.
    """
    path, cfg = Path(path), cfg or {}
    model = _read(path)
    try:
        whole = _whole_names(path)
        for number, image in model.images.items():
            image.name = whole.get(number, image.name)
        images = sorted(model.images.values(), key=lambda image: image.name)
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: the COLMAP model has names of images that are no UTF-8; copy or export it again") from error
    if not images:
        raise SceneError(f"{path}: the COLMAP model has no image with a pose; run the mapper again")
    if nameless := [image.image_id for image in images if not Path(image.name).name]:
        raise SceneError(f"{path}: image {nameless[0]} of the COLMAP model has no name; copy or export it again")
    folder, is_copy = _photographs(path, photographs_folder(cfg), [image.name for image in images])
    cameras: list[Camera] = []
    photographs: dict[Camera, Path] = {}
    lenses: dict[Path, Lens] = {}
    shapes: list[str] = []
    trained, unbent = count(), unbent_by(cfg)
    by_lod = tests_by_lod(len(images), cfg)
    tests = range(0, len(images), TEST_EVERY) if by_lod is None else by_lod
    for index, image in enumerate(images):
        camera = _camera(model, image, "test" if index in tests else "train", centered=bool(cfg))
        photograph, lens = image_file(folder, image.name) or folder / image.name, _lens(model.cameras[image.camera_id], unbent)
        exists, options = is_file(photograph), cfg
        if exists:
            shapes.append(other_shape((camera.width, camera.height), photograph, str(photograph)))
            size = image_size(photograph)
        if exists and not is_copy:
            options = {**cfg, "images": "images", "ds": 1}
            camera, lens = camera.resized(*size), lens and lens.at(size)
        if lens is not None:
            camera, lenses[photograph] = lens.straightened(camera), lens
            camera = replace(camera, cx=camera.width / 2, cy=camera.height / 2) if cfg else camera
        camera = camera.resized(*trained_size(camera.width, camera.height, options))
        if numbers_views(cfg, camera.split):
            camera = replace(camera, index=next(trained))
        cameras.append(camera)
        if exists:
            photographs[camera] = photograph
    notes = _notes(cameras, photographs, folder, None if by_lod is None else cfg["lod"]) + ([note(lenses.values())] if lenses else [])
    notes += note_on_shapes(shapes)
    if is_copy:
        notes.append(f"there is no folder {photographs_folder(cfg)}: the photographs are those of {folder.name}")
    if models := sorted({lens.model for camera in model.cameras.values() if (lens := _lens(camera)) and lens.model in unbent}):
        notes.append(f"the project of the checkpoint takes lenses that bend ({', '.join(models)}) for pinholes: photographs are not undistorted")
    numbers = tuple(image.image_id for image in images)
    return Scene(tuple(cameras), photographs, path, notes, points=_points(model), lenses=lenses, numbers=numbers)


def is_colmap(path: Path) -> bool:
    """Whether a folder holds a COLMAP model, or is one."""
    return _model_folder(path) is not None


def _model_folder(path: Path) -> Path | None:
    return next(_models_of(path), None)


def _models_of(path: Path) -> Iterator[Path]:
    """The folders of the models at `path`, that which is read first: if COLMAP's mapper made several, it numbers them in no order of size."""
    numbered = sorted((int(each.name), each) for folder in (path / "sparse", path) for each in folder.glob("[1-9]*") if each.name.isdecimal())
    for place in (*(path / place for place in MODELS), *(place for _, place in numbered)):
        if any((place / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            yield place


def _warn_of_larger(path: Path, read: int) -> None:
    """Warn if another model at `path` states more images than the `read` ones of the first."""
    first, *others = _models_of(path)
    count, largest = max(((_count(model), model) for model in others), key=lambda found: found[0], default=(0, first))
    if count > read:
        advice = f"{largest} has {count}: if a checkpoint was trained on that, give that folder"
        warn(f"{first} is read, which has {plural(read, 'image')}, but {advice}")


def _count(model: Path) -> int:
    """How many images a model states; 0 if it does not."""
    try:
        if (binary := model / "images.bin").is_file():
            with binary.open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        with (model / "images.txt").open(encoding="utf-8", errors="replace") as lines:
            return (1 + sum(not line.startswith("#") for line in lines)) // 2
    except OSError:
        return 0


def _photographs(path: Path, name: str, listed: Sequence[str]) -> tuple[Path, bool]:
    """The folder `name` of photographs: beside the model, or above it, whichever of these folders was given. Where there is none, the folder of the
    largest copies (images_2, images_4, ...), and True. `listed`: the names of the images."""
    above = [here := (_model_folder(path) or path).absolute(), here.parent]
    while above[-1].name in BETWEEN:
        above.append(above[-1].parent)
    usual = next((place.parent for place in above if place.name == "sparse"), path)  # if there is none
    if found := next((place / name for place in above if (place / name).is_dir()), None):
        return _holding(found, listed), False
    copies = {int(match[1]): copy for place in above for copy in place.glob("images_*") if (match := re.fullmatch(r"images_(\d{1,9})", copy.name))}
    return (copies[min(copies)], True) if copies else (_holding(usual / name, listed), False)


def _holding(folder: Path, listed: Sequence[str]) -> Path:
    """`folder`, or the one above if only that has images listed so: their names may begin with `images/`, or they lie beside the model's files."""
    places = (folder, folder.parent) if folder.name == WHOLE else ()
    return next((place for place in places if any(image_file(place, name) for name in listed)), folder)


def _read(path: Path) -> pycolmap.Reconstruction:
    try:
        import pycolmap
    except ImportError as error:
        raise SceneError(f"{path}: is a COLMAP scene, which pycolmap reads; {INSTALL}") from error
    folder = _model_folder(path)
    if folder is None:
        raise SceneError(f"{path}: holds no COLMAP model (sparse/0 with cameras, images and points3D); give the folder that does")
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    if lacking := [name for name in (f"images{suffix}", f"points3D{suffix}") if not (folder / name).is_file()]:
        raise SceneError(f"{folder}: lacks {' and '.join(lacking)}, without which pycolmap reads no model; copy the whole folder, or export it again")
    refuse_truncated(folder)
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap passes on any C++ exception for a damaged file
        raise SceneError(f"{folder}: is not a COLMAP model that pycolmap reads ({brief(error)}); copy or export it again") from error
    _warn_of_larger(path, len(model.images))
    return model


def _whole_names(path: Path) -> dict[int, str]:
    """The names of a text model's images, by their numbers: COLMAP writes them whole, and pycolmap reads them up to the first blank.

    Raises SceneError if images have no lines of points, without which pycolmap takes every other image for such a line.
    """
    folder = _model_folder(path) or path
    if (folder / "images.bin").is_file():  # which has no such text, and is read where there are both
        return {}
    with (folder / "images.txt").open(encoding="utf-8") as lines:
        rows = (line.strip() for line in lines)
        found = [(row, next(rows, "")) for row in rows if row and not row.startswith("#")]  # an image, and its points on the next line
    if lost := next((row for row, points in found if len(points.split()) % 3), None):  # each point is x, y and its number
        where = f"{folder / 'images.txt'}, image {lost.split()[0]}"
        raise SceneError(f"{where}: has no line of points below it; add one, which may be empty, below every image, or export the model again")
    fields = [row.split(maxsplit=9) for row, _ in found]
    return {int(row[0]): row[9] for row in fields if len(row) > 9}


def _lens(camera: pycolmap.Camera, unbent: Collection[str] = ()) -> Lens | None:
    """The lens of a camera with distortion; None for a pinhole, and for a model that is taken for one."""
    if camera.model.name in unbent:
        return None
    distorted = any(camera.params[i] != 0 for i in camera.extra_params_idxs())
    if not distorted and "FISHEYE" not in camera.model.name and camera.model.name != "FOV":
        return None
    return Lens(camera.model.name, camera.width, camera.height, tuple(camera.params))


def _camera(model: pycolmap.Reconstruction, image: pycolmap.Image, split: Literal["train", "test"], *, centered: bool) -> Camera:
    """The camera at COLMAP's size. `centered`: the principal point is moved to the center."""
    lens = model.cameras[image.camera_id]
    if not lens.focal_length_idxs():
        raise SceneError(f"{image.name}: has a lens that is not perspective ({lens.model.name}); resample its images to a pinhole first")
    viewmat = torch.eye(4, dtype=torch.float64)
    pose = image.cam_from_world()
    pose.rotation.normalize()  # as COLMAP does when it reads a text file, and pycolmap does not
    viewmat[:3] = torch.as_tensor(pose.matrix())
    cx, cy = (lens.width / 2, lens.height / 2) if centered else (lens.principal_point_x, lens.principal_point_y)
    name = Path(image.name).with_suffix("").as_posix()
    width, height = (pixels(side, f"{image.name}, {what}") for what, side in (("width", lens.width), ("height", lens.height)))
    return Camera(width, height, lens.focal_length_x, lens.focal_length_y, cx, cy, viewmat, name, split)


def _points(model: pycolmap.Reconstruction) -> Tensor | None:
    # There may be millions: a tensor of each would take twice as long, and three times the memory.
    places = [point.xyz.tolist() for _, point in sorted(model.points3D.items())]
    return torch.tensor(places, dtype=torch.float64) if places else None


def _notes(cameras: list[Camera], photographs: dict[Camera, Path], folder: Path, lod: int | None) -> list[str]:
    tests = f"what lod={lod} holds out" if lod else f"every {TEST_EVERY}th"
    notes = [f"{plural(len(cameras), 'camera')} in the order of their names: {tests} {SPLIT}, the others for training"]
    if absent := len(cameras) - len(photographs):
        gone = some_of(absent, len(cameras), "photograph", "are")
        redo = f"; {BENT} is what convert.py of 3DGS undistorts: run it again, or rename it to {WHOLE} if the model is of these themselves"
        bent = redo if folder.with_name(BENT).is_dir() and not photographs else ""
        notes.append(f"{gone} {ABSENT} from {folder}, though the COLMAP model names {'it' if absent == 1 else 'them'}{bent}")
    if photographs and (masks := folder.with_name(MASKS)).is_dir():
        notes.append(f"photographs may be {MASKED} ({masks}); masks are not read, so that what they hide counts like all else")
    return notes
