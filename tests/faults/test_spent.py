"""What an output was made from is removed with its appearance: killed before any call, a command leaves the one or the other, and can be repeated."""

import errno
import os
import shutil
from itertools import count, product
from unittest.mock import Mock

import pytest
from kill_points import killed

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.atomic import new_file, new_folder, settled, together

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


def write(out, text, files):
    """An output of one file, of two, or of a folder, from its state and a folder of unfinished work beside it."""
    with together(out, [out.with_name("out.resume"), out.with_name("out.tiles")]):
        if files == 0:
            with new_folder(out, overwrite=True) as folder:
                (folder / "part").write_text(text)
        for name in ("out", "out.json")[:files]:
            with new_file(out.with_name(name), overwrite=True) as temporary:
                temporary.write_text(text)


def begin(folder, files, replaced):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if replaced:
        write(folder / "out", "old", files)
    (folder / "out.resume").write_text("state")
    (folder / "out.tiles").mkdir()
    for name in "abc":
        (folder / "out.tiles" / name).write_text(name)


def text_of(out):
    place = out / "part" if out.is_dir() else out
    return place.read_text() if place.exists() else None


CASES = [pytest.param(0, True, True, id="folder"), pytest.param(2, True, True, id="two files")]
SLOW = [pytest.param(*case, marks=pytest.mark.slow) for case in product((0, 1, 2), (False, True), (False, True))]


@pytest.mark.parametrize(("files", "replaced", "exchanges"), CASES + SLOW)
def test_what_is_spent_is_there_until_the_output_is_and_not_after(tmp_path, monkeypatch, files, replaced, exchanges):
    if not exchanges:
        monkeypatch.setattr(staging, "exchange", lambda one, other: False)
    out = tmp_path / "place" / "out"
    kept, seen = {"out.resume", "out.tiles"}, set()
    for number in count(1):
        begin(out.parent, files, replaced)
        if not killed(number, lambda: write(out, "new", files), out.parent):
            break
        text = text_of(settled(out))
        left = {path.name for path in out.parent.iterdir()} & kept
        assert (text, left) in [("old" if replaced else None, kept), ("new", set())]
        assert len(list((out.parent / "out.tiles").glob("*"))) in (0, 3)  # whole, or gone
        assert not [path.name for path in out.parent.iterdir() if path.name.startswith(".")]
        seen.add(text)
    assert len(seen) == 2 and text_of(out) == "new" and not {path.name for path in out.parent.iterdir()} & kept


def test_moves_that_fail_are_finished_before_the_same_process_writes_anew(tmp_path, monkeypatch):
    out = tmp_path / "place" / "out"
    with monkeypatch.context() as dead:
        dead.setattr(staging, "_move_in", lambda folder: None)
        dead.setattr(staging.Staging, "close", lambda self: os.close(self._lock))
        write(out, "of the killed run", 2)
    with monkeypatch.context() as held, pytest.raises(OutputError, match="cannot be written"):
        held.setattr(os, "replace", Mock(side_effect=PermissionError(errno.EACCES, "another program has it open")))
        write(out, "new", 2)
    write(out, "newest", 2)
    assert text_of(settled(out)) == "newest" and {path.name for path in out.parent.iterdir()} == {"out", "out.json"}


def test_the_moves_of_a_killed_run_are_on_the_disk_before_what_is_spent_goes(tmp_path, monkeypatch):
    begin(tmp_path / "place", 2, replaced=False)
    out, flushed, before = tmp_path / "place" / "out", [], []
    with monkeypatch.context() as dead:
        for name in ("_move_in", "_remove"):
            dead.setattr(staging, name, lambda *_: None)
        dead.setattr(staging.Staging, "close", lambda self: os.close(self._lock))
        write(out, "new", 2)
    monkeypatch.setattr(staging, "_flush", flushed.append)
    monkeypatch.setattr(staging, "_remove", lambda path, _: before.append((path.name, *flushed)))
    assert text_of(settled(out)) == "new" and sorted(before) == [("out.resume", out.parent), ("out.tiles", out.parent)]


def test_what_another_run_has_put_there_since_is_not_taken_for_spent(tmp_path, monkeypatch):
    begin(tmp_path / "place", 1, replaced=False)
    out, state = tmp_path / "place" / "out", tmp_path / "place" / "out.resume"
    with monkeypatch.context() as dead:
        dead.setattr(staging, "_remove", lambda *_: None)
        dead.setattr(staging.Staging, "close", lambda self: os.close(self._lock))
        write(out, "new", 1)
    new = state.with_name("other")  # a file of its own, so that its inode is another
    new.write_text("of another run")
    new.rename(state)
    assert text_of(settled(out)) == "new" and state.read_text() == "of another run"


def test_what_would_be_spent_stays_where_the_output_around_it_fails(tmp_path):
    begin(tmp_path / "place", 1, replaced=False)
    out = tmp_path / "place" / "out"
    with pytest.raises(OutputError, match="no page"), together(out):
        write(out, "new", 1)
        raise OutputError("no page")
    assert {path.name for path in out.parent.iterdir()} == {"out.resume", "out.tiles"}


def test_a_folder_around_the_output_is_not_spent(tmp_path):
    out = tmp_path / "state" / "out"
    with together(out, [tmp_path / "state"]), new_file(out, overwrite=False) as temporary:
        temporary.write_text("new")
    assert text_of(out) == "new"
