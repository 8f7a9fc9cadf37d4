"""A place that cannot be written to: one sentence that says which, why, and what to do, before any work."""

import errno
import os
from unittest.mock import Mock

import pytest
import tiny

from mipmap_plugin.cli import main
from mipmap_plugin.errors import OutputError, of_a_file
from mipmap_plugin.evaluation.cells import Cells
from mipmap_plugin.formats import atomic
from mipmap_plugin.formats.atomic import refuse_unwritable, write_json

WHAT_TO_DO = {
    errno.ENOSPC: "free some, or choose another disk",
    errno.EROFS: "choose a place that you may write to (--output)",
    errno.EACCES: "choose a place that you may write to (--output)",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EIO: "choose another path",
}


def refusing(number):
    return Mock(side_effect=OSError(number, os.strerror(number)))


@pytest.mark.parametrize("number", WHAT_TO_DO)
def test_a_refusal_of_the_system_says_what_to_do(tmp_path, monkeypatch, number):
    monkeypatch.setattr(atomic, "Staging", refusing(number))
    with pytest.raises(OutputError) as refused:
        write_json(tmp_path / "rows.json", {}, overwrite=False)
    assert str(refused.value) == f"{tmp_path / 'rows.json'} cannot be written: {os.strerror(number)}; {WHAT_TO_DO[number]}"


def test_a_folder_that_is_not_there_yet_is_tried_too(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "Staging", refusing(errno.EPERM))
    with pytest.raises(OutputError, match="Operation not permitted; choose a place that you may write to"):
        refuse_unwritable(tmp_path / "new" / "newer" / "file.json")


@pytest.mark.parametrize(
    "words",
    [
        ["adapt", "{base}", "--scale", "1/4"],
        ["adapt", "{base}", "--scale", "1/4", "--tiles", "2"],
        ["render", "{base}"],
        ["levels", "{base}", "--viewer", "spark"],
        ["tradeoff", "{base}", "--scale", "1/4", "--no-picture"],
        ["view", "{base}", "--no-browser"],
        ["demo"],
    ],
    ids=lambda words: " ".join(words),
)
@pytest.mark.parametrize("place", ["refused", "below a file"])
def test_every_command_that_writes_says_so_before_any_work(tmp_path, monkeypatch, capsys, words, place):
    base = tiny.ply(tmp_path / "base.ply")
    for work in ("render", "adapt"):
        monkeypatch.setattr(f"mipmap_plugin.wrap.Wrapped.{work}", lambda *_, **__: pytest.fail("worked in vain"))
    output = base / "out" if place == "below a file" else tmp_path / "new" / "out"
    if place == "refused":
        monkeypatch.setattr(atomic, "Staging", refusing(errno.EROFS))
    assert main([*(word.format(base=base) for word in words), "--output", str(output)]) == 2
    [said] = [line for line in capsys.readouterr().err.splitlines() if "cannot be written" in line]
    assert str(output) in said and ("is a file, not a folder; choose another path" in said or "Read-only file system; choose a place" in said)


def test_an_error_that_nobody_foresaw_is_a_sentence(tmp_path, monkeypatch, capsys):
    full = OSError(errno.ENOSPC, "No space left on device", "/tmp/mipmap-plugin-ab12_x9z/plain.ply")
    monkeypatch.setattr("mipmap_plugin.models.load_model", Mock(side_effect=full))
    assert main(["inspect", str(tiny.ply(tmp_path / "base.ply"))]) == 2
    said = capsys.readouterr().err
    assert said.startswith("mipmap-plugin: /tmp/mipmap-plugin-ab12_x9z/plain.ply: No space left on device; check that path")
    assert "TMPDIR names another place" in said and "Errno" not in said


def test_and_has_no_advice_on_temporary_files_where_it_is_about_others():
    assert "TMPDIR" not in of_a_file(PermissionError(errno.EACCES, "Permission denied", "scan.ply"))
    assert "TMPDIR" not in of_a_file(PermissionError(errno.EACCES, "Permission denied", "/home/me/mipmap-plugin-main/scan.ply"))
    assert of_a_file(OSError("odd")).startswith("odd; check that path")


def test_a_cell_that_cannot_be_kept_is_an_output_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file, not a folder"):
        Cells(tmp_path / "file" / "kept").keep({"row": 1}, {"psnr": 1.0})
