"""A lone adapted file is looked at by the cameras of its base, where these are found."""

import json
import shutil
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.errors import TEMPORARY
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.models import zipped_folder
from mipmap_plugin.scenes import load_scene, write_cameras

pytestmark = pytest.mark.usefixtures("few_views")


def instant(base, target, cameras=None):
    """A file adapted from `base` in no step."""
    wrapped = wrap_model(base, cameras=cameras and load_scene(cameras))
    return wrapped.adapt(1 / 2, recipe="instant").save(target)


def poses(path) -> torch.Tensor:
    return torch.stack([view.viewmat for view in wrap_model(path).cameras])


@pytest.fixture
def base(tmp_path):
    return tiny.folder(tmp_path / "base")


def test_the_cameras_in_the_folder_of_the_base_are_found(base, tmp_path):
    assert torch.equal(poses(instant(base, tmp_path / "elsewhere" / "adapted.ply")), poses(base))


def test_they_are_found_beside_options_that_cannot_be_read(base, tmp_path):
    """Some projects write what is no literal; the base itself is read without its options, too."""
    (base / "cfg_args").write_text("Namespace(sh_degree=1, mode=<Mode.FAST: 1>)")
    assert torch.equal(poses(instant(base, tmp_path / "adapted.ply")), poses(base))


def test_cameras_that_were_given_are_found(base, tmp_path):
    cameras = write_cameras(tmp_path / "given.json", tiny.cameras(3))
    adapted = instant(tiny.ply(tmp_path / "lone.ply"), tmp_path / "adapted.ply", cameras)
    assert len(poses(adapted)) == 3


def test_those_beside_the_file_come_first(base, tmp_path):
    adapted = instant(base, tmp_path / "adapted")
    write_cameras(tmp_path / "adapted" / "cameras.json", tiny.cameras(2), overwrite=True)
    assert len(poses(adapted)) == 2


@pytest.mark.parametrize("spoil", ["gone", "changed", "damaged"])
def test_cameras_that_are_not_what_they_were_are_not_taken(base, tmp_path, spoil):
    adapted = instant(base, tmp_path / "adapted.ply")
    if spoil == "gone":
        shutil.rmtree(base)
    elif spoil == "changed":
        write_cameras(base / "cameras.json", tiny.cameras(2), overwrite=True)
    else:
        (base / "cameras.json").write_text("{")
    with pytest.warns(UserWarning, match="cameras that are not found any more.*give the scene's cameras"):
        assert wrap_model(adapted).cameras == []


@pytest.mark.parametrize("record", [{}, {"scene": 3}, {"options": "x"}, None])
def test_a_report_without_a_place_is_one_of_before(base, tmp_path, record):
    adapted = instant(base, tmp_path / "adapted.ply")
    report = adapted.with_name(adapted.name + ".adaptation.json")
    report.write_text(json.dumps(json.loads(report.read_text()) | {"cameras_from": record}))
    assert wrap_model(adapted).cameras == []


def test_a_job_knows_them_without_loading(base, tmp_path):
    adapted = instant(base, tmp_path / "adapted.ply")
    assert Base(adapted).asked() == Base(adapted).load().asked


def test_those_of_an_archive_are_found_in_it_again(base, tmp_path, monkeypatch, capsys):
    archive = shutil.make_archive(str(tmp_path / "zipped"), "zip", tmp_path, "base")
    expected, adapted = poses(base), instant(archive, tmp_path / "adapted.ply")
    monkeypatch.setattr(zipped_folder, "_OPENED", {})  # as in a later process, when what was unpacked is gone
    assert torch.equal(poses(adapted), expected)
    assert main(["inspect", str(adapted), "--no-viewers"]) == 0 and f", of its base, in {archive}" in capsys.readouterr().out
    assert main(["inspect", archive, "--no-viewers"]) == 0 and "of its base" not in capsys.readouterr().out


def test_what_another_process_unpacked_is_not_recorded(base, tmp_path):
    unpacked = tmp_path / f"{TEMPORARY}ab12_x9z" / "base"
    shutil.copytree(base, unpacked)
    assert not wrap_model(unpacked).cameras_from


def test_a_file_in_another_frame_names_none(base, tmp_path):
    adapted = wrap_model(base).adapt(1 / 2, recipe="instant")
    adapted.model.traits = replace(adapted.model.traits, placed=True)
    assert adapted.report.cameras_from and not adapted.report_of(tmp_path / "lone.ply").cameras_from


def test_render_says_whose_cameras_these_are(base, tmp_path, capsys):
    adapted = instant(base, tmp_path / "adapted.ply")
    assert main(["render", str(adapted), "--output", str(tmp_path / "pictures")]) == 0
    assert f"seen by the cameras of its base, in {base}; --cameras gives others" in capsys.readouterr().out
    assert len([*(tmp_path / "pictures").iterdir()]) == len(tiny.cameras())


def test_render_says_nothing_of_a_base(base, tmp_path, capsys):
    assert main(["render", str(base), "--output", str(tmp_path / "pictures")]) == 0
    assert "its base" not in capsys.readouterr().out
