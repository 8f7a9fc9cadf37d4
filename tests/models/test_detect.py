"""Detection: every family and exchange format by its bytes."""

import gzip
import random

import numpy as np
import pytest
import torch
import torch_checkpoints
from ply_files import splat_columns, write, write_model_folder, write_splats

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.magic import SPLAT_RECORD
from mipmap_plugin.models import load_model
from mipmap_plugin.models.detect import detect


def f4(*names: str) -> dict[str, np.ndarray]:
    return {name: np.zeros(2, np.float32) for name in names}


SPLAT = splat_columns(2, bands=0)
FAMILY_COLUMNS = {
    "3dgs": SPLAT,
    "mip": {**SPLAT, **f4("filter_3D")},
    "2dgs": {name: column for name, column in SPLAT.items() if name != "scale_2"},
    "scaffold": f4("x", "y", "z", "f_offset_0", "f_anchor_feat_0", "opacity", "scale_0", "rot_0"),
    "octree": f4("x", "y", "z", "level", "extra_level", "info", "f_offset_0", "f_anchor_feat_0", "opacity", "scale_0", "rot_0"),
    "spacetime": {**SPLAT, **f4("trbf_center")},
    "sc-gs": {**SPLAT, **f4("fea_0")},
}


@pytest.mark.parametrize("family", FAMILY_COLUMNS)
def test_family_by_columns(tmp_path, family):
    assert detect(write(tmp_path / "a.ply", FAMILY_COLUMNS[family])).family == family


def test_a_file_of_no_splats_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="holds no splats: its header declares none"):
        detect(write_splats(tmp_path / "a.ply", count=0))


@pytest.mark.parametrize(
    ("write", "part"),
    [(torch_checkpoints.splatfacto_folder, "config.yml"), (torch_checkpoints.splatfacto_folder, "nerfstudio_models"),
     (torch_checkpoints.gsplat_folder, "cfg.yml"), (torch_checkpoints.gsplat_folder, "ckpts"), (None, "cfg_args"), (None, "point_cloud")],
)  # fmt: skip
def test_a_part_of_a_model_folder_names_the_folder(tmp_path, write, part):
    """nerfstudio's own commands take the config.yml."""
    folder = write(tmp_path / "run", torch_checkpoints.splats()) if write else write_model_folder(tmp_path / "run")
    with pytest.raises(CheckpointError, match=rf"run.{part} is one (file|part) of a model folder; give the folder, .*run$"):
        detect(folder / part)


def test_family_by_header_tag(tmp_path):
    assert detect(write(tmp_path / "a.ply", SPLAT, comments=("SplatRenderMode: 2dgs",))).family == "2dgs"


@pytest.mark.parametrize(
    ("options", "family"), [("kernel_size=0.1", "mip"), ("kernel_size=0.0, use_decoupled_appearance=True", "gof"), ("load_allres=False", "analytic")]
)
def test_family_of_filter_3d_by_options(tmp_path, options, family):
    folder = write_model_folder(tmp_path / "m", cfg_args=f"Namespace({options})")
    write(folder / "point_cloud/iteration_7000/point_cloud.ply", FAMILY_COLUMNS["mip"])
    assert detect(folder).family == family


def test_family_by_companions(tmp_path):
    dynamic = write_model_folder(tmp_path / "4d")
    torch.save({}, dynamic / "point_cloud/iteration_7000/deformation.pth")
    assert detect(dynamic).family == "4dgs"
    for family, key in {"deformable": "linear.0.weight", "sc-gs": "nodes"}.items():
        folder = write_model_folder(tmp_path / family)
        (folder / "deform/iteration_7000").mkdir(parents=True)
        torch.save({key: torch.zeros(1)}, folder / "deform/iteration_7000/deform.pth")
        assert detect(folder).family == detect(folder / "point_cloud/iteration_7000/point_cloud.ply").family == family


@pytest.mark.parametrize(
    ("content", "family"), [({"step": 1, "splats": {}}, "gsplat"), ({"pipeline": {"_model.gauss_params.means": torch.zeros(1)}}, "splatfacto")]
)
def test_family_of_torch_files(tmp_path, content, family):
    torch.save(content, tmp_path / "a.pt")
    assert detect(tmp_path / "a.pt").family == family
    with pytest.raises(CheckpointError):  # there are no splats in it
        load_model(tmp_path / "a.pt")


@pytest.mark.parametrize(
    ("content", "sentence"), [({"linear.0.weight": 0}, "deformation network"), ([{"param_groups": []}, 7], "training run"), (1, "no known")]
)
def test_torch_files_that_are_no_model(tmp_path, content, sentence):
    torch.save(content, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=sentence):
        detect(tmp_path / "a.pth")


