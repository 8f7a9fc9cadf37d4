"""What an interrupted, killed or failed ladder leaves, and which levels a later one goes on with."""

import os
import shutil
from dataclasses import replace
from unittest.mock import Mock

import pytest
import tiny
import torch
from brief_levels import request, wrapped

from mipmap_plugin import cli, wrap_model
from mipmap_plugin.adaptation.optimization.run import Run
from mipmap_plugin.commands.ladders import Exports
from mipmap_plugin.errors import OutputError, SceneError, SettingsError
from mipmap_plugin.evaluation.tradeoff.measuring import on_backend
from mipmap_plugin.formats import staging
from mipmap_plugin.levels.ladder import make_levels
from mipmap_plugin.levels.request import FINEST_RATIO
from mipmap_plugin.levels.store import is_of
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Interrupted, Wrapped

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")


def refused(base, asked, state):
    """These levels are not gone on with."""
    with pytest.raises(SettingsError, match="holds levels of another base, viewer or settings"):
        make_levels(base, asked, resume=state)


@pytest.mark.parametrize("change", [{"split": "test"}, {"time": 0.5}, {"width": 33}])
def test_levels_of_other_cameras_are_not_gone_on_with(tmp_path, change):
    base = wrapped()
    make_levels(base, request(coarsest=0.9), tmp_path / "state")
    base.cameras[-1] = replace(base.cameras[-1], **change)
    refused(base, request(coarsest=0.9), tmp_path / "state")


def test_levels_of_another_vertical_are_not_gone_on_with(tmp_path):
    base, other = (wrap_model(tiny.model(), up=up) for up in ("z", None))
    asked = request(coarsest=0.9, steps=0, extra_views=2)
    make_levels(base, asked, tmp_path / "state")
    refused(other, asked, tmp_path / "state")


def test_levels_of_another_model_are_not_gone_on_with(tmp_path):
    """One whose parameters have the same sums."""
    first, other = wrapped(), wrapped()
    with torch.no_grad():
        other.model.parameters()["means"].copy_(first.model.parameters()["means"].flip(0))
    make_levels(first, request(coarsest=0.9), tmp_path / "state")
    refused(other, request(coarsest=0.9), tmp_path / "state")


def test_levels_of_a_bound_are_made_again_for_narrower_bands():
    """No level of so few steps is this good, so that every band ends up at the finest ratio."""
    ladder = make_levels(wrapped(), request(coarsest=0.6, ratio=2.0, least_db=99.0))
    assert [level.band.scale for level in ladder.levels] == pytest.approx([1, (2 * FINEST_RATIO) ** -0.5])
    assert [level.band.scale for level in make_levels(wrapped(), request(coarsest=0.6, ratio=2.0)).levels] == pytest.approx([1, 0.6])


def test_an_interrupted_ladder_goes_on_with_what_is_ready(tmp_path, monkeypatch):
    whole = make_levels(wrapped(), request(coarsest=1 / 2), resume=tmp_path / "a").save(tmp_path / "whole")
    base = wrapped()
    adapt, scales = base.adapt, []

    def interrupted(scale, **options):
        scales.append(scale)
        if len(scales) == 2:
            raise Interrupted("Ctrl-C")
        return adapt(scale, **options)

    monkeypatch.setattr(base, "adapt", interrupted)
    with pytest.raises(Interrupted):
        make_levels(base, request(coarsest=1 / 2), resume=tmp_path / "b")
    again = make_levels(base, request(coarsest=1 / 2), resume=tmp_path / "b").save(tmp_path / "again")
    assert scales == pytest.approx([1, 1 / 2, 1 / 2])
    assert not (tmp_path / "a").exists() and not (tmp_path / "b").exists()
    for file in whole.glob("*.ply"):
        assert file.read_bytes() == (again / file.name).read_bytes()


def test_an_interrupted_command_says_that_finished_levels_are_kept(tmp_path, monkeypatch, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12), count=12)
    words = ["levels", str(base), "--viewer", "antialiased", "--output", str(tmp_path / "ladder"), "--coarsest", "1/2", "--recipe", "instant"]
    words += ["--views", "given"]
    with monkeypatch.context() as first:
        first.setattr("mipmap_plugin.levels.ladder._curve", Mock(side_effect=KeyboardInterrupt))
        assert cli.main(words) == 130
        assert f"go on with the levels that {tmp_path / 'ladder.resume'} keeps" in capsys.readouterr().err
    monkeypatch.setattr("mipmap_plugin.wrap.Wrapped.adapt", None)
    assert cli.main(words) == 0


