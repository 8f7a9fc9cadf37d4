"""Every family of checkpoints with hard rows among ordinary ones: splats, image and gradients are finite, or the file is refused."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import anchor_checkpoints
import moving
import numpy as np
import ply_files
import pytest
import tiny
import torch_checkpoints
from anchor_checkpoints import Layout
from hypothesis import given, settings
from hypothesis import strategies as st
from test_any_checkpoint import assert_finite, known, numbers

from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import load_model

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
PREFIXES = ["x", "z", "scale", "scale_0", "rot", "rot_0", "opacity", "f_dc", "f_rest", "filter_3D", "f_offset", "f_anchor_feat", "level", "extra"]

# The part of the renderers' catalog that a file can hold.
ROWS = {
    "scale 0": [("scale", 3, -np.inf)],
    "scale 1e-9": [("scale", 3, float(np.log(1e-9)))],
    "scale 1e4": [("scale", 3, float(np.log(1e4)))],
    "needle": [("scale", 3, float(np.log(1e-3))), ("scale_0", 3, float(np.log(1e3)))],
    "log scale 88": [("scale", 3, 88.0)],
    "quaternion 0": [("rot", 3, 0.0)],
    "quaternion of norm 1e-30": [("rot", 3, 1e-30)],
    "quaternion of norm 1e30": [("rot", 3, 1e30)],
    "logit 80": [("opacity", 3, 80.0)],
    "logit -80": [("opacity", 3, -80.0)],
    "logit infinite": [("opacity", 3, np.inf)],
    "far away": [("z", 3, 1e6), ("x", 3, 1e6)],
    "bright": [("f_dc", 3, 1e3), ("f_rest", 3, 1e3)],
    "dark": [("f_dc", 3, -1e3), ("f_rest", 3, -1e3)],
    "large features": [("f_anchor_feat", 3, 1e6), ("f_offset", 3, 1e6)],
    "filter 0": [("filter_3D", 3, 0.0)],
    "filter 1e6": [("filter_3D", 3, 1e6)],
    **{f"NaN in {prefix}": [(prefix, 3, np.nan)] for prefix in PREFIXES},
    **{f"infinity in {prefix}": [(prefix, 3, np.inf)] for prefix in ("x", "scale", "rot", "f_rest")},
    "every row the same": [(prefix, row, 0.1) for prefix in PREFIXES if prefix != "level" for row in range(COUNT)],
}


VIEW = tiny.cameras(1, width=8, height=6)[0]


def check(folder: Path, make: Callable[[Path, list[Change]], Path], changes: list[Change], cameras=(VIEW,)) -> str:
    """Whether the model was "drawn" or "refused"."""
    folder.mkdir(exist_ok=True)
    try:
        model = load_model(make(folder / "m", changes))
    except MipmapPluginError as error:
        assert "\n" not in str(error)
        return "refused"
    effects = Effects(1, model.trained.screen_filter, model.trained.eps2d, near_plane=0.01)
    for camera in cameras:
        assert_finite(model, "reference", replace(camera, time=0.3), effects)
    return "drawn"


@pytest.mark.parametrize("family", FAMILIES)
def test_one_extreme_row_neither_changes_the_other_rows_nor_refuses_the_file(tmp_path, family):
    outcomes = {name: check(tmp_path / "work", FAMILIES[family], changes) for name, changes in ROWS.items()}
    refused = {name for name, outcome in outcomes.items() if outcome == "refused"}
    assert refused <= ({"every row the same"} if family == "octree" else set())


changes = st.lists(st.tuples(st.sampled_from(PREFIXES), st.integers(0, COUNT - 1), numbers | st.sampled_from([np.nan, np.inf])), max_size=5)


@pytest.mark.parametrize("family", FAMILIES)
@settings(known, max_examples=12)
@given(changes=changes)
def test_any_numbers_in_a_familys_file(tmp_path_factory, family, changes):
    check(tmp_path_factory.getbasetemp() / family, FAMILIES[family], changes)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
@settings(known, max_examples=1000)
@given(changes=changes)
def test_any_numbers_in_a_familys_file_at_length(tmp_path_factory, family, changes):
    check(tmp_path_factory.getbasetemp() / family, FAMILIES[family], changes, (VIEW, VIEW.zoomed(1 / 64), VIEW.zoomed(16)))
