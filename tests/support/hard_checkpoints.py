"""Checkpoints of every family with changed numbers in them, numbers that are hard, and what has to hold whatever they are."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import anchor_checkpoints
import moving
import numpy as np
import ply_files
import tiny
import torch
import torch_checkpoints
from anchor_checkpoints import Layout
from hypothesis import settings
from hypothesis import strategies as st

from mipmap_plugin.backends import get_backend
from mipmap_plugin.formats.ply import read_ply

# Where formulas change: overflow of exp, of a square and of a fourth power, denormal numbers, saturated logits, the planes of the view.
EDGES = [0.0, 1e-45, 1e-38, 1e-30, 1e-12, 0.2, 1.0, 17.0, 30.0, 44.3, 80.0, 88.0, 88.8, 1e4, 1e9, 1e12, 1e15, 1e18, 1.8e19, 1e30, 3.4e38]
numbers = (
    st.floats(width=32, allow_nan=False, allow_infinity=False)
    | st.sampled_from([sign * edge for edge in EDGES for sign in (1, -1)])
    | st.floats(-3, 3, width=32)
)
known = settings(derandomize=True, database=None, deadline=None)

Change = tuple[str, int, float]  # a column, a row, and what stands there
COUNT = 12


def of_ply(make: Callable[[Path], object], folder: Path, changes: list[Change]) -> Path:
    """The folder that `make` fills once, with changed numbers in its PLY. A name stands for every column that begins with it."""
    sound = folder.with_name("sound.ply")
    if not sound.exists():
        make(folder)
        shutil.copyfile(next(folder.rglob("*.ply")), sound)
    columns = {name: column.copy() for name, column in read_ply(sound).columns.items()}
    for prefix, row, value in changes:
        for name in (name for name in columns if name.startswith(prefix)):
            columns[name][row % len(columns[name])] = value
    ply_files.write(next(folder.rglob("*.ply")), columns)
    return folder


def of_tensors(write: Callable[..., Path], folder: Path, changes: list[Change]) -> Path:
    """As `of_ply`, for the projects that save with torch: a name stands for the whole row of the tensor."""
    raw = torch_checkpoints.splats(COUNT)
    names = {"x": "means", "scale": "scales", "rot": "quats", "opacity": "opacities", "f_dc": "sh0", "f_rest": "shN"}
    for prefix, row, value in changes:
        if prefix in names:
            raw[names[prefix]][row % COUNT] = value
    shutil.rmtree(folder, ignore_errors=True)
    return write(folder, raw)


def mip(folder: Path, options: str) -> None:
    ply_files.write_splats(folder / "point_cloud/iteration_7000/point_cloud.ply", COUNT, 3)
    file = folder / "point_cloud/iteration_7000/point_cloud.ply"
    ply_files.write(file, {**read_ply(file).columns, "filter_3D": np.full(COUNT, 0.01, np.float32)})
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=1, {options})")


ANCHORS = {"distance": ("opacity_mlp", "color_mlp")}
FAMILIES = {
    "3dgs": partial(of_ply, partial(tiny.folder, count=COUNT)),
    "mip": partial(of_ply, partial(mip, options="kernel_size=0.1")),
    "gof": partial(of_ply, partial(mip, options="use_decoupled_appearance=False, kernel_size=0.0")),
    "analytic": partial(of_ply, partial(mip, options="load_allres=False")),
    "scaffold": partial(of_ply, partial(anchor_checkpoints.write, layout=Layout(**ANCHORS), count=COUNT)),
    "octree": partial(of_ply, partial(anchor_checkpoints.write, layout=Layout("octree", **ANCHORS, to_level="progressive"), count=COUNT)),
    "deformable": partial(of_ply, partial(moving.write_deformable, state=moving.deform_state(width=16))),
    "deformable, 6 DoF": partial(of_ply, partial(moving.write_deformable, state=moving.deform_state(width=16, six_dof=True))),
    "4dgs": partial(of_ply, moving.write_hexplane),
    "gsplat": partial(of_tensors, torch_checkpoints.gsplat_folder),
    "splatfacto": partial(of_tensors, torch_checkpoints.splatfacto_folder),
}


def assert_finite(model, backend, camera, effects):
    """The image and the gradients of all parameters."""
    student = model.copy()
    rendered = get_backend(backend).render(student.gaussians(camera), camera, effects)
    both = torch.cat([rendered.image, rendered.alpha[..., None]], dim=-1)
    assert both.isfinite().all(), f"{backend}: the image is not finite"
    weights = torch.rand(both.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    (both * weights).sum().backward()
    leaves = {**student.parameters(), **student.shared_parameters()}
    wrong = [name for name, leaf in leaves.items() if leaf.grad is not None and not leaf.grad.isfinite().all()]
    assert not wrong, f"{backend}: the gradients of {wrong} are not finite"
