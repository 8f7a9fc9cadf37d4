"""The state that a run keeps to go on from: one for each run, of this base and these settings, and its failure fails no run."""

import itertools
import os
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization import resume
from mipmap_plugin.adaptation.optimization.state_file import claim_state_file
from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.wrap import wrap_model


@pytest.fixture
def model(monkeypatch):
    """Of which a run keeps its state after each step."""
    monkeypatch.setattr(resume, "SAVE_EVERY_S", 0.0)
    return wrap_model(tiny.model(10), cameras=tiny.cameras(2))


@pytest.fixture
def state(tmp_path):
    """Where it is kept."""
    return tmp_path / "state"


# States of runs at the same time


def test_runs_with_one_output_keep_their_states_in_files_of_their_own(tmp_path, model, state):
    first = model.adapt(1 / 4, steps=1, resume=state)
    second = model.adapt(1 / 4, steps=2, resume=state)
    assert torch.load(state, weights_only=True)["step"] == 1 and torch.load(tmp_path / "state.2", weights_only=True)["step"] == 2
    first.save(tmp_path / "one.ply")
    assert not state.exists() and (tmp_path / "state.2").exists()
    second.save(tmp_path / "two.ply")
    assert not [path for path in tmp_path.iterdir() if "state" in path.name]


def test_a_run_that_is_saved_again_leaves_the_state_of_the_next_run(tmp_path, model, state):
    first = model.adapt(1 / 4, steps=1, resume=state)
    first.save(tmp_path / "one.ply")
    second = model.adapt(1 / 4, steps=2, resume=state)
    first.save(tmp_path / "copy.ply")
    assert {path.name for path in tmp_path.iterdir() if "state" in path.name} == {"state", ".state.lock"}
    second.save(tmp_path / "two.ply")
    assert not state.exists()


def test_each_interrupted_run_goes_on_from_its_own_state(model, state):
    living = [model.adapt(1 / 4, steps=steps, resume=state) for steps in (1, 2)]
    curves = [each.report.curve for each in living]
    del living  # neither was saved
    assert model.adapt(1 / 4, steps=2, resume=state).report.curve == curves[1]
    with pytest.raises(SettingsError, match="state: this state belongs to another base, settings or views"):
        model.adapt(1 / 4, steps=3, resume=state)


def test_a_state_is_nobodys_pipe_or_folder(tmp_path, model):
    os.mkfifo(tmp_path / "pipe")
    for name, told in {"pipe": "is a pipe", ".": "is a folder"}.items():
        with pytest.raises(OutputExists, match=told):
            model.adapt(1 / 4, steps=1, resume=tmp_path / name)


def test_a_state_that_cannot_be_kept_costs_a_warning(model, state, monkeypatch):
    monkeypatch.setattr(resume, "claim_state_file", Mock(side_effect=OSError(30, "Read-only file system")))
    with pytest.warns(UserWarning, match=r"state cannot be written \(Read-only file system\), so that this run could not be resumed"):
        assert model.adapt(1 / 4, steps=1, resume=state).report.ended_by == "1 step"


def test_states_beyond_the_last_are_refused(state):
    living = [claim_state_file(state, lambda _: "belongs to another") for _ in range(staging.SLOTS)]
    assert len({each.path for each in living}) == staging.SLOTS
    with pytest.raises(SettingsError, match="state"):
        claim_state_file(state, lambda _: "belongs to another")


def test_ctrl_c_while_a_state_is_let_go_of_leaves_nothing_to_do_again(state, monkeypatch):
    """Its lock was closed a second time, as the object went, which was printed with a traceback."""

    def broken_off(folder, lock):
        os.close(lock)
        raise KeyboardInterrupt

    file = claim_state_file(state, lambda _: "")
    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.state_file.release", broken_off)
    with pytest.raises(KeyboardInterrupt):
        file.release()
    file.release()


# A state of another version


@pytest.mark.parametrize("versions", [None, {"mipmap_plugin": "0.0.1", "torch": "1.0"}], ids=["before versions were kept", "another"])
@pytest.mark.parametrize("spoilt", ["fingerprint", "planned"], ids=["other settings", "other contents"])
def test_a_state_of_another_version_is_named_and_stays(model, state, versions, spoilt):
    model.adapt(1 / 4, steps=1, resume=state)  # not saved
    content = load_torch(state) | {"versions": versions, spoilt: None}
    torch.save({name: value for name, value in content.items() if value is not None}, state)
    who = "an older version" if versions is None else "mipmap_plugin 0.0.1 and torch 1.0"
    with pytest.raises(SettingsError, match=f"state: this state was left by {who}, and this is .*; go on with that version, or delete it"):
        model.adapt(1 / 4, steps=1, resume=state)
    assert state.exists()


# A damaged state


@pytest.mark.parametrize("content", [5, {}, {"fingerprint": None}, [torch.ones(2)]], ids=str)
def test_a_state_that_is_none_is_refused(model, state, content):
    torch.save(content, state)
    with pytest.raises(SettingsError, match="state: this state belongs to another base, settings or views"):
        model.adapt(1 / 4, steps=1, resume=state)


def test_a_state_that_takes_long_to_save_is_saved_less_often(state, monkeypatch):
    clock, saves = [0.0], []

    def save(*_: object) -> None:
        saves.append(clock[0])
        clock[0] += 4 * resume.QUICK_SAVE_S

    monkeypatch.setattr(resume, "save_run", save)
    monkeypatch.setattr(resume, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    keeper = resume.StateKeeper(state, "")
    keeper.file = SimpleNamespace(path=state)
    while clock[0] < 1000:
        keeper.save_if_due(None)
        clock[0] += 1
    assert saves[0] == resume.SAVE_EVERY_S
    assert all(later - earlier >= 4 * resume.SAVE_EVERY_S for earlier, later in itertools.pairwise(saves))
    assert len(saves) == 4
