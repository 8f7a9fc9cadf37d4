"""JSON output is readable by every parser; outputs replace nothing unasked, and are written completely or not at all."""

import json
import math
import os
import time
from pathlib import Path

import pytest

from mipmap_plugin.errors import OutputError, OutputExists
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.atomic import json_text, new_file, new_folder, refuse_output, refuse_to_lose, refuse_unwritable, together, write_json
from mipmap_plugin.formats.staging import settle


def test_numbers_that_json_lacks_are_null(tmp_path):
    facts = {"psnr_db": math.inf, "rows": [{"gain": -math.inf}, (1.5, math.nan)], "name": "Infinity", "count": 3, "known": True, "none": None}
    write_json(tmp_path / "a.json", facts, overwrite=False)
    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    assert read == facts | {"psnr_db": None, "rows": [{"gain": None}, [1.5, None]]}


@pytest.mark.parametrize("value", [0.1, -1e300, 10**30, 1e-320])
def test_other_numbers_come_back_as_they_were(value):
    assert json.loads(json_text([value])) == [value]


# What may be an output


def text(path, content="new", overwrite=True):
    with new_file(path, overwrite) as temporary:
        temporary.write_text(content)


def folder_of(path, content="new", overwrite=True):
    with new_folder(path, overwrite) as temporary:
        (temporary / "inside").mkdir()
        (temporary / "inside/a").write_text(content)


@pytest.mark.parametrize("write", [text, folder_of])
def test_devices_pipes_and_links_that_lead_nowhere_are_never_replaced(tmp_path, write):
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    for name, reason in [("/dev/null", "is a device"), ("pipe", "is a pipe"), ("dangling", "is a link to something that is not there"), ("loop", "")]:
        with pytest.raises((OutputExists, OutputError), match=rf"{name}.*{reason}"):
            write(tmp_path / name)
    assert {path.name for path in tmp_path.iterdir()} == {"dangling", "loop", "pipe"} and not Path("/dev/null").is_file()


def test_a_link_is_replaced_and_what_it_leads_to_stays(tmp_path):
    (tmp_path / "far").write_text("precious")
    (tmp_path / "near").symlink_to(tmp_path / "far")
    with pytest.raises(OutputExists, match="near exists already"):
        text(tmp_path / "near", overwrite=False)
    text(tmp_path / "near")
    assert ((tmp_path / "far").read_text(), (tmp_path / "near").read_text()) == ("precious", "new")


