"""A PLY or a model folder in a zip archive: read if it is alone there, and refused in a sentence otherwise."""

import errno
import struct
import tempfile
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
from ply_files import write
from zip_files import archive, packed

from mipmap_plugin import wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats import zipped
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import detect, load_model, zipped_folder
from mipmap_plugin.recipes import register_recipe

pytestmark = pytest.mark.usefixtures("few_views")

END_OF_ARCHIVE = 22  # bytes


@pytest.fixture
def ply(tmp_path):
    return tiny.ply(tmp_path / "own.ply").read_bytes()


def refused(path, sentence):
    with pytest.raises(CheckpointError, match=sentence):
        load_model(path)


def spoil_one_row(path):
    """A NaN in a PLY."""
    columns = read_ply(path).columns
    columns["x"][3] = np.nan
    return write(path, columns)


def test_a_part_of_an_archive_is_refused(tmp_path, ply):
    """By its last bytes, which tell of another disk."""
    whole = archive(tmp_path / "phone.zip", {"scan.ply": ply}).read_bytes()
    where = struct.pack("<4sLQL", b"PK\x06\x07", 1, 0, 2)
    (tmp_path / "phone.zip").write_bytes(whole[:-END_OF_ARCHIVE] + where + whole[-END_OF_ARCHIVE:])
    refused(tmp_path / "phone.zip", "is a damaged zip archive .*multiple disks")


@pytest.mark.parametrize("name", ["scan.ply", "my scan/point_cloud.PLY", "../../etc/out.ply", "/out.ply"])
def test_one_ply_is_read_wherever_its_name_leads(tmp_path, ply, name):
    before = {path.name for path in tmp_path.iterdir()}
    model = load_model(archive(tmp_path / "phone.zip", {name: ply, "__MACOSX/._scan.ply": b"x", ".DS_Store": b"x"}))
    assert (len(model), model.source, len(model.digest)) == (60, tmp_path / "phone.zip", 64)
    assert {path.name for path in tmp_path.iterdir()} == before | {"phone.zip"}


def test_adapt_writes_a_ply_beside_it(tmp_path, ply):
    archive(tmp_path / "phone.zip", {"scan.ply": ply})
    assert main(["adapt", str(tmp_path / "phone.zip"), "--scale", "1/2", "--recipe", "instant"]) == 0
    assert len(load_model(tmp_path / "phone_x0.5.ply")) == 60


@pytest.mark.parametrize("beside", ["cameras.json", "other.ply", "images/1.jpg"])
def test_what_lies_beside_it_is_never_left_out_silently(tmp_path, ply, beside):
    both = {"m/point_cloud.ply": ply, f"m/{beside}": b"x"}
    refused(archive(tmp_path / "a.zip", both), "a.zip is a zip archive; unpack it and give the PLY or the folder")


def test_what_would_fill_the_disk_is_not_unpacked(tmp_path, ply, monkeypatch):
    rows = {name: np.zeros(20_000, np.float32) for name in read_ply(tmp_path / "own.ply").columns}
    trap = archive(tmp_path / "trap.zip", {"a.ply": write(tmp_path / "zeros.ply", rows).read_bytes()})
    refused(trap, "would be more than 100 times as large unpacked")
    monkeypatch.setattr(zipped.shutil, "disk_usage", lambda _: zipped.shutil._ntuple_diskusage(1, 1, 0))
    refused(archive(tmp_path / "a.zip", {"a.ply": ply}), r"a.zip needs 0.0 GiB unpacked, for which .* has no room")


def test_a_damaged_archive_is_one_sentence(tmp_path, ply):
    path = archive(tmp_path / "a.zip", {"a.ply": ply})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    refused(path, "a.zip is a damaged zip archive")


def test_what_is_doubtful_is_told_by_the_archives_name(tmp_path, ply):
    with pytest.warns(UserWarning, match="^the PLY in .*one.zip: 1 of 60 splats was dropped"):
        load_model(archive(tmp_path / "one.zip", {"a.ply": spoil_one_row(tmp_path / "own.ply").read_bytes()}))


