"""What Windows does otherwise, simulated: it refuses to move and remove files in use, names other characters and capitals alike, and ends pipes."""

import errno
import io
import os
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import like_windows
import pytest
import tiny

from mipmap_plugin import cli, errors
from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats import here, staging
from mipmap_plugin.formats.atomic import new_file, new_folder, together, write_json
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.jobs.listing import read_list
from mipmap_plugin.jobs.worker import Worker, WorkerDied

NO_PROC = not os.path.isdir("/proc/self/fd")

COMMANDS = {
    "adapt": ["adapt", "base", "--steps", "2"],
    "tiles": ["adapt", "base", "--steps", "2", "--tiles", "2"],
    "levels": ["levels", "base", "--viewer", "antialiased", "--coarsest", "1/2", "--ratio", "2", "--recipe", "instant", "--views", "given"],
    "render": ["render", "base", "--depth"],
    "evaluate": ["evaluate", "base", "--images", "scene", "--recipe", "instant", "--no-report"],
    "tradeoff": ["tradeoff", "base", "--images", "scene", "--recipe", "instant", "--no-picture"],
}


@pytest.fixture
def refused(monkeypatch):
    if NO_PROC:
        pytest.skip("needs /proc, which tells the files in use")
    return like_windows.pretend(monkeypatch)


@pytest.mark.usefixtures("few_views", "brief_ladders")
@pytest.mark.parametrize("name", COMMANDS)
def test_every_output_is_written_and_replaced_and_nothing_stays_beside_it(tmp_path, monkeypatch, request, name):
    monkeypatch.chdir(tmp_path)
    tiny.folder(tmp_path / "base", tiny.cameras(3))
    tiny.scene(tmp_path / "scene")
    refused = request.getfixturevalue("refused")
    output = {"evaluate": "out.json"}.get(name, "out")
    scale = [] if name == "levels" else ["--scale", "1/2"]
    words = [*COMMANDS[name], *scale, "--output", output, "--backend", "reference", "--quiet"]
    assert cli.main(words) == 0
    assert cli.main([*words, "--overwrite"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"base", "scene", output}
    assert {os.path.basename(file) for file in refused} <= {staging.HELD}  # which marks the folder of a living run


def test_a_folder_is_its_runs_for_as_long_as_that_lives(tmp_path, refused):
    folder = tmp_path / ".out.lock"
    living = staging.claim(folder)
    assert living is not None and staging.claim(folder) is None
    staging.release(folder, living)
    assert not folder.exists()


def test_what_a_killed_run_left_is_no_obstacle(tmp_path, refused):
    killed = staging.Staging(tmp_path / "out")
    (killed.new / "part").write_text("half")
    os.close(killed._lock)  # as the system does
    with new_file(tmp_path / "out", overwrite=False) as temporary:
        temporary.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_as_many_runs_as_there_is_room_for_keep_apart(tmp_path, refused):
    living = [staging.Staging(tmp_path / "out") for _ in range(staging.SLOTS)]
    with pytest.raises(OutputError, match="8 other runs are writing to it"), new_file(tmp_path / "out", overwrite=False):
        pass
    for each in living:
        each.close()
    assert not any(tmp_path.iterdir())


def test_what_is_open_elsewhere_is_replaced_with_its_report_or_not_at_all(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(errors, "os", SimpleNamespace(name="nt"))
    report = tmp_path / "out.ply.json"
    for text in ("old", "new"):
        opened = (tmp_path / "out.ply").open("rb") if text == "new" else nullcontext()
        said = pytest.raises(OutputError, match="used by another process; close it where it is open, or choose") if text == "new" else nullcontext()
        with opened, said, together(tmp_path / "out.ply"):
            for file in (tmp_path / "out.ply", report):
                with new_file(file, overwrite=True) as temporary:
                    temporary.write_text(text)
    assert report.read_text() == (tmp_path / "out.ply").read_text() == "old" and len([*tmp_path.iterdir()]) == 2


def test_a_folder_with_a_file_that_is_open_elsewhere_is_replaced_with_its_report_or_not_at_all(tmp_path, refused):
    part, report = tmp_path / "out" / "part", tmp_path / "out.json"

    def write(text):
        with together(part.parent):
            with new_folder(part.parent, overwrite=True) as temporary:
                (temporary / part.name).write_text(text)
            with new_file(report, overwrite=True) as temporary:
                temporary.write_text(text)

    write("old")
    with part.open("rb"), pytest.raises(OutputError, match="used by another process"):
        write("new")
    assert report.read_text() == part.read_text() == "old" and len([*tmp_path.iterdir()]) == 2


def test_a_list_that_powershell_wrote_is_read(tmp_path):
    (tmp_path / "list.txt").write_bytes("output/città\r\n".encode("utf-16"))
    assert read_list(tmp_path / "list.txt") == [Path("output/città")]


def test_names_of_pictures_are_of_characters_that_it_takes_and_differ_in_more_than_capitals():
    view = tiny.cameras(1)[0]
    named = [replace(view, name=name, split="train") for name in ("12:30", 'a*?"<>|', "Gate", "gate", "GATE_1")]
    assert picture_names(named) == ["train_12_30.png", "train_a______.png", "train_Gate_2.png", "train_gate_3.png", "train_GATE_1.png"]


def test_a_command_to_type_is_quoted_for_its_shell(monkeypatch):
    monkeypatch.setattr(here, "os", SimpleNamespace(name="nt"))
    assert here.typed(["mipmap-plugin", "adapt", r"C:\my scene\base.ply"]) == r'mipmap-plugin adapt "C:\my scene\base.ply"'


def test_json_has_the_same_bytes_on_every_system(tmp_path, monkeypatch):
    def translating(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, real=io.open):
        return real(file, mode, buffering, encoding, errors, "\r\n" if newline is None and "w" in mode else newline)

    monkeypatch.setattr(io, "open", translating)
    write_json(tmp_path / "facts.json", {"a": 1}, overwrite=False)
    assert (tmp_path / "facts.json").read_bytes() == b'{\n  "a": 1\n}\n'


class Ended(io.StringIO):
    """A pipe that nobody reads any more."""

    def __init__(self, number):
        super().__init__()
        self._number = number

    def fileno(self):
        return self._number

    def flush(self):
        raise OSError(errno.EINVAL, "Invalid argument")


def test_a_pipe_that_nobody_reads_ends_a_command_as_elsewhere(tmp_path, monkeypatch, capsys):
    with (tmp_path / "out").open("wb") as file:
        monkeypatch.setattr("sys.stdout", Ended(file.fileno()))
        assert cli.main(["list"]) == 141
    assert capsys.readouterr().err == ""


def test_a_worker_that_ended_before_it_got_its_job_is_told_so(tmp_path):
    def broken(*_):
        raise OSError(errno.EINVAL, "Invalid argument")

    worker = Worker(1)
    worker._process = SimpleNamespace(stdin=SimpleNamespace(write=broken, close=broken), stdout=io.BytesIO(), wait=lambda: 1)
    with pytest.raises(WorkerDied, match="ended with exit code 1"):
        worker.begin(Job(Base(tmp_path / "base.ply"), tmp_path / "out.ply", 1 / 2))
