"""Files of related projects, and side files: read as what they are, or refused by name."""

import json

import numpy as np
import pytest
import torch
from ply_files import splat_columns, write, write_model_folder, write_splats
from torch_checkpoints import gsplat_folder, live_model, splats
from zip_files import archive

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.live import adopt

COLUMNS = splat_columns(4, bands=0)
ONE = COLUMNS["x"]
LEVELS = {"level": ONE, "extra_level": ONE}


def named(*names):
    return dict.fromkeys(names, ONE)


ANCHORS = named("x", "y", "z", *(f"f_offset_{i}" for i in range(3)), *(f"scale_{i}" for i in range(6)), *(f"rot_{i}" for i in range(4)))
EXPLICIT = {**ANCHORS, **named("f_dc_0", "f_dc_1", "f_dc_2", "opacity")}


@pytest.mark.parametrize(
    "columns",
    [EXPLICIT, {**EXPLICIT, **LEVELS}, {**ANCHORS, "f_anchor_feat_0": ONE}, {**ANCHORS, **LEVELS, **named("f_anchor_feat_0", "opacity")}],
    ids=["explicit", "explicit, levels", "anchors", "anchors, levels"],
)
def test_octree_anygs_is_refused_by_name(tmp_path, columns):
    """Its explicit models have all columns of 3DGS, and further ones that change the splats."""
    path = write(tmp_path / "a.ply", columns)
    assert detect(path).family == "anygs"
    with pytest.raises(CheckpointError, match="this is an Octree-AnyGS checkpoint"):
        load_model(path)


@pytest.mark.parametrize(
    ("without", "added", "said"),
    [
        ("nothing", ["scale_3"], "scale_3"), ("opacity", ["opacity1", "opacity2"], "3D-HGS"),
        ("f_", ["sh0_0", "sh0_1", "sh0_2", "beta"], "Deformable Beta Splatting"),
    ],
)  # fmt: skip
def test_columns_of_other_splats_are_refused_by_name(tmp_path, without, added, said):
    columns = {name: column for name, column in COLUMNS.items() if not name.startswith(without)}
    with pytest.raises(CheckpointError, match=said):
        load_model(write(tmp_path / "a.ply", {**columns, **named(*added)}))


def test_hac_is_refused_by_name(tmp_path):
    folder = write_model_folder(tmp_path / "m")
    ply = folder / "point_cloud/iteration_7000/point_cloud.ply"
    write(ply, {**ANCHORS, **named("f_anchor_feat_0", "opacity", "f_mask_0")})
    torch.save({}, ply.with_name("checkpoint.pth"))
    with pytest.raises(CheckpointError, match=r"HAC.*checkpoint\.pth"):
        load_model(folder)


def test_the_error_for_saga_names_the_file_of_its_scene(tmp_path):
    folder = write_model_folder(tmp_path / "m")
    ply = folder / "point_cloud/iteration_7000/point_cloud.ply"
    scene = ply.rename(ply.with_name("scene_point_cloud.ply"))
    with pytest.raises(CheckpointError, match=r"SAGA.*scene_point_cloud\.ply"):
        load_model(folder)
    assert len(load_model(scene)) == 5
    features = {name: column for name, column in COLUMNS.items() if not name.startswith("f_")}
    with pytest.raises(CheckpointError, match="SAGA"):
        load_model(write(tmp_path / "contrastive_feature_point_cloud.ply", {**features, **named("f_0", "f_1")}))


def test_a_ply_of_3dgrut_is_read_with_a_note(tmp_path):
    up = {name: np.full(4, value, np.float32) for name, value in {"nx": 0, "ny": 0, "nz": 1}.items()}
    assert any("3DGRUT, MetalSplatter and wgpu-3dgs write" in note for note in load_model(write(tmp_path / "a.ply", {**COLUMNS, **up})).notes)
    askew = up | {"nz": np.linspace(0.9, 1, 4, dtype=np.float32)}
    assert not any("3DGRUT" in note for note in load_model(write(tmp_path / "b.ply", {**COLUMNS, **askew})).notes)


