"""Detection: every family and exchange format by its bytes, and the right file of a model folder."""

import gzip
import random

import numpy as np
import pytest
import torch
import torch_checkpoints
from ply_files import splat_columns, write, write_model_folder, write_splats

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.cfg_args import format_cfg_args, read_cfg_args
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
    with pytest.raises(CheckpointError, match=r"hall.lcc is LCC of XGRIDS, which is not read here; convert it: splat-transform hall.lcc hall.ply"):
        detect(tmp_path / "hall.lcc")


def test_point_cloud_is_not_a_splat(tmp_path):
    write(tmp_path / "points3D.ply", f4("x", "y", "z", "red", "green", "blue"))
    with pytest.raises(CheckpointError, match="plain point cloud or a mesh"):
        detect(tmp_path / "points3D.ply")


@pytest.mark.parametrize("lost", ["opacity", "scale_0", "rot_0"])
def test_splats_without_one_of_their_columns_are_not_called_a_point_cloud(tmp_path, lost):
    columns = splat_columns(3)
    del columns[lost]
    with pytest.raises(CheckpointError, match=f"it lacks the columns {lost}; export it again"):
        detect(write(tmp_path / "a.ply", columns))


def test_newest_iteration_by_number_among_strays(tmp_path):
    folder = write_model_folder(tmp_path / "m", 7000)
    write_splats(folder / "point_cloud/iteration_30000/point_cloud.ply")
    (folder / "point_cloud/.DS_Store").touch()
    (folder / "point_cloud/coarse_iteration_99999").mkdir()
    checkpoint = detect(folder)
    assert (checkpoint.iteration, checkpoint.folder, checkpoint.notes) == (30000, folder, ())
    assert detect(folder, iteration=7000).iteration == 7000
    assert detect(folder / "point_cloud/iteration_7000/point_cloud.ply").folder == folder


def test_an_incomplete_newest_iteration_is_passed_over_with_a_note(tmp_path):
    folder = write_model_folder(tmp_path / "m", 7000)
    newest = write_splats(folder / "point_cloud/iteration_30000/point_cloud.ply")
    newest.write_bytes(newest.read_bytes()[:-1])
    checkpoint = detect(folder)
    assert checkpoint.iteration == 7000
    assert "iteration_7000 is used, since" in checkpoint.notes[0]
    assert "truncated" in checkpoint.notes[0]
    with pytest.raises(CheckpointError, match="truncated"):
        detect(folder, iteration=30000)


def test_a_folder_above_its_checkpoints_names_them(tmp_path):
    runs = [tmp_path / "outputs/poster/splatfacto" / day for day in ("2024-05-01_120000", "2024-05-02_120000")]
    for run in runs:
        torch_checkpoints.splatfacto_folder(run, torch_checkpoints.splats())
    for above in ("outputs", "outputs/poster", "outputs/poster/splatfacto"):
        with pytest.raises(CheckpointError) as caught:
            detect(tmp_path / above)
        assert str(caught.value) == f"{tmp_path / above} lies above its checkpoints; give {runs[1]} or {runs[0]}"
    write_model_folder(tmp_path / "scenes/garden")
    adapted = write_model_folder(tmp_path / "scenes/garden_x0.25")
    (cloud,) = adapted.glob("point_cloud/*/*.ply")
    cloud.with_name(f"{cloud.name}.adaptation.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"scenes lies above its checkpoint; give .*garden$"):
        detect(tmp_path / "scenes")


def test_folders_without_an_answer(tmp_path):
    folder = write_model_folder(tmp_path / "m", 7000)
    with pytest.raises(CheckpointError, match="has no iteration_5; it has 7000"):
        detect(folder, iteration=5)
    with pytest.raises(CheckpointError, match="is a file and has no iterations"):
        detect(folder / "point_cloud/iteration_7000/point_cloud.ply", iteration=5)
    (tmp_path / "e/point_cloud").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="holds no iteration_<N> folder"):
        detect(tmp_path / "e")
    (tmp_path / "empty/below").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="no point_cloud folder and no file of splats"):
        detect(tmp_path / "empty")
    with pytest.raises(CheckpointError, match="does not exist"):
        detect(tmp_path / "none")