def interrupt():
    raise Interrupted("Ctrl-C")


@pytest.mark.parametrize("by", ["zoom", "distance"])
def test_a_ladder_that_failed_before_its_first_level_leaves_nothing(tmp_path, monkeypatch, by):
    base = wrapped()
    monkeypatch.setattr(base, "adapt", Mock(side_effect=Interrupted("Ctrl-C")))
    with pytest.raises(Interrupted):
        make_levels(base, request(by=by), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_first_level_that_is_broken_off_before_its_state_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "start", Mock(side_effect=Interrupted("Ctrl-C")))
    with pytest.raises(Interrupted):
        make_levels(wrapped(), request(), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_first_level_whose_state_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.optimization.resume.save_run", Mock(side_effect=OutputError("no space")))
    monkeypatch.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, task, config, on_interrupt, observe: on_interrupt(run))
    with pytest.raises(OutputError, match="no space"):
        make_levels(wrapped(), request(), resume=tmp_path / "new" / "state")
    assert not (tmp_path / "new").exists()


def test_a_ladder_that_is_killed_before_its_first_level_leaves_its_state_at_most(tmp_path, monkeypatch):
    base, state = wrapped(), tmp_path / "new" / "state"
    adapt, found = base.adapt, []

    def watched(scale, **options):
        return adapt(scale, observe=lambda *_: found.append({each.name for each in state.iterdir()}), **options)

    monkeypatch.setattr(base, "adapt", watched)
    make_levels(base, request(coarsest=1.0, steps=2), resume=state)
    assert len(found) == 3 and set().union(*found) == {".level_0.ply.resume.lock"}


def test_what_a_ladder_that_was_killed_leaves_is_in_nobodys_way(tmp_path):
    for left in ("level_0.ply.resume.lock", "request.json.0.tmp"):  # of a process that has ended
        (tmp_path / f".{left}" / "new").mkdir(parents=True)
    ladder = make_levels(wrapped(), request(coarsest=1.0), resume=tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {"request.json", "level_0.ply", "level_0.ply.adaptation.json"} and ladder.levels


def test_levels_that_a_killed_ladder_was_deleting_are_in_nobodys_way(tmp_path, monkeypatch):
    """They had no request any more, and were taken for other things."""
    state, close = tmp_path / "state", staging.Staging.close
    ladder = make_levels(wrapped(), request(coarsest=1.0), resume=state)
    with monkeypatch.context() as patched:
        patched.setattr(staging.Staging, "close", lambda self: os.close(self._lock) if self.path.name == "ladder" else close(self))
        ladder.save(tmp_path / "ladder")
    assert not state.exists() and (tmp_path / ".ladder.0.tmp").exists()
    assert make_levels(wrapped(), request(coarsest=1.0), resume=state).save(tmp_path / "ladder", overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"ladder"}


def test_a_ladder_whose_first_level_has_a_state_keeps_it(tmp_path, monkeypatch):
    base, state = wrapped(), tmp_path / "state"
    monkeypatch.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, task, config, on_interrupt, observe: on_interrupt(run))
    with pytest.raises(Interrupted):
        make_levels(base, request(steps=1), resume=state)
    monkeypatch.undo()
    assert [each.name for each in state.iterdir()] == ["level_0.ply.resume"]
    assert make_levels(base, request(steps=1, coarsest=1.0), resume=state).levels  # its first level is the same


def test_an_interruption_is_told_also_where_somebody_has_deleted_the_folder(tmp_path, monkeypatch):
    base = wrapped()

    def interrupted(scale, resume, **_):
        shutil.rmtree(resume.parent, ignore_errors=True)
        interrupt()

    monkeypatch.setattr(base, "adapt", interrupted)
    with pytest.raises(Interrupted, match="Ctrl-C"):
        make_levels(base, request(), resume=tmp_path / "state")


