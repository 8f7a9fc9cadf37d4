"""A run in tiles that is broken off goes on to the same bytes, and what another request left is not touched."""

import os
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import pytest
import tiny
import torch
from cut_scenes import base_pictures

from mipmap_plugin.adaptation.optimization.loop import adapt as real_adapt
from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.errors import JobsFailed, OutputError, OutputExists, SceneError, SettingsError
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.jobs.engines import in_this_process
from mipmap_plugin.models.places import PLAN
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.tiles import plan, run, steering, tile
from mipmap_plugin.tiles.folder import truth_file, work_folder
from mipmap_plugin.tiles.report import Judgment
from mipmap_plugin.tiles.run import adapt_all_in_tiles, adapt_in_tiles
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep


def columns_of(file):
    return {name: column.tobytes() for name, column in read_ply(file).columns.items()}


def test_the_result_does_not_depend_on_what_was_done_before(job, monkeypatch):
    """A run that fails in its second tile goes on there, and leaves the same bytes as one that is not disturbed."""
    undisturbed = adapt_in_tiles(replace(job, target=job.target.with_name("other.ply")), 3).file
    begun = []

    def fail_once(run, *rest):
        begun.append(run)
        if len(begun) == 2:
            raise OSError("no space left")
        return real_adapt(run, *rest)

    monkeypatch.setattr(tile, "adapt", fail_once)
    with pytest.raises(JobsFailed, match=r"1 of 3 jobs \(tile\) failed: no space left; check that path, .*; the same command does these again"):
        adapt_in_tiles(job, 3)
    outcomes = []

    def engine(jobs):
        for outcome in in_this_process(jobs):
            outcomes.append(outcome)
            yield outcome

    joined = adapt_in_tiles(job, 3, engine)
    tiles = [outcome.status for outcome in outcomes if outcome.job.work == "tile" and outcome.job.sweep == 0]
    assert tiles == ["finished before", "done", "finished before"]
    before = [outcome.status for outcome in outcomes if outcome.job.work not in ("tile", "steering") and outcome.job.sweep == 0]
    assert set(before) == {"finished before"}
    assert columns_of(joined.file) == columns_of(undisturbed)


def test_an_interrupted_tile_is_resumed(job, monkeypatch):
    def interrupt_early(run, task, config, on_interrupt, observe):
        return real_adapt(run, task, config, on_interrupt, lambda run: on_interrupt(run) if run.step == 2 else observe(run))

    with monkeypatch.context() as patched:
        patched.setattr(tile, "adapt", interrupt_early)
        with pytest.raises(KeyboardInterrupt, match="run the same command again"):
            adapt_in_tiles(job, 2)
    first_steps = []
    monkeypatch.setattr(tile, "adapt", lambda run, *rest: (first_steps.append(run.step), real_adapt(run, *rest))[1])
    assert adapt_in_tiles(job, 2).file.exists() and first_steps == [2, 1]


@pytest.mark.parametrize(
    ("plan", "error", "told"),
    [("{}", SettingsError, "holds tiles of another base, settings or number of tiles"), ("", SceneError, r"plan\.json: is not JSON")],
    ids=["of another request", "damaged"],
)
def test_tiles_of_another_plan_are_not_touched(job, plan, error, told):
    work_folder(job.target).mkdir()
    (work_folder(job.target) / "plan.json").write_text(plan)
    with pytest.raises(error, match=told):
        adapt_in_tiles(job, 2)
    assert (work_folder(job.target) / "plan.json").read_text() == plan


def test_tiles_of_a_version_that_cut_across_sizes_are_refused(job):
    """They ended in an error wherever a plane lay across an axis that is none."""
    work_folder(job.target).mkdir()
    plan.claim([job], 3)
    file = work_folder(job.target) / PLAN
    file.write_text(file.read_text().replace(f'"format": {plan.FORMAT}', '"format": 5'))
    with pytest.raises(SettingsError, match="or of another version; repeat those, or delete it to start anew"):
        adapt_in_tiles(job, 3)