def test_folder_with_one_ply_and_with_several(tmp_path):
    only = write_splats(tmp_path / "fused.ply")
    assert detect(tmp_path).path == only
    write_splats(tmp_path / "other.ply")
    with pytest.raises(CheckpointError, match=r"2 files of splats \(fused.ply, other.ply\)"):
        detect(tmp_path)
    named = write_splats(tmp_path / "point_cloud.ply")
    assert detect(tmp_path).path == named


def test_cfg_args_of_every_shape(tmp_path):
    options = {"sh_degree": 3, "source_path": "C:\\scenes\\a", "eval": True, "render_items": ["RGB"], "k": {"a": [1, 2.5]}, "n": None}
    (tmp_path / "cfg_args").write_text(format_cfg_args(options))
    assert read_cfg_args(tmp_path / "cfg_args") == options


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "Namespace(**{'a': 1})",
        "Namespace(1)",
        "Namespace(a=1",
        "Namespace(a=1, a=2)",
        "Namespace(a=" + "-" * 20_000 + "1)",
        "Namespace(a=" + "(" * 5_000 + ")" * 5_000 + ")",
        "Namespace(a='\udcff')",
    ],
)
def test_hostile_cfg_args_are_refused_and_not_run(tmp_path, text):
    (tmp_path / "cfg_args").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(CheckpointError, match="is not executed") as caught:
        read_cfg_args(tmp_path / "cfg_args")
    assert len(str(caught.value)) < 400


def test_endless_cfg_args_are_refused(tmp_path):
    (tmp_path / "cfg_args").write_text("Namespace(a='" + "x" * 70_000 + "')")
    with pytest.raises(CheckpointError, match="64 kB"):
        read_cfg_args(tmp_path / "cfg_args")


def test_real_companions_are_named(shared_data):
    folder = shared_data / "checkpoints"
    for path, sentence in {
        "octree_mlps/color_mlp.pt": "TorchScript",
        "deform/deform.pth": "deformation network",
        "lod_tiles": "4 files of splats",
    }.items():
        with pytest.raises(CheckpointError, match=sentence):
            load_model(folder / path)


def test_the_suffix_of_a_ply_in_a_folder_may_be_in_capitals(tmp_path):
    assert detect(write_splats(tmp_path / "My Scan (1).PLY", count=3).parent).path.name == "My Scan (1).PLY"


def test_the_state_of_a_training_is_refused_with_what_to_give_instead(tmp_path):
    torch.save(((3, torch.zeros(2, 3)), 30000), tmp_path / "chkpnt30000.pth")
    with pytest.raises(CheckpointError, match=r"the state of a training, .* give the model folder that it lies in"):
        detect(tmp_path / "chkpnt30000.pth")


def test_a_folder_with_one_exchange_file_is_that_file(tmp_path):
    """As is one with one PLY, before which it does not come."""
    for name in ("cameras.json", "scene.SPZ"):
        (tmp_path / name).write_bytes(b"NGSP" + bytes(64))
    assert detect(tmp_path).path == tmp_path / "scene.SPZ"
    write_splats(tmp_path / "base.ply")
    assert detect(tmp_path).path == tmp_path / "base.ply"


def test_a_folder_with_several_exchange_files_names_them(tmp_path):
    for name in ("a.spz", "b.splat"):
        (tmp_path / name).write_bytes(b"NGSP" + bytes(64))
    with pytest.raises(CheckpointError, match=r"holds 2 files of splats \(a.spz, b.splat\); give one file"):
        detect(tmp_path)


@pytest.mark.parametrize(
    ("there", "said"),
    [
        ("export/a.ply", "no file of splats, but export; give one file"),
        ("images/a.jpg", r"no file of splats, but photographs or what a scene is trained on \(that is for --images and --cameras\); give one file"),
        ("a.JPG", "no file of splats, but photographs"),
        ("transforms_train.json", "no file of splats, but photographs or what a scene is trained on"),
        ("notes.txt", "no file of splats; give one file"),
    ],
)
def test_a_folder_without_splats_says_what_it_holds_instead(tmp_path, there, said):
    (tmp_path / there).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / there).write_bytes(b"x")
    with pytest.raises(CheckpointError, match=said):
        detect(tmp_path)
