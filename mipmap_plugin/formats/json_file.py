"""Validated reading of JSON files, mostly of cameras: every error is a SceneError that says what is wrong, where, and what to do."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.errors import SceneError
from mipmap_plugin.formats.magic import LFS_POINTER
from mipmap_plugin.formats.nodes import no_file

# px; an image of this width and height would take 120 GB.
MAX_SIDE = 100_000

# A rotation written with three decimals is off by this much; a mirrored or scaled one by far more.
ROTATION_TOLERANCE = 1e-2


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises SceneError if it is missing, a Git LFS pointer or not JSON."""
    try:
        if trouble := no_file(path):
            raise SceneError(f"{path}: {trouble}; check the path")
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if content.startswith(LFS_POINTER):
        raise SceneError(f"{path}: is a Git LFS pointer, not the file itself; run `git lfs pull` where it came from")
    try:
        return json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # wrong encodings and too deeply nested brackets included
        raise SceneError(f"{path}: is not JSON ({error}); export or download it again") from error


def present(entry: Mapping[str, Any], key: str, where: str) -> Any:
    """`entry[key]`. Raises SceneError, beginning with `where`, if the key is missing."""
    if key not in entry:
        raise SceneError(f"{where}: has no {key!r}; add it or export the file again")
    return entry[key]


def numbers(value: Any, shape: tuple[int, ...], where: str) -> Tensor:
    """`value` as a finite float64 tensor of `shape`. Raises SceneError, beginning with `where`.

    A single number may be a text: until May 2024 nerfstudio so wrote the lenses that it took from RealityCapture.
    """
    try:
        tensor = torch.tensor(float(value) if isinstance(value, str) else value, dtype=torch.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # torch raises different exceptions for ragged, textual and missing values
        raise SceneError(f"{where}: is not made of numbers; export the file again") from error
    if tuple(tensor.shape) != shape:
        raise SceneError(f"{where}: has shape {list(tensor.shape)} instead of {list(shape)}; export the file again")
    if not tensor.isfinite().all():
        raise SceneError(f"{where}: holds NaN or infinity; remove this camera from the file")
    return tensor


def positive(value: Any, where: str) -> float:
    """`value` as a positive float. Raises SceneError, beginning with `where`."""
    if type(value) in (int, float) and 0 < value <= sys.float_info.max:  # without a tensor for each of a thousand numbers
        return float(value)
    number = numbers(value, (), where).item()
    if number <= 0:
        raise SceneError(f"{where}: is {number:g} but must be above 0; correct the file")
    return number


def pixels(value: Any, where: str) -> int:
    """`value` as a whole number of pixels, at least 1. Raises SceneError, beginning with `where`."""
    number = positive(value, where)
    if number > MAX_SIDE:
        raise SceneError(f"{where}: is {number:g} px, more than any photograph has; correct the file")
    if number != int(number):
        raise SceneError(f"{where}: is {number:g} but must be a whole number of pixels; correct the file")
    return int(number)


def rotation(value: Any, where: str) -> Tensor:
    """`value` as a rotation [3, 3] float64. Raises SceneError, beginning with `where`, if it is mirrored, scaled or sheared."""
    matrix = numbers(value, (3, 3), where)
    determinant = torch.linalg.det(matrix).item()
    skew = (matrix.T @ matrix - torch.eye(3, dtype=matrix.dtype)).abs().max().item()
    if abs(determinant - 1) > ROTATION_TOLERANCE or skew > ROTATION_TOLERANCE:
        raise SceneError(f"{where}: is not a rotation (determinant {determinant:.3g}, must be 1); export the poses without scale and mirroring")
    return matrix