def test_levels_that_another_run_kept_meanwhile_are_not_mixed_with_these(tmp_path, monkeypatch):
    base = wrapped()
    adapt = base.adapt

    def overtaken(scale, **options):
        make_levels(wrapped(), request(coarsest=0.6), resume=tmp_path / "state")
        return adapt(scale, **options)

    monkeypatch.setattr(base, "adapt", overtaken)
    refused(base, request(), tmp_path / "state")


def test_a_damaged_unfinished_ladder_is_told(tmp_path):
    (tmp_path / "request.json").write_text("{")
    (tmp_path / "level_0.ply").touch()
    with pytest.raises(SceneError, match=r"request\.json: is not JSON"):
        make_levels(wrapped(), request(), resume=tmp_path)


def test_a_level_of_a_kept_ladder_has_views(tmp_path):
    level = make_levels(wrapped(), request(coarsest=1.0), resume=tmp_path / "state").levels[0].adapted
    assert [view.size for view in level.views()] == [view.size for view in wrapped().views()] and "<img" in level._repr_html_()


def test_levels_of_another_ladder_are_not_taken(tmp_path, monkeypatch):
    base = wrapped()
    adapt = base.adapt
    monkeypatch.setattr(base, "adapt", lambda scale, **options: adapt(scale, **options) if scale == 1 else interrupt())
    with pytest.raises(Interrupted):
        make_levels(base, request(), resume=tmp_path / "state")
    refused(wrapped(), request(coarsest=1 / 8), tmp_path / "state")
    refused(on_backend(wrapped(), "reference"), request(), tmp_path / "state")


def test_a_folder_with_other_things_is_not_taken_for_levels(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SettingsError, match="it has other things in it"):
        make_levels(wrapped(), request(), resume=tmp_path)


@pytest.mark.parametrize("by", ["zoom", "distance"])
def test_what_is_no_path_to_go_on_from_is_named(by):
    with pytest.raises(SettingsError, match=r"^resume must be a text .*, got int$"):
        make_levels(wrapped(), request(by=by), resume=5)


def test_an_export_that_failed_is_made_by_the_same_command(tmp_path, monkeypatch, capsys):
    """The levels, which took longer, are in their place already."""
    words = ["levels", str(tiny.folder(tmp_path / "base", tiny.cameras(2))), "--viewer", "antialiased", "--coarsest", "1", "--by", "zoom", "--recipe"]
    words += ["instant", "--output", str(tmp_path / "ladder")]
    with monkeypatch.context() as failing:
        failing.setattr(Exports, "write", Mock(side_effect=OutputError("the disk is full")))
        assert cli.main(words) == 2
    assert "ladder has the levels, and the same command goes on from these" in capsys.readouterr().err
    (tmp_path / "ladder" / ".report.html.0.tmp" / "new").mkdir(parents=True)
    (tmp_path / "ladder" / ".report.html.0.tmp" / "new" / "report.html").touch()  # of a run that was killed as it wrote its page
    assert cli.main([*words, "--seed", "1"]) == 2  # another ladder does not replace it
    assert "holds levels of another base, viewer or settings" in capsys.readouterr().err
    assert cli.main(words) == 0 and {path.name for path in tmp_path.iterdir()} == {"base", "ladder"}
    assert cli.main(words) == 2 and "ladder exists already" in capsys.readouterr().err


def test_a_ladder_that_was_changed_since_is_not_replaced(tmp_path):
    ladder = make_levels(wrapped(), request(coarsest=0.9), tmp_path / "state").save(tmp_path / "ladder", keep_resume=True)
    assert is_of(tmp_path / "state", ladder)
    (ladder / "levels.json").write_text("{}")
    assert not is_of(tmp_path / "state", ladder)


@pytest.mark.filterwarnings("ignore:no cameras", "ignore:the scene is", "ignore:in ")
def test_viewers_draw_the_kept_levels_of_a_small_scene_as_they_draw_its_base(tmp_path):
    """With the near plane of their own they would draw nothing."""
    splats = tiny.gaussians(12, degree=0)
    base = wrap_model(VanillaModel.from_gaussians(replace(splats, means=0.01 * splats.means, scales=0.01 * splats.scales)))
    [made] = make_levels(base, request("classic", coarsest=1.0), resume=tmp_path / "state").levels
    level = Wrapped(made.adapted.model, base.cameras, "auto", base.trained)
    assert level.effects(viewer="classic").near_plane == base.effects(viewer="classic").near_plane < 0.01