def test_tiles_are_not_gone_on_with_for_other_cameras(job, monkeypatch):
    """Whose path is the same."""
    with monkeypatch.context() as patched, pytest.raises(JobsFailed):
        patched.setattr(tile, "adapt", Mock(side_effect=OSError("no space left")))
        adapt_in_tiles(job, 2)
    (job.base.checkpoint / "cameras.json").unlink()
    write_cameras(job.base.checkpoint / "cameras.json", tiny.cameras(3, seed=5, width=20, height=16))
    with pytest.raises(SettingsError, match="holds tiles of another base, settings or number of tiles"):
        adapt_in_tiles(job, 2)


def test_saving_the_base_leaves_the_starts_to_the_next_run(job, monkeypatch):
    """A run that is killed while the base is saved comes to the same result when it goes on."""
    folder = work_folder(job.target)
    with monkeypatch.context() as patched, pytest.raises(OSError, match="no space left"):
        patched.setattr(run, "judged", lambda scene: Judgment({}, AS_IT_IS, []))
        patched.setattr(run, "_save", Mock(side_effect=OSError("no space left")))
        adapt_in_tiles(job, 2)
    starts = Store(folder / "start_0.splats").parameters()["opacities"]
    assert not torch.equal(starts, load_vanilla(folder / "part_0.ply").parameters()["opacities"])


def test_what_an_earlier_command_did_stays_where_views_are_refused(job, monkeypatch):
    """Of several scales one may be refused that it was not asked for."""
    real = run.cut_for

    def gone_on_with(jobs, tiles):
        real(jobs, tiles)
        truth_file(work_folder(job.target), 0).touch()

    monkeypatch.setattr(run, "cut_for", gone_on_with)
    monkeypatch.setattr(run, "refuse_blind", Mock(side_effect=SettingsError("none of the views")))
    with pytest.raises(SettingsError, match="none of the views"):
        adapt_in_tiles(job, 2)
    assert truth_file(work_folder(job.target), 0).exists()


def test_an_output_is_not_replaced_unasked(job):
    job.target.write_text("here")
    with pytest.raises(OutputExists):
        adapt_in_tiles(job, 2)
    assert job.target.read_text() == "here" and not work_folder(job.target).exists()


def interrupted_at(work, sweep, number):
    """An engine that is interrupted before one job."""

    def engine(jobs):
        for each in jobs:
            if (each.work, each.sweep, each.number) == (work, sweep, number):
                raise KeyboardInterrupt
            yield from in_this_process([each])

    return engine


@pytest.mark.parametrize(
    ("work", "sweep", "number"), [("tile", 1, 1), ("steering", 1, 0), ("tile", 2, 1), ("steering", 2, 0), ("halo", 3, 0), ("tile", 3, 2)]
)
def test_a_run_that_is_interrupted_anywhere_goes_on_to_the_same_bytes(job, monkeypatch, work, sweep, number):
    """Its second sweep does harm at the last check, and is repeated from the first one in a third."""
    gains, real_steer = {0: [1.0] * 6, 1: [1.5, -9.0], 2: [2.0], 3: [3.0] * 2}, steering.steer

    def steer(scene, made):
        start_db, own = torch.load(scene.folder / "start.pt")["quality"][0], iter(gains[made.number])
        with monkeypatch.context() as patched:
            patched.setattr(steering, "quality", lambda *_: Quality(*[start_db + next(own)] * 2))
            real_steer(scene, made)

    monkeypatch.setattr("mipmap_plugin.tiles.job.steer", steer)
    plan = [Sweep(0, 0, (1,), 0, 0), Sweep(1, 1, (2, 4), 1, 1), Sweep(2, 4, (5, 6), 2, 2)]
    monkeypatch.setattr("mipmap_plugin.tiles.scene.sweeps", lambda config: plan)
    job = replace(job, settings=job.settings | {"steps": 6, "warm_up": 0.0})
    taken_over = []  # of a sweep before: Adam's moments, and time

    def adapt(run, *rest):
        taken_over.append((bool(run.optimizer.state), run.watch.seconds >= 1000))
        return real_adapt(run, *rest)

    monkeypatch.setattr(tile, "adapt", adapt)
    monkeypatch.setattr(tile, "load_torch", lambda file: torch.load(file) | {"seconds": 1000.0})
    undisturbed = adapt_in_tiles(replace(job, target=job.target.with_name("other.ply")), 3)
    assert [tile["sweep"] for tile in undisturbed.tiles] == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3
    assert taken_over == [(False, False)] * 3 + [(True, True)] * 3 + [(False, True)] * 3 + [(True, True)] * 3
    with pytest.raises(KeyboardInterrupt):
        adapt_in_tiles(job, 3, interrupted_at(work, sweep, number))
    assert columns_of(adapt_in_tiles(job, 3).file) == columns_of(undisturbed.file)