def test_result_folders_of_gsplat_and_splatfacto(tmp_path):
    contents = {"gsplat": {"splats": {}}, "splatfacto": {"pipeline": {}}}
    strays = {"gsplat": "ckpts/ckpt_99999_x4.pt", "splatfacto": "nerfstudio_models/step-latest.ckpt"}
    written = {"gsplat": ["ckpts/ckpt_29999_rank0.pt", "ckpts/ckpt_29999_rank1.pt", "ckpts/ckpt_6999_rank0.pt"]}
    written["splatfacto"] = ["nerfstudio_models/step-000029999.ckpt"]
    for family, names in written.items():
        for name in [*names, strays[family]]:
            (tmp_path / family / name).parent.mkdir(parents=True, exist_ok=True)
            torch.save(contents[family], tmp_path / family / name)
        checkpoint = detect(tmp_path / family)
        assert (checkpoint.family, checkpoint.path, checkpoint.iteration) == (family, tmp_path / family / names[0], 29_999)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(gzip.compress(b"x", mtime=0), "gzip"), (b"PK\3\4broken", "damaged zip"), (b"hello", "no checkpoint")],
)
def test_other_files(tmp_path, content, sentence):
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(CheckpointError, match=sentence):
        detect(tmp_path / "a.bin")


@pytest.mark.parametrize("name", ["a.splat", "b.spz", "c.SOG", "d.ksplat", "e.ply", "f.glb"])
def test_a_damaged_file_of_splats_is_called_so(tmp_path, name):
    file = tmp_path / name
    file.write_bytes(random.Random(1).randbytes(320))
    with pytest.raises(CheckpointError, match=rf"{name} is damaged, cut off or no {file.suffix.lower()} file; download or export it again"):
        detect(file)


@pytest.mark.parametrize(("quat", "scale"), [((255, 0, 0, 0), 0.01), ((0, 0, 0, 0), 0.01), ((128, 128, 128, 128), 0.01), ((255, 128, 128, 128), 0)])
def test_a_splat_file_may_have_quaternions_of_any_length_and_sizes_of_zero(tmp_path, quat, scale):
    rows = np.zeros(20, SPLAT_RECORD)
    rows["scale"], rows["quat"], rows["color"] = scale, quat, 255
    rows.tofile(tmp_path / "points.splat")
    rows.tofile(tmp_path / "points.bin")  # without its name it could be anything
    assert detect(tmp_path / "points.splat").family == "exchange"
    with pytest.raises(CheckpointError, match="no checkpoint that is known here"):
        detect(tmp_path / "points.bin")


def test_a_capture_in_lcc_is_converted_first(tmp_path):
    (tmp_path / "hall.lcc").write_text('{"version": "5.0", "source": "lcc", "totalSplats": 9}')
    (tmp_path / "data.bin").write_bytes(bytes(99))
    sentence = "hall.lcc is LCC of XGRIDS, which is not read here; convert it: splat-transform hall.lcc hall.ply"
    for given in tmp_path / "hall.lcc", tmp_path:
        with pytest.raises(CheckpointError, match=sentence):
            detect(given)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("walk.MOV", "is a photograph or a video, not a trained scene; train one on it first"),
        ("IMG_1.jpg", "is a photograph or a video, not a trained scene; train one on it first"),
        ("chair.obj", "is a mesh or a plain point cloud, not Gaussian splats"),
        ("transforms_train.json", "holds cameras, not splats; give the checkpoint, and this file by --cameras"),
        ("notes.txt", "no checkpoint that is known here; give a PLY, .spz, .sog, .splat or .glb, or a model folder"),
    ],
)
def test_what_is_given_in_place_of_a_trained_scene(tmp_path, name, told):
    """Text of 32 bytes a line, which has the size of whole records of a .splat, and numbers that could be of one."""
    (tmp_path / name).write_text("v 0.125 0.250 0.375 0.5 0.5 0.5\n" * 3)
    with pytest.raises(CheckpointError, match=f"{name} {told}" if "known" not in told else told):
        detect(tmp_path / name)


def test_point_cloud_is_not_a_splat(tmp_path):
    write(tmp_path / "points3D.ply", f4("x", "y", "z", "red", "green", "blue"))
    with pytest.raises(CheckpointError, match="plain point cloud or a mesh"):
        detect(tmp_path / "points3D.ply")


def test_real_companions_are_named(shared_data):
    folder = shared_data / "checkpoints"
    for path, sentence in {
        "octree_mlps/color_mlp.pt": "TorchScript",
        "deform/deform.pth": "deformation network",
        "lod_tiles": "4 files of splats",
    }.items():
        with pytest.raises(CheckpointError, match=sentence):
            load_model(folder / path)
