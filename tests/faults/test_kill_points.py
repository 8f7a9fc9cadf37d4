"""Killed in any state of the disk: the old or the new output is there, whole, and the next run leaves nothing else."""

import hashlib
import os
import shutil
import signal
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import tiny
from corpus import SAMPLES
from kill_points import killed, some_of_the_calls
from writers import WRITERS, adapted, base_and_output, contents

from mipmap_plugin.adaptation.optimization import resume
from mipmap_plugin.formats import staging
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model

pytestmark = [pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork"), pytest.mark.usefixtures("few_views")]

LONE = [name for name in WRITERS if SAMPLES[name].damaged.endswith((".ply", "opacity_mlp.pt"))]
FOLDERS = [name for name in WRITERS if name not in LONE]


def some(names: list[str], by_default: list[str]) -> list[Any]:
    """A few families at a few points by default, and all of them at every point."""
    return [*by_default, *(pytest.param(name, marks=pytest.mark.slow, id=f"{name}, every point") for name in names)]


def visible(folder: Path) -> dict[str, str]:
    return {name: digest for name, digest in contents(folder).items() if not name.startswith(".")}


class Replacing:
    """A saved output that another model replaces, as often as one likes."""

    def __init__(self, folder: Path, name: str) -> None:
        base, self.out = base_and_output(folder, name)
        self.models = [adapted(base, scale) for scale in (1 / 2, 1 / 4)]
        self.models[1].save(self.out)
        self.new = contents(self.out.parent)
        shutil.rmtree(self.out.parent)
        self.models[0].save(self.out)
        self.old = contents(self.out.parent)
        assert self.old != self.new
        self._kept = shutil.copytree(self.out.parent, folder / "kept")

    def __call__(self) -> None:
        self.models[1].save(self.out, overwrite=True)

    def again(self) -> None:
        shutil.rmtree(self.out.parent)
        shutil.copytree(self._kept, self.out.parent)

    def check(self, at_once: bool = True) -> None:
        """Whole at once where it is one folder, and else when it is loaded; after the next run nothing else is there."""
        if at_once and self.out.is_dir():
            assert visible(self.out.parent) in (self.old, self.new)
        assert load_model(self.out)
        assert visible(self.out.parent) in (self.old, self.new)
        self()
        assert contents(self.out.parent) == self.new
        assert not [path for path in self.out.parent.rglob("*") if path.name.startswith(".")]


@pytest.mark.parametrize("name", some(WRITERS, ["ply", "cfg_args"]))
@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGINT])
def test_saving_broken_off_leaves_the_old_or_the_new_output(tmp_path, name, by, request):
    replacing = Replacing(tmp_path, name)
    for number in count(1) if by == signal.SIGKILL else some_of_the_calls(request):
        replacing.again()
        if not killed(number, replacing, replacing.out.parent, by):
            break
        replacing.check()
    assert number > 10


def test_a_file_by_itself_is_replaced_in_one_step(tmp_path):
    """One with a report takes two."""
    out, models = tmp_path / "new.ply", [tiny.model(count) for count in (20, 30)]
    for number in count(1):
        models[0].save(out, provenance={}, overwrite=True)
        if not killed(number, lambda: models[1].save(out, provenance={}, overwrite=True), tmp_path):
            break
        assert len(load_model(out)) in (20, 30)
    assert number > 5


@pytest.mark.parametrize("name", some(FOLDERS, ["cfg_args"]))
def test_where_folders_cannot_be_exchanged_the_next_run_finishes_the_move(tmp_path, name, monkeypatch):
    monkeypatch.setattr(staging, "exchange", lambda one, other: False)
    replacing = Replacing(tmp_path, name)
    for number in count(1):
        replacing.again()
        if not killed(number, replacing, replacing.out.parent):
            break
        replacing.check(at_once=False)
    assert number > 20


def made(out: Path) -> dict[str, str]:
    """The bytes of an output, but for the report, which tells seconds, and networks, whose TorchScript counts what the process has traced.

    Of these the weights.
    """
    found = {name: digest for name, digest in contents(out.parent).items() if not name.endswith((".adaptation.json", "_mlp.pt", "appearance.pt"))}
    weights = load_model(out).shared_parameters()
    return found | {name: hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest() for name, tensor in weights.items()}


class Adapting:
    """A whole run, its state kept at every step, that saves to one output."""

    def __init__(self, folder: Path, name: str) -> None:
        self.base, self.out = base_and_output(folder, name)
        self.state = self.out.with_name(self.out.name + ".resume")

    def __call__(self) -> None:
        model = wrap_model(self.base, cameras=tiny.cameras(2, width=8, height=6))
        model.adapt(1 / 2, steps=2, extra_views=0, views_per_step=1, resume=self.state).save(self.out, overwrite=True)


@pytest.mark.parametrize("name", some(WRITERS, ["ply"]))
def test_a_run_killed_at_any_point_is_finished_by_the_same_command(tmp_path, monkeypatch, name, request):
    monkeypatch.setattr(resume, "SAVE_EVERY_S", 0.0)
    adapting = Adapting(tmp_path, name)
    adapting()
    whole = made(adapting.out)
    for number in some_of_the_calls(request):
        shutil.rmtree(adapting.out.parent, ignore_errors=True)
        if not killed(number, adapting, adapting.out.parent):
            break
        adapting()
        assert made(adapting.out) == whole
        assert not [path for path in adapting.out.parent.rglob("*") if path.name.startswith(".")]
    assert number > 20