@pytest.mark.parametrize("path", ["/", "", ".", "..", "a/..", "x" * 300, f"{'x' * 300}/a", "a\0b", "a\0b/c", "\ud800", "\ud800/a"])
def test_paths_that_no_file_can_have_end_in_one_sentence(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((OutputExists, OutputError)):
        text(Path(path))
    assert list(tmp_path.iterdir()) == []


def test_the_base_is_known_by_every_name_that_it_has(tmp_path):
    base = tmp_path / "base/model.ply"
    base.parent.mkdir()
    base.write_text("precious")
    (tmp_path / "soft.ply").symlink_to(base)
    os.link(base, tmp_path / "hard.ply")
    (tmp_path / "by").symlink_to(tmp_path / "base")
    for name in ("base/model.ply", "soft.ply", "hard.ply", "by/model.ply", "base/../base/model.ply", "base", "by", "."):
        with pytest.raises(OutputExists, match="the base checkpoint itself"):
            refuse_output(tmp_path / name, True, [base])
    refuse_output(tmp_path / "base/other.ply", True, [base])


def test_a_disk_without_room_or_leave_is_refused_before_any_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    refuse_unwritable(tmp_path / "new/deep/a.ply", room=1)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    with pytest.raises(OutputError, match=r"a\.ply cannot be written: its disk has .* bytes free, and the base takes 1,000,000,000,000,000"):
        refuse_unwritable(tmp_path / "a.ply", room=10**15)
    with pytest.raises(OutputError, match=r"a\.ply cannot be written: .*file is a file, not a folder"):
        refuse_unwritable(tmp_path / "file/a.ply")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(OutputError, match=r"a\.ply cannot be written: no permission"):
        refuse_unwritable(tmp_path / "a.ply")


# All or nothing


def test_what_is_written_together_appears_together(tmp_path):
    with together(tmp_path / "a"):
        text(tmp_path / "a")
        text(tmp_path / "b")
        assert not (tmp_path / "a").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    with pytest.raises(ZeroDivisionError), together(tmp_path / "a"):
        text(tmp_path / "a", "newer")
        folder_of(tmp_path / "c")
        raise ZeroDivisionError
    assert (tmp_path / "a").read_text() == "new" and not (tmp_path / "c").exists()


def test_an_output_appears_after_its_companions(tmp_path, monkeypatch):
    """Whoever finds it finds them, whatever their names."""
    moved, replace = [], os.replace
    monkeypatch.setattr(os, "replace", lambda made, target: (moved.append(target.name), replace(made, target)))
    with together(tmp_path / "b"):
        for name in "bac":
            text(tmp_path / name)
    assert moved[-1] == "b" and sorted(moved) == ["a", "b", "c"]


@pytest.mark.parametrize("write", [text, folder_of])
def test_all_is_on_the_disk_before_it_gets_its_name_and_the_name_is_before_anything_else_goes(tmp_path, monkeypatch, write):
    moved, flushed, calls = object(), os.fsync, []
    for name, real in {"rename": os.rename, "replace": os.replace}.items():
        monkeypatch.setattr(os, name, lambda *given, real=real: (calls.append(moved), real(*given)))
    monkeypatch.setattr(os, "fsync", lambda opened: (calls.append(os.fstat(opened).st_ino), flushed(opened)))
    (tmp_path / "state").touch()
    with together(tmp_path / "out", [tmp_path / "state"]):
        write(tmp_path / "out")
    made = [tmp_path / "out", *(tmp_path / "out").rglob("*")]
    first, *_, last = (number for number, call in enumerate(calls) if call is moved)
    assert {path.stat().st_ino for path in made} <= set(calls[:first])
    assert tmp_path.stat().st_ino in calls[first:last]


def test_a_file_can_be_added_to_a_folder_that_is_being_made(tmp_path):
    folder_of(tmp_path / "a", "old")
    with together(tmp_path / "a"):
        folder_of(tmp_path / "a")
        text(tmp_path / "a/inside/report")
        assert (tmp_path / "a/inside/a").read_text() == "old"
    assert sorted(path.name for path in (tmp_path / "a/inside").iterdir()) == ["a", "report"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_an_error_names_the_output_and_not_the_place_where_it_is_made(tmp_path):
    with pytest.raises(OutputError) as reason, new_folder(tmp_path / "a", False) as temporary, new_file(temporary / "b", False):
        raise OSError(28, "No space left on device", "somewhere")
    assert str(reason.value).startswith(f"{tmp_path}/a/b cannot be written: No space left on device; ")


@pytest.mark.parametrize("exchanges", [True, False])
def test_folders_are_replaced_whole(tmp_path, monkeypatch, exchanges):
    if not exchanges:
        monkeypatch.setattr(staging, "exchange", lambda one, other: False)
    for content in ("old", "new"):
        folder_of(tmp_path / "a", content)
        assert (tmp_path / "a/inside/a").read_text() == content
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_that_cannot_be_moved_into_place_leaves_the_old_one(tmp_path, monkeypatch):
    """On a system that cannot exchange folders, where the old one is moved aside before."""
    folder_of(tmp_path / "a", "old")
    rename = os.rename

    def refused(made, target):
        if made.parent.name == "ready":
            raise PermissionError(13, "Permission denied")
        rename(made, target)

    monkeypatch.setattr(staging, "exchange", lambda one, other: False)
    monkeypatch.setattr(os, "rename", refused)
    with pytest.raises(OutputError, match="a cannot be written"):
        folder_of(tmp_path / "a", "new")
    assert (tmp_path / "a/inside/a").read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_dead_runs_left_is_put_right_by_whoever_comes_next(tmp_path):
    dead, ready = tmp_path / ".a.0.tmp", tmp_path / ".a.3.tmp"
    (dead / "new/a").mkdir(parents=True)
    (ready / "ready").mkdir(parents=True)
    (ready / "ready/a").write_text("whole")
    (ready / "ready/b").write_text("its companion")
    settle(tmp_path / "a")
    assert ((tmp_path / "a").read_text(), (tmp_path / "b").read_text()) == ("whole", "its companion")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


def test_a_disk_that_takes_no_further_folder_keeps_nothing_hidden(tmp_path, monkeypatch):
    mkdir = Path.mkdir

    def full(folder, *options, **named):
        if folder.name == "new":
            raise OSError(28, "No space left on device")
        mkdir(folder, *options, **named)

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(OutputError, match="No space left on device"):
        write_json(tmp_path / "a.json", {}, overwrite=False)
    assert not list(tmp_path.iterdir())


def test_what_a_living_run_makes_is_let_alone(tmp_path):
    with new_file(tmp_path / "a", False) as first:
        first.write_text("first")
        text(tmp_path / "b")  # beside it: at once with it
        living = staging.Staging(tmp_path / "a")
        (living.new / "a").write_text("second")
        settle(tmp_path / "a")
        assert first.exists() and (living.new / "a").exists()
        living.commit()
        living.close()
        assert (tmp_path / "a").read_text() == "second"
    assert (tmp_path / "a").read_text() == "first"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


def test_more_runs_than_there_is_room_for_end_in_one_sentence(tmp_path):
    opened = len(os.listdir("/dev/fd"))
    living = [staging.Staging(tmp_path / "a") for _ in range(staging.SLOTS)]
    with pytest.raises(OutputError, match="a cannot be written: 8 other runs are writing to it"):
        text(tmp_path / "a")
    assert len(os.listdir("/dev/fd")) == opened + len(living)
    for handle in living:
        handle.close()
    text(tmp_path / "a")


def test_without_locks_only_what_is_long_untouched_counts_as_dead(tmp_path, monkeypatch):
    import fcntl

    def no_locks(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    for name, age in {"young": 60, "old": 2 * staging.STALE_S}.items():
        left = tmp_path / f".{name}.0.tmp"
        left.mkdir()
        os.utime(left, (time.time() - age,) * 2)
        text(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".young.0.tmp", "old", "young"]


@pytest.mark.parametrize("below", ["there.ply", "folder", ""])
def test_a_detour_through_a_folder_that_is_missing_does_not_hide_what_is_there(tmp_path, below):
    """The system does not find `missing/../there`, but that is where a file is written to."""
    (tmp_path / "there.ply").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("mine")
    target = tmp_path / "missing" / ".." / below
    with pytest.raises(OutputExists, match="exists already"):
        refuse_output(target, overwrite=False)
    with pytest.raises(OutputExists, match=r"holds the base|is the base|other things|is a file"):
        refuse_output(target, overwrite=True, base=[tmp_path / "there.ply"], is_file=False)
        refuse_to_lose(target, None, "point_cloud", ["point_cloud/*"])
