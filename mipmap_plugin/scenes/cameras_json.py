"""cameras.json, which graphdeco-inria's 3DGS and its descendants write beside a checkpoint."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from mipmap_plugin.camera import Camera, checked, viewmat_of
from mipmap_plugin.errors import SceneError, warn
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.json_file import numbers, pixels, positive, present, read_json, rotation
from mipmap_plugin.limits import path_of
from mipmap_plugin.scenes.training_options import DEFORMABLE, TEST_EVERY, tests_by_lod, trained_size


def read_cameras(path: str | Path, cfg: dict[str, Any] | None = None) -> list[Camera]:
    """The cameras of a cameras.json, at their training size.

    Args:
        path: the file.
        cfg: the checkpoint's cfg_args; `eval` determines whether there is a test split, `resolution` and `images` the
            training size. Without it every camera is for training and has the size in the file.

    Raises:
        SceneError: a file or an entry that cannot be read, or an invalid `resolution`.
    """
    path, cfg = path_of(path), cfg or {}
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        lacks = "lists no cameras" if entries == [] else "is not a list of cameras"
        raise SceneError(f"{path}: {lacks}; give the cameras.json that lies beside the checkpoint")
    names = [_name(entry, f"{path}, entry {index}") for index, entry in enumerate(entries)]
    tests, trained = _tests(names, path, cfg) if cfg.get("eval") else set(), count()
    cameras = []
    for index, (entry, name) in enumerate(zip(entries, names, strict=True)):
        camera = _camera(entry, name, "test" if index in tests else "train", f"{path}, entry {index} ({name})")
        resized = camera.resized(*trained_size(camera.width, camera.height, cfg))
        cameras.append(resized if index in tests else replace(resized, index=next(trained)))
    return cameras


def write_cameras(path: str | Path, cameras: Sequence[Camera], *, overwrite: bool = False) -> Path:
    """Write `cameras` as INRIA does, test views first; return the path. Raises OutputExists.

    A principal point off the image center is written as cx and cy, which INRIA's readers do not know and some descendants do.
    Raises SettingsError for anything else than cameras.
    """
    ordered = sorted(checked(cameras), key=lambda camera: camera.split != "test")
    path = path_of(path)
    write_json(path, [_entry(index, camera) for index, camera in enumerate(ordered)], overwrite)
    return path


def _entry(index: int, camera: Camera) -> dict[str, Any]:
    to_world = camera.viewmat[:3, :3].T.tolist()
    where = {"position": camera.center.tolist(), "rotation": to_world}
    centered = (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2)
    lens = {"fy": camera.fy, "fx": camera.fx} | ({} if centered else {"cx": camera.cx, "cy": camera.cy})
    return {"id": index, "img_name": camera.name, "width": camera.width, "height": camera.height, **where, **lens}


def _tests(names: list[str], path: Path, cfg: dict[str, Any]) -> set[int]:
    """The places of the test cameras in a file with these names: the first ones, as INRIA writes it, or every eighth of a file sorted by name.

    INRIA's readers hold out every eighth name of a COLMAP scene, and write these first, which no longer is the order of names. They sort names as
    text, numbers too (0, 1, 10, 2), and so does this: in another order other views would be held out than in the training. Warns of another order of
    unique names, in which the test cameras may be others.
    """
    if (held_out := tests_by_lod(len(names), cfg)) is not None and len(set(names)) == len(names):
        chosen = {name for place, name in enumerate(sorted(names)) if place in held_out}
        return {place for place, name in enumerate(names) if name in chosen}
    first = count_test_cameras(names)
    leading, by_name = set(range(first)), sorted(names)
    numberless = [re.sub(r"\d+", "", name) for name in names]
    alike = len(set(numberless)) <= len(names) / 2  # otherwise names say nothing by what they begin with
    if len(set(names)) < len(names) or (alike and not {*numberless[:first]} & {*numberless[first:]}):  # Blender's, and test_0 and train_0
        return leading
    if DEFORMABLE in cfg and len(ends := [place for place in range(1, len(names)) if names[place] < names[place - 1]]) <= 1:
        return set(range(ends[0] if ends else 0))  # of HyperNeRF: any number of test views, or none, and then those of training, each in their order
    if names == by_name:
        return set(range(0, len(names), TEST_EVERY))
    if {*names[:first]} != {*by_name[::TEST_EVERY]}:
        order = "its cameras are neither in the order that 3DGS writes nor sorted by name"
        warn(f"{path}: {order}, so the first {first} of {len(names)} are taken as the test views, which may be others")
    return leading


def count_test_cameras(names: list[str]) -> int:
    """The number of test cameras; INRIA lists them first but does not state their number.

    In a COLMAP scene one view in eight is for testing, in the order of names. These may repeat, for INRIA cut them off at the first dot and left out
    folders until October 2024. A Blender scene uses the same names for test and training views (r_0, r_1, ...), so the first repeated name starts
    the training views.
    """
    first, ordered, seen = math.ceil(len(names) / TEST_EVERY), sorted(names), set[str]()
    if names[:first] == ordered[::TEST_EVERY] and names[first:] == [name for place, name in enumerate(ordered) if place % TEST_EVERY]:
        return first
    for index, name in enumerate(names):
        if name in seen:
            return index
        seen.add(name)
    return first


def _name(entry: Any, where: str) -> str:
    if not isinstance(entry, dict):
        raise SceneError(f"{where}: is not a camera; give the cameras.json that lies beside the checkpoint")
    return str(present(entry, "img_name", where))


def _camera(entry: dict[str, Any], name: str, split: Any, where: str) -> Camera:
    """`rotation` is camera to world, `position` the eye; INRIA has the principal point in the image center, and some descendants write it."""
    camera_to_world = rotation(present(entry, "rotation", where), f"{where}, rotation")
    position = numbers(present(entry, "position", where), (3,), f"{where}, position")
    viewmat = viewmat_of(camera_to_world, position)
    width, height = (pixels(present(entry, key, where), f"{where}, {key}") for key in ("width", "height"))
    fx, fy = (positive(present(entry, key, where), f"{where}, {key}") for key in ("fx", "fy"))
    cx, cy = principal_point(entry, (width, height), where)
    return Camera(width, height, fx, fy, cx, cy, viewmat, name, split)


def principal_point(values: Mapping[str, Any], size: tuple[int, int], where: str) -> tuple[float, float]:
    """(cx, cy) px from the edges, each in the middle of its side of `size` (width, height) px if there is no value.

    Raises SceneError for what seems to be in another unit: one of them alone may lie at the edge, as in a tile of a picture.
    """
    given = {key: numbers(values[key], (), f"{where}, {key}").item() for key in ("cx", "cy") if values.get(key) is not None}
    if given and max(map(abs, given.values())) <= 1 < min(size) / 2:  # fractions of the image, or offsets from its center
        said = " and ".join(f"{key} {number:g}" for key, number in given.items())
        raise SceneError(f"{where}: has {said}, but must have pixels from the edge of the image; correct it, or leave it out if it is the center")
    return given.get("cx", size[0] / 2), given.get("cy", size[1] / 2)