def test_a_ply_that_is_no_base_is_told_of_by_the_archives_name(tmp_path, ply):
    cloud = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    refused(archive(tmp_path / "mesh.zip", {"a.ply": cloud}), "the PLY in .*mesh.zip is a plain point cloud")
    columns = read_ply(tmp_path / "own.ply").columns
    no_number = write(tmp_path / "nan.ply", {**columns, "x": np.full(60, np.nan, np.float32)}).read_bytes()
    refused(archive(tmp_path / "nan.zip", {"a.ply": no_number}), "^the PLY in .*nan.zip: none of 60 splats is finite")
    filtered = write(tmp_path / "mip.ply", {**columns, "filter_3D": np.ones(60, np.float32)}).read_bytes()
    refused(archive(tmp_path / "mip.zip", {"a.ply": filtered}), "mip.zip holds a PLY of Mip-Splatting; unpack it")
    made = wrap_model(tmp_path / "own.ply").adapt(1 / 2, recipe="instant").save(tmp_path / "made.ply")
    refused(archive(tmp_path / "made.zip", {"a.ply": made.read_bytes()}), "made.zip holds a file that was adapted; unpack it")


@pytest.fixture
def folder(tmp_path):
    return tiny.folder(tmp_path / "trained" / "model")


@pytest.mark.parametrize("top", ["my model", "", "../../up", "deep/er"])
def test_a_model_folder_is_read_with_its_cameras(tmp_path, folder, top):
    base, before = wrap_model(packed(tmp_path / "a.zip", folder, top)), {*tmp_path.rglob("*")}
    assert torch.equal(base.model.parameters()["means"], load_model(folder).parameters()["means"])
    assert [view.name for view in base.cameras] == [view.name for view in tiny.cameras()]
    assert {*tmp_path.rglob("*")} == before and detect(tmp_path / "a.zip").path == base.model.source


def test_what_is_adapted_from_it_is_a_folder_beside_it(tmp_path, folder):
    packed(tmp_path / "a.zip", folder)
    words = ["adapt", str(tmp_path / "a.zip"), "--scale", "1/2", "--recipe", "instant"]
    assert main(words) == 0 and len(load_model(tmp_path / "a_x0.5")) == 60
    assert (tmp_path / "a_x0.5" / "cameras.json").is_file()


def test_it_is_unpacked_once_and_without_its_pictures(tmp_path, folder, monkeypatch):
    path = packed(tmp_path / "a.zip", folder, beside={"my model/test/ours_7000/1.png": b"x", "my model/point_cloud/more.txt": b"x"})
    place = zipped_folder.unzipped(path)
    assert not (place / "test").exists() and (place / "point_cloud" / "more.txt").exists()
    monkeypatch.setattr(zipped_folder, "copied", None)
    assert zipped_folder.unzipped(path) == place and len(load_model(path)) == 60


@pytest.mark.parametrize("name", ["point_cloud/../../x", ".."])
def test_a_name_that_leads_out_of_the_folder_is_refused(tmp_path, folder, name):
    path = packed(tmp_path / "a.zip", folder, beside={f"my model/{name}": b"x"})
    refused(path, "a.zip holds the name .* which leads out of its folder; do not open it")
    assert not list(tmp_path.rglob("x"))


@pytest.mark.parametrize("name", ["log_12:30:01.txt", "c:x", "point_cloud/..\\x"])
def test_a_name_that_windows_takes_for_a_place_is_left_out(tmp_path, folder, name):
    place = zipped_folder.unzipped(packed(tmp_path / "a.zip", folder, beside={f"my model/{name}": b"x"}))
    assert {path.name for path in place.iterdir()} == {path.name for path in folder.iterdir()}
    assert not list(place.rglob("*x")) and not list(place.parent.glob("*x"))


