"""The names of adapted files are those by which their bases are called."""

import pytest
import tiny
from ply_files import write_model_folder
from torch_checkpoints import gsplat_folder, splatfacto_folder, splats

from mipmap_plugin.cli import main
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.pages import AdaptationPage, evaluation_page_path
from mipmap_plugin.models import load_model
from mipmap_plugin.models.adapted_name import adapted_name


@pytest.fixture
def linked(tmp_path):
    """A file and a folder as caches of downloads have them: links with the names, to places that are called by what is in them."""
    (tmp_path / "blobs").mkdir()
    (tmp_path / "cache").mkdir()
    tiny.ply(tmp_path / "made.ply").rename(tmp_path / "blobs/4fa1")
    tiny.folder(tmp_path / "blobs/77c0")
    (tmp_path / "cache/scene.ply").symlink_to("../blobs/4fa1")
    (tmp_path / "cache/bicycle").symlink_to("../blobs/77c0")
    return tmp_path / "cache"


@pytest.mark.parametrize(("name", "adapted"), [("scene.ply", "scene_x0.25.ply"), ("bicycle", "bicycle_x0.25")])
def test_what_is_adapted_from_a_link_lies_beside_the_link_and_has_its_name(linked, name, adapted):
    assert main(["adapt", str(linked / name), "--scale", "1/4", "--recipe", "instant"]) == 0
    assert len(load_model(linked / adapted)) == 60
    assert {path.name for path in (linked.parent / "blobs").iterdir()} == {"4fa1", "77c0"}


def test_the_page_of_an_evaluation_has_the_name_of_a_link(linked):
    assert evaluation_page_path(linked / "scene.ply", None).name == "scene.ply.evaluation.html"


@pytest.mark.parametrize("given", [".", "point_cloud/.."])
def test_a_folder_that_is_given_from_within_has_its_own_name(tmp_path, monkeypatch, given):
    folder = tiny.folder(tmp_path / "bicycle")
    monkeypatch.chdir(folder)
    assert adapted_name(type(folder)(given), 1 / 4) == "bicycle_x0.25"


def test_what_is_adapted_from_an_iteration_lies_beside_the_model_folder_where_3dgs_looks_for_none(tmp_path, monkeypatch):
    folder = write_model_folder(tmp_path / "bicycle", 7000)
    given = folder / "point_cloud/iteration_7000"
    assert adapted_path(given, None, 1 / 4, several=False) == tmp_path / "bicycle_iteration_7000_x0.25"
    assert adapted_path(given, tmp_path / "all", 1 / 4, several=True) == tmp_path / "all/bicycle_iteration_7000_x0.25"
    monkeypatch.chdir(given)
    assert adapted_path(type(folder)("."), None, 1 / 4, "spark", several=False) == tmp_path / "bicycle_iteration_7000_x0.25_spark"
    (tmp_path / "iteration_7000").mkdir()
    assert adapted_path(tmp_path / "iteration_7000", None, 1 / 4, several=False) == tmp_path / "iteration_7000_x0.25"


@pytest.mark.parametrize("linked", ["bicycle", "bicycle/point_cloud"])
def test_a_link_around_an_iteration_is_not_followed(tmp_path, linked):
    """As to a larger disk: what 3DGS looks through is there, too."""
    folder = write_model_folder(tmp_path / "bicycle", 7000)
    (tmp_path / linked).rename(tmp_path / "elsewhere")
    (tmp_path / linked).symlink_to(tmp_path / "elsewhere")
    assert adapted_path(folder / "point_cloud/iteration_7000", None, 1 / 4, several=False) == tmp_path / "bicycle_iteration_7000_x0.25"


@pytest.mark.parametrize(
    ("make", "step", "name", "for_spark"),
    [
        (splatfacto_folder, "nerfstudio_models/step-000029999.ckpt", "run_step-000029999.ckpt_x0.25", "run_step-000029999_x0.25_spark.ply"),
        (gsplat_folder, "ckpts/ckpt_6999_rank0.pt", "run_ckpt_6999_rank0.pt_x0.25", "run_ckpt_6999_rank0_x0.25_spark.ply"),
    ],
)
def test_what_is_adapted_from_one_step_lies_beside_the_run_where_nerfstudio_looks_for_none(tmp_path, make, step, name, for_spark):
    make(tmp_path / "run", splats())
    assert (tmp_path / "run" / step).is_file()
    assert adapted_path(tmp_path / "run" / step, None, 1 / 4, several=False) == tmp_path / name
    assert adapted_path(tmp_path / "run" / step, None, 1 / 4, "spark", several=False) == tmp_path / for_spark


def test_the_pages_of_iterations_of_two_models_have_names_of_their_own(tmp_path):
    """Both lie beside the model folders."""
    paths = []
    for name in ("bicycle", "garden"):
        given = write_model_folder(tmp_path / name, 7000) / "point_cloud/iteration_7000"
        targets = [adapted_path(given, None, scale, several=True) for scale in (1 / 2, 1 / 4)]
        paths.append(AdaptationPage(given, targets, overwrite=False, all_finished=False).path)
    assert paths == [tmp_path / f"{name}_iteration_7000_adapted.report.html" for name in ("bicycle", "garden")]