ADAM = {"state": {}, "param_groups": [{"params": [0], "name": name} for name in ("xyz", "t", "scaling_t", "rotation_r")]}
OF_3DGRUT = ("positions", "rotation", "scale", "density", "features_albedo", "features_specular")
OTHERS = {
    "chkpnt_best.pth": (lambda path: torch.save(((3, torch.zeros(2, 3), ADAM), 30_000), path), "fudan-zvg"),
    "ckpt_last.pt": (
        lambda path: torch.save({name: torch.zeros(2, 3) for name in OF_3DGRUT} | {"optimizer": {"param_groups": []}}, path),
        r"3DGRUT.*give the PLY that it exports",
    ),
    **{
        f"a.{ending}": (lambda path: archive(path, {"default.usda": "{}"}), "is USD, which is not read here; export a PLY")
        for ending in ("usd", "usda", "usdc", "usdz")
    },
    "a.ssproj": (lambda path: archive(path, {"document.json": "{}"}), r"is a project of SuperSplat, .* export a PLY"),
    "a.psht": (lambda path: path.write_bytes(bytes(range(7)) * 9), r"is a project of Postshot; .* export a PLY"),
    "a.rad": (lambda path: path.write_bytes(b"RAD0" + bytes(range(7)) * 9), r"is RAD of Spark, .* the file that it was made from"),
    "a.html": (lambda path: path.write_text("<!DOCTYPE html>\n<html>"), r"is a web page; if it shows a scene, .* export the scene as a PLY"),
    "merged.hier": (lambda path: path.write_bytes(bytes(range(7)) * 9), r"Hierarchical 3D Gaussians.*trained_chunks"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_file_of_another_project_has_its_own_sentence(tmp_path, name):
    make, sentence = OTHERS[name]
    make(tmp_path / name)
    with pytest.raises(CheckpointError, match=sentence):
        load_model(tmp_path / name)


@pytest.mark.parametrize(("without", "lacks"), [(("opacity",), "opacity"), (("scale_0", "rot_0"), "rot_0, scale_0")])
def test_splats_without_some_of_their_columns_are_no_point_cloud(tmp_path, without, lacks):
    """Some programs call them scaling_0 and rotation_0."""
    columns = {f"other_{name}" if name in without else name: column for name, column in COLUMNS.items()}
    with pytest.raises(CheckpointError, match=f"is no whole 3DGS checkpoint: it lacks the columns {lacks}; export it again with them"):
        load_model(write(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("place", [".", "meta.json"])
def test_pictures_of_gsplat_have_their_own_sentence(tmp_path, place):
    facts = {name: {"shape": [4, 3], "dtype": "float32", "mins": [0, 0, 0], "maxs": [1, 1, 1]} for name in ("means", "scales", "quats")}
    (tmp_path / "meta.json").write_text(json.dumps(facts))
    with pytest.raises(CheckpointError, match=r"PngCompression.*ckpt_"):
        load_model(tmp_path / place)


def test_one_option_that_is_no_literal_costs_only_itself(tmp_path):
    """argparse writes inf and nan, and objects, as no Python literal."""
    options = "far=inf, white_background=True, where=PosixPath('a'), a=__import__('os'), resolution=2"
    folder = write_model_folder(tmp_path / "m", cfg_args=f"Namespace({options})")
    assert read_cfg_args(folder / "cfg_args") == {"white_background": True, "resolution": 2}
    model = load_model(folder)
    assert model.trained.background == (1.0, 1.0, 1.0) and model.trained.resolution == 2
    assert any("far, where, a cannot be read" in note for note in model.notes)


def test_a_note_says_that_antialiasing_is_unknown(tmp_path):
    new = load_model(write_model_folder(tmp_path / "new", cfg_args="Namespace(sh_degree=3, depths='', train_test_exp=False)"))
    old = load_model(write_model_folder(tmp_path / "old", cfg_args="Namespace(sh_degree=3)"))
    tagged = write_splats(tmp_path / "tag" / "point_cloud.ply", comments=("SplatRenderMode: mip",))
    (tagged.parent / "cfg_args").write_text("Namespace(sh_degree=3, train_test_exp=False)")
    noted = [any("--antialiasing" in note for note in model.notes) for model in (new, old, load_model(tagged.parent))]
    assert noted == [True, False, False]


@pytest.mark.parametrize(
    ("options", "word"),
    [("with_ut: true\nwith_eval3d: true", "with_ut, with_eval3d"), ("use_bilateral_grid: true", "grid"), ("post_processing: ppisp", "correction")],
)
def test_a_note_names_what_gsplat_does_differently(tmp_path, options, word):
    folder = gsplat_folder(tmp_path / "r", splats())
    plain = load_model(folder).notes
    with (folder / "cfg.yml").open("a") as file:
        file.write(f"\n{options}\n")
    new = [note for note in load_model(folder).notes if note not in plain]
    assert len(new) == 1 and word in new[0]


def test_options_that_gsplat_did_not_use_have_no_note(tmp_path):
    folder = gsplat_folder(tmp_path / "r", splats())
    plain = load_model(folder).notes
    with (folder / "cfg.yml").open("a") as file:
        file.write("\nwith_ut: false\nuse_bilateral_grid: false\npost_processing: null\n")
    assert load_model(folder).notes == plain


def test_a_live_canonical_cloud_is_taken_with_a_note():
    """The class of Deformable 3D Gaussians has the tensors of 3DGS, without `capture`; the network is another object."""
    assert any("Deformable" in note for note in adopt(live_model(splats())).notes)
    assert not any("Deformable" in note for note in adopt(live_model(splats(), capture=tuple)).notes)


def rows_of_zeros(path, count):
    """A PLY of 400 splats, of which the last `count` are not there yet, as where a download has set the size of its file first."""
    columns = splat_columns(400)
    for column in columns.values():
        column[400 - count :] = 0
    return write(path, columns)


def test_a_download_that_has_not_ended_is_refused_where_its_file_has_its_size_already(tmp_path):
    path = rows_of_zeros(tmp_path / "a.ply", 5)
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    told = "is not whole: 5 of 400 rows hold nothing but zeros, as where a download or a copy has not ended; download or copy it again"
    assert str(caught.value) == f"{path} {told}"


def test_a_few_rows_of_zeros_are_left_out(tmp_path):
    with pytest.warns(UserWarning, match="4 of 400 splats were dropped: they hold nothing but zeros"):
        assert len(load_model(rows_of_zeros(tmp_path / "a.ply", 4))) == 396


def test_a_splat_without_a_quaternion_is_kept(tmp_path):
    columns = splat_columns(4)
    for i in range(4):
        columns[f"rot_{i}"][0] = 0
    assert len(load_model(write(tmp_path / "a.ply", columns))) == 4
