"""Folders: which checkpoint of them is taken, what their options say, and what is said where there is none."""

import numpy as np
import pytest
import torch
import torch_checkpoints
from ply_files import write, write_model_folder, write_splats

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.cfg_args import format_cfg_args, read_cfg_args
from mipmap_plugin.models.detect import detect


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
    (tmp_path / "scenes/garden/point_cloud/iteration_7000/point_cloud_x0.25.ply.adaptation.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"scenes lies above its checkpoint; give .*garden$"):
        detect(tmp_path / "scenes")


def test_a_run_in_which_a_file_adapted_from_its_step_lies_is_no_adaptation(tmp_path):
    for name in ("garden", "garden_x0.25"):
        torch_checkpoints.gsplat_folder(tmp_path / name, torch_checkpoints.splats())
    (tmp_path / "garden/ckpts/small.pt.adaptation.json").write_text("{}")
    (tmp_path / "garden_x0.25/ckpts/ckpt_6999_rank0.pt.adaptation.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"lies above its checkpoint; give .*garden$"):
        detect(tmp_path)


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


def test_of_a_link_is_told_where_it_leads(tmp_path):
    (tmp_path / "a.ply").symlink_to("blobs/4fa1")
    with pytest.raises(CheckpointError, match=r"a\.ply is a link to blobs.4fa1, which does not exist; give"):
        detect(tmp_path / "a.ply")


def test_folder_with_one_ply_and_with_several(tmp_path):
    only = write_splats(tmp_path / "fused.ply")
    assert detect(tmp_path).path == only
    write_splats(tmp_path / "other.ply")
    with pytest.raises(CheckpointError, match=r"2 files of splats \(fused.ply, other.ply\)"):
        detect(tmp_path)
    named = write_splats(tmp_path / "point_cloud.ply")
    assert detect(tmp_path).path == named


def test_points_that_a_training_starts_from_are_no_file_of_splats(tmp_path):
    for name in ("input.ply", "points3D.ply"):
        write(tmp_path / name, {column: np.zeros(2, np.float32) for column in ("x", "y", "z", "red")})
    with pytest.raises(CheckpointError, match=r"no file of splats, but plain point clouds or meshes \(input.ply, points3D.ply\); give one file"):
        detect(tmp_path)
    only = write_splats(tmp_path / "splat.ply")
    assert detect(tmp_path).path == only


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
        "Namespace(a='\0')",
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