def test_a_scale_that_is_interrupted_leaves_the_others_what_they_share(job, monkeypatch):
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.25)]
    first = next(adapt_all_in_tiles(jobs, 2))
    sizes = base_pictures(monkeypatch)
    assert first.file.exists() and adapt_in_tiles(jobs[1], 2).file.exists() and not sizes


@contextmanager
def killed_as_it_appears(output, monkeypatch):
    """A run that writes it ends with what it has left open, and removes nothing."""
    close = staging.Staging.close
    with monkeypatch.context() as patched:
        patched.setattr(staging.Staging, "close", lambda self: os.close(self._lock) if self.path == output else close(self))
        yield patched


def test_a_run_that_is_killed_while_it_deletes_its_tiles_is_in_nobodys_way(job, monkeypatch):
    """What was left of them had no plan, and was taken for other things."""
    job = replace(job, settings=job.settings | {"steps": 0}, overwrite=True)
    with killed_as_it_appears(job.target, monkeypatch):
        adapt_in_tiles(job, 2)
    assert not work_folder(job.target).exists() and list(job.target.parent.glob(".out.ply.?.tmp"))
    adapt_in_tiles(job, 2)
    assert not list(job.target.parent.glob(".out.ply.?.tmp"))


def test_no_folder_is_claimed_if_one_cannot_be(job):
    jobs = [replace(job, target=job.target.with_name(name)) for name in ("a.ply", "b.ply")]
    (work_folder(jobs[1].target)).mkdir()
    (work_folder(jobs[1].target) / "something").write_text("")
    with pytest.raises(SettingsError, match="holds other things"):
        next(adapt_all_in_tiles(jobs, 2))
    assert not work_folder(jobs[0].target).exists()


def test_a_disk_that_is_full_before_the_base_is_cut_leaves_no_plan_behind(job, monkeypatch):
    """Which would refuse other settings, for tiles that are not there."""
    monkeypatch.setattr(plan, "make_cut", Mock(side_effect=OutputError("no space left")))
    with pytest.raises(OutputError, match="no space left"):
        next(adapt_all_in_tiles([job], 2))
    assert not work_folder(job.target).exists()


def test_two_commands_do_not_make_the_same_tiles(job):
    """The one that ended first would delete the folder of the other."""
    asked = []

    def engine(jobs):
        if not asked:
            asked.append(jobs)
            with pytest.raises(SettingsError, match=r"out\.ply\.tiles: another command is making these tiles"):
                adapt_in_tiles(job, 3)
        yield from in_this_process(jobs)

    assert adapt_in_tiles(job, 3, engine).file.is_file() and asked
    assert {path.name for path in job.target.parent.iterdir()} == {"scene", "out.ply", "out.ply.adaptation.json"}


def test_what_a_run_that_was_killed_at_its_plan_leaves_is_in_nobodys_way(job):
    (work_folder(job.target) / f".{PLAN}.0.tmp" / "new").mkdir(parents=True)
    assert adapt_in_tiles(replace(job, settings=job.settings | {"steps": 0}), 2).file.exists()


def test_the_lock_of_tiles_goes_with_them(job, monkeypatch):
    """Also where the run is killed as its output appears."""
    with killed_as_it_appears(job.target, monkeypatch) as patched:
        patched.setattr(plan, "release", lambda folder, lock: os.close(lock))
        adapt_in_tiles(replace(job, settings=job.settings | {"steps": 0}), 2)
    with pytest.raises(OutputExists):
        adapt_in_tiles(job, 2)
    assert {path.name for path in job.target.parent.iterdir()} == {"scene", "out.ply", "out.ply.adaptation.json"}