def test_a_folder_that_would_fill_the_disk_is_not_unpacked(tmp_path, folder):
    refused(packed(tmp_path / "a.zip", folder, beside={"my model/zeros": bytes(10**7)}), "would be more than 100 times as large unpacked")


def test_of_several_folders_one_has_to_be_given(tmp_path, folder):
    ply = next(folder.rglob("point_cloud.ply")).read_bytes()
    other = {"other/point_cloud/iteration_7/point_cloud.ply": ply}
    refused(packed(tmp_path / "a.zip", folder, beside=other), r"a.zip holds 2 model folders \(my model, other\); unpack it")


def test_a_full_disk_is_not_told_as_a_damaged_archive(tmp_path, folder, ply, monkeypatch):
    monkeypatch.setattr(zipped.shutil, "copyfileobj", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    for path in (packed(tmp_path / "a.zip", folder), archive(tmp_path / "b.zip", {"a.ply": ply})):
        refused(path, f"{path.name} cannot be unpacked in .* \\(No space left on device\\); make room there")


def test_what_is_wrong_inside_is_told_by_the_archives_name(tmp_path, folder):
    [splats] = folder.rglob("point_cloud.ply")
    spoil_one_row(splats)
    with pytest.warns(UserWarning, match="a.zip/point_cloud/.*1 of 60 splats was dropped"):
        load_model(packed(tmp_path / "a.zip", folder))
    splats.write_bytes(b"ply")
    refused(packed(tmp_path / "b.zip", folder), "^[^;]*b.zip has no whole checkpoint: [^;]*b.zip/point_cloud/")


@pytest.mark.parametrize("tiles", [[], ["--tiles", "2"]])
def test_commands_tell_what_is_wrong_by_the_archives_name(tmp_path, folder, capsys, tiles):
    spoil_one_row(*folder.rglob("point_cloud.ply"))
    path = packed(tmp_path / "a.zip", folder)
    with pytest.warns(UserWarning, match="1 of 60 splats was dropped"):
        wrap_model(folder).adapt(1 / 2, recipe="instant").save(tmp_path / "made")
    made = packed(tmp_path / "made.zip", tmp_path / "made")
    words = ["--scale", "1/2", "--recipe", "instant", "--output", str(tmp_path / "out"), *tiles]
    assert (main(["adapt", str(path), *words]), main(["adapt", str(made), *words, "--overwrite"])) == (0, 2)
    said = capsys.readouterr().err
    assert f"{path}/point_cloud" in said and f"{made}/point_cloud" in said and tempfile.gettempdir() + "/mipmap" not in said


def test_a_list_tells_what_is_wrong_by_the_archives_name(tmp_path, folder, capsys):
    wrap_model(folder).adapt(1 / 2, recipe="instant").save(tmp_path / "made")
    made = packed(tmp_path / "made.zip", tmp_path / "made")
    words = ["--scale", "1/2", "--recipe", "instant", "--output", str(tmp_path / "out")]
    assert main(["adapt", str(made), str(packed(tmp_path / "a.zip", folder)), *words]) != 0
    told = capsys.readouterr()
    assert f"{made}/point_cloud" in told.out and tempfile.gettempdir() + "/mipmap" not in told.out + told.err


def test_workers_leave_nothing_unpacked(tmp_path, folder, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    for name in ("a", "b"):
        packed(tmp_path / f"{name}.zip", folder)
    register_recipe("instant", "mipmap_plugin.recipes:instant", replace=True)  # what workers know
    assert main(["adapt", str(tmp_path / "*.zip"), "--scale", "1/2", "--recipe", "instant", "--jobs", "2"]) == 0
    assert len(list((tmp_path / "temporary").glob("mipmap-plugin-*"))) == 2  # of this process, which has not ended
    assert (tmp_path / "a_x0.5").is_dir() and (tmp_path / "b_x0.5").is_dir()
