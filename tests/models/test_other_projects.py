"""What projects derived from 3DGS save: read where it is the same, and refused by name where it has the columns of 3DGS and another meaning."""

from pathlib import Path

import pytest
import torch
from ply_files import CFG_ARGS, splat_columns, write, write_model_folder, write_splats

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.outputs import without_place

COLUMNS = splat_columns(4, bands=3)
ONE = COLUMNS["x"]


@pytest.mark.parametrize(
    ("without", "added", "said"),
    [
        ("nothing", ["f_asg_0"], "Spec-Gaussian"), ("nothing", ["refl"], "3DGS-DR"), ("f_", ["f_intr_0"], "GS-W"),
        ("nothing", ["roughness", "specular0", "specular1", "specular2"], "GaussianShader"), ("nothing", ["binding_0"], "GaussianAvatars"),
        ("nothing", ["degree", "negative"], "Student Splatting"), ("f_", [], "without colors"),
    ],
)  # fmt: skip
def test_columns_that_change_what_is_drawn_are_refused_by_name(tmp_path, without, added, said):
    columns = {name: column for name, column in COLUMNS.items() if not name.startswith(without)}
    with pytest.raises(CheckpointError, match=said):
        load_model(write(tmp_path / "a.ply", {**columns, **dict.fromkeys(added, ONE)}))


@pytest.mark.parametrize("added", [["roughness", "base_color_0"], ["degree"], ["obj_dc_0"], ["semantic_0"], ["embedding_0", "embedding_1"]])
def test_columns_beside_whole_colors_are_carried_along(tmp_path, added):
    """Relightable 3D Gaussian's harmonics are whole colors, whatever else it stores; so are those of projects that add features."""
    model = load_model(write(tmp_path / "a.ply", {**COLUMNS, **dict.fromkeys(added, ONE)}))
    assert set(model.extras) == set(added)


def test_a_laser_scan_with_reflections_is_a_point_cloud(tmp_path):
    with pytest.raises(CheckpointError, match="plain point cloud"):
        load_model(write(tmp_path / "a.ply", dict.fromkeys(("x", "y", "z", "refl"), ONE)))


def test_many_numbered_columns_are_named_in_short(tmp_path):
    extra = dict.fromkeys(["label", *(f"semantic_{i}" for i in range(512)), "k_0", "k_1"], ONE)
    (note,) = load_model(write(tmp_path / "a.ply", {**COLUMNS, **extra})).notes
    assert note == "extra columns are carried along: label, semantic_0 to semantic_511, k_0, k_1"


def test_of_many_other_columns_the_first_are_named(tmp_path):
    extra = [f"{word}_{of}" for word in ("mean", "var", "min", "max") for of in ("color", "depth", "normal")]
    model = load_model(write(tmp_path / "a.ply", {**COLUMNS, **dict.fromkeys(extra, ONE)}))
    told = f"{', '.join(extra[:8])} and 4 more"
    assert model.notes == [f"extra columns are carried along: {told}"]
    assert without_place(Path("a.glb"), model.extras, 0) == f"the extra columns {told} are dropped, since .glb has no place for them; a .ply has"


def test_e_d3dgs_is_not_taken_for_4dgaussians(tmp_path):
    folder = write_model_folder(tmp_path / "m")
    ply = folder / "point_cloud/iteration_7000/point_cloud.ply"
    write(ply, {**COLUMNS, "embedding_0": ONE})
    torch.save({}, ply.with_name("deformation.pth"))
    with pytest.raises(CheckpointError, match="E-D3DGS"):
        load_model(folder)


def test_ever_is_known_by_its_options(tmp_path):
    """Its columns are those of 3DGS, but its harmonics are stored in another order, and its lengths are no logarithms."""
    options = CFG_ARGS.replace(")", ", max_opacity=0.99, tmin=0.2)")
    with pytest.raises(CheckpointError, match="is of EVER"):
        load_model(write_model_folder(tmp_path / "m", cfg_args=options))


def test_unreadable_options_are_not_those_of_ever(tmp_path):
    assert load_model(write_model_folder(tmp_path / "m", cfg_args="Namespace(")).family == "3dgs"


@pytest.mark.parametrize("left_out", ["f_rest_", "scale_", "f_"])
def test_compact3d_is_refused_where_codebooks_hold_the_rest(tmp_path, left_out):
    """Without the harmonics it would be a scene of SH degree 0."""
    write(tmp_path / "point_cloud.ply", {name: column for name, column in COLUMNS.items() if not name.startswith(left_out)})
    torch.save({}, tmp_path / "kmeans_centers.pth")
    with pytest.raises(CheckpointError, match=r"decompress_to_ply\.py, and give point_cloud_decompressed\.ply"):
        load_model(tmp_path / "point_cloud.ply")
    assert len(load_model(write_splats(tmp_path / "point_cloud_decompressed.ply", bands=0))) == 5


def test_a_scene_in_one_file_of_grendel_is_read(tmp_path):
    folder = write_model_folder(tmp_path / "m")
    ply = folder / "point_cloud/iteration_7000/point_cloud.ply"
    ply = ply.rename(ply.with_name("point_cloud_rk0_ws1.ply"))
    assert detect(folder).path == ply
    assert len(load_model(folder)) == 5


@pytest.mark.parametrize("given", ["folder", "file"])
def test_one_of_several_files_of_grendel_is_refused(tmp_path, given):
    folder = write_model_folder(tmp_path / "m")
    whole = folder / "point_cloud/iteration_7000/point_cloud.ply"
    parts = [write_splats(whole.with_name(f"point_cloud_rk{rank}_ws12.ply")) for rank in range(12)]
    whole.unlink()
    with pytest.raises(CheckpointError, match=r"12 files in all .*splat-transform point_cloud_rk\*_ws12\.ply joined\.ply$"):
        load_model(folder if given == "folder" else parts[-1])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("point_cloud_state_dict.pt", r"has point_cloud_state_dict\.pt, but no point_cloud\.ply, which is what is read here; give a PLY"),
        ("point_cloud.npz", r"has point_cloud\.npz, but no point_cloud\.ply, .* npz2ply\.py"),
    ],
)
def test_an_iteration_without_a_ply_says_what_it_has(tmp_path, name, said):
    folder = write_model_folder(tmp_path / "m")
    ply = folder / "point_cloud/iteration_7000/point_cloud.ply"
    ply.rename(ply.with_name(name))
    with pytest.raises(CheckpointError, match=said):
        load_model(folder)


def test_street_gaussians_are_refused_by_name(tmp_path):
    path = write(tmp_path / "a.ply", COLUMNS)
    path.write_bytes(path.read_bytes().replace(b"element vertex ", b"element vertex_background "))
    with pytest.raises(CheckpointError, match="Street Gaussians"):
        load_model(path)
