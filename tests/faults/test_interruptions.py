"""A full disk, Ctrl-C and kill -9, in the middle of adapting and of saving: what was there stays, and no half file has a final name."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import tiny
import torch
from writers import WRITERS, adapted, base_and_output, contents

from mipmap_plugin.adaptation.optimization import resume
from mipmap_plugin.cli import main
from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats import staging
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model


@contextmanager
def disk_that_holds(size: int):
    """No file may grow beyond `size` bytes; what is written behind that fails, in Python and in C++."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# A full disk


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_output_and_nothing_else(tmp_path, name):
    base, out = base_and_output(tmp_path, name)
    new = adapted(base, 1 / 4)
    whole = adapted(base, 1 / 2).save(out).stat().st_size
    before = contents(out.parent)
    for size in (0, 1, 100, whole // 2, whole - 1):
        with disk_that_holds(size), pytest.raises(OutputError, match="cannot be written"):
            new.save(out, overwrite=True)
        assert contents(out.parent) == before
    assert load_model(out)
    new.save(out, overwrite=True)
    assert contents(out.parent) != before


@pytest.mark.parametrize("words", [
    ["render"], ["tradeoff", "--scale", "1/4", "--recipe", "instant", "--no-picture"],
    ["adapt", "--scale", "1/4", "--tiles", "2"],
])  # fmt: skip
def test_a_full_disk_leaves_no_empty_folders(tmp_path, capsys, words):
    command, *options = words
    base = tiny.folder(tmp_path / "base", tiny.cameras(1, width=8, height=6), count=10)
    with disk_that_holds(10):
        assert main([command, str(base), "--output", str(tmp_path / "new" / "out"), *options]) == 2
    assert "cannot be written" in capsys.readouterr().err and not (tmp_path / "new").exists()


def test_a_run_that_is_not_kept_leaves_no_empty_folders(tmp_path):
    model = wrap_model(tiny.model(10), cameras=tiny.cameras(2))
    model.adapt(1 / 4, steps=1, resume=tmp_path / "new" / "out" / "state")
    assert not (tmp_path / "new").exists()


def test_a_full_disk_while_a_run_is_kept_does_not_end_it(tmp_path, monkeypatch):
    monkeypatch.setattr(resume, "SAVE_EVERY_S", 0.0)
    model = wrap_model(tiny.model(10), cameras=tiny.cameras(2))
    goes_on = pytest.warns(UserWarning, match="the run continues, but could not be resumed if it were killed: .* cannot be written")
    with disk_that_holds(100), goes_on:
        done = model.adapt(1 / 4, steps=2, resume=tmp_path / "state")
    assert done.report.ended_by == "2 steps" and list(tmp_path.iterdir()) == []


def test_a_full_disk_when_the_finished_model_is_saved_leaves_its_state(tmp_path, monkeypatch):
    monkeypatch.setattr(resume, "SAVE_EVERY_S", 0.0)
    model, state = wrap_model(tiny.model(10), cameras=tiny.cameras(2)), tmp_path / "state"
    done = model.adapt(1 / 4, steps=3, resume=state)
    with disk_that_holds(100), pytest.raises(OutputError):
        done.save(tmp_path / "new.ply")
    assert state.exists()
    again = model.adapt(1 / 4, steps=3, resume=state)
    assert [(point.step, point.psnr_db) for point in again.report.curve] == [(point.step, point.psnr_db) for point in done.report.curve]
    assert again.save(tmp_path / "new.ply").read_bytes() == done.save(tmp_path / "other.ply").read_bytes()
    assert not state.exists()


# Ctrl-C


@pytest.mark.parametrize(("name", "where"), [*((name, "write") for name in WRITERS), ("ply", "move"), ("cfg_args", "move")])
def test_ctrl_c_while_saving_leaves_the_old_output_and_nothing_else(tmp_path, monkeypatch, name, where):
    base, out = base_and_output(tmp_path, name)
    new = adapted(base, 1 / 4)
    adapted(base, 1 / 2).save(out)
    before = contents(out.parent)

    pressed = lambda *_, **__: signal.raise_signal(signal.SIGINT)  # noqa: E731
    if where == "write":
        monkeypatch.setattr(os, "fsync", pressed)
        monkeypatch.setattr(torch, "save", pressed)
    else:
        monkeypatch.setattr(staging.Staging, "commit", pressed)
    with pytest.raises(KeyboardInterrupt):
        new.save(out, overwrite=True)
    monkeypatch.undo()
    assert contents(out.parent) == before


# kill -9


RUN = """
import os, signal, sys
sys.path.insert(0, {tests!r})
import tiny, torch
from mipmap_plugin.adaptation.optimization import resume
from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.wrap import wrap_model
torch.set_num_threads(1)
resume.SAVE_EVERY_S = 0.0
move, moved = ByRows.step, []
def counted(self, *arguments):
    moved.append(1)
    if len(moved) == {step}:
        os.kill(os.getpid(), signal.SIGKILL)
    move(self, *arguments)
ByRows.step = counted
model = wrap_model(tiny.model(20), cameras=tiny.cameras(3))
model.adapt(1 / 4, steps=6, extra_views=2, views_per_step=2, warm_up=0, resume={state!r})
"""


def test_a_killed_run_goes_on_from_its_last_state_to_the_same_bytes(tmp_path):
    """It is killed in the middle of the fourth step, with its views drawn and nothing moved."""
    state = tmp_path / "state"
    code = RUN.format(tests=str(Path(tiny.__file__).parent), step=4, state=str(state))
    killed = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    model = wrap_model(tiny.model(20), cameras=tiny.cameras(3))
    assert torch.load(state, weights_only=True)["step"] == 3
    resumed, whole = (model.adapt(1 / 4, steps=6, extra_views=2, views_per_step=2, warm_up=0, resume=path) for path in (state, None))
    saved = [each.save(tmp_path / f"{i}.ply").read_bytes() for i, each in enumerate((resumed, whole))]
    assert saved[0] == saved[1] and not state.exists()
