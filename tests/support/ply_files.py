"""Small PLY files, sound and broken, made by hand so that no writer's habits hide a reader's."""

from pathlib import Path

import numpy as np

NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]


def splat_names(bands: int) -> list[str]:
    """The column names of a 3DGS file with 3 · `bands` f_rest columns."""
    rest = [f"f_rest_{i}" for i in range(3 * bands)]
    return [*NAMES, *rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def splat_columns(count: int, bands: int = 15, seed: int = 0) -> dict[str, np.ndarray]:
    """Random raw columns [count], f4."""
    random = np.random.default_rng(seed)
    columns = {name: random.normal(size=count).astype(np.float32) for name in splat_names(bands)}
    return {**columns, **{name: np.zeros(count, np.float32) for name in ("nx", "ny", "nz")}}


def write(
    path: Path, columns: dict[str, np.ndarray], form: str = "binary_little_endian", newline: str = "\n", comments: tuple[str, ...] = ()
) -> Path:
    """One vertex element with these columns, in their own types."""
    types = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
    order = ">" if form == "binary_big_endian" else "<"
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {form} 1.0", *(f"comment {text}" for text in comments), f"element vertex {count}"]
    lines += [f"property {types[column.dtype.str[1:]]} {name}" for name, column in columns.items()] + ["end_header", ""]
    rows = np.empty(count, [(name, order + column.dtype.str[1:]) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    body = newline.join(" ".join(repr(value.item()) for value in row) for row in rows) + newline if form == "ascii" else None
    path.write_bytes(newline.join(lines).encode() + (rows.tobytes() if body is None else body.encode()))
    return path


def write_splats(path: Path, count: int = 5, bands: int = 15, **options) -> Path:
    """A sound 3DGS file; its folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(path, splat_columns(count, bands), **options)


CFG_ARGS = "Namespace(sh_degree=1, resolution=4, white_background=True)"


def write_model_folder(folder: Path, iteration: int = 7000, cfg_args: str = CFG_ARGS) -> Path:
    """An INRIA model folder of 5 splats of degree 3."""
    write_splats(folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply")
    (folder / "cfg_args").write_text(cfg_args)
    (folder / "cameras.json").write_text('[{"id": 0}]\r\n')
    return folder
