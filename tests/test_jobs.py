"""Many checkpoints at many scales: what is skipped, what fails alone, what runs side by side, and what a killed or interrupted run leaves."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import anchor_checkpoints
import corpus
import pytest
import tiny
from running import saving_often, wait_until

from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.validation import MIN_VIEWS
from mipmap_plugin.camera import digest_of
from mipmap_plugin.cli import main
from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.jobs import summary
from mipmap_plugin.jobs import worker as jobs_worker
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.engines import in_workers, longest_first
from mipmap_plugin.jobs.finished import finished
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.listing import find_checkpoints, read_list, shard, without_outputs
from mipmap_plugin.jobs.parcel import do_parcel, pack, unpack
from mipmap_plugin.jobs.run import run as run_job
from mipmap_plugin.jobs.worker import Worker, WorkerDied, do
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.tiles.job import TileJob
from mipmap_plugin.wrap import Wrapped

QUICK = ["--views", "given", "--steps", "2"]
NO_STEP = ["--views", "given", "--steps", "0"]


@pytest.fixture
def run(capsys):
    """Call the command line; return (exit code, what it said on stdout, what on stderr)."""

    def call(*words):
        capsys.readouterr()
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def scenes(tmp_path):
    """Two model folders, one beside the other."""
    for seed, name in enumerate(("chair", "lego")):
        tiny.folder(tmp_path / "output" / name, tiny.cameras(3), seed=seed)
    return tmp_path / "output"


def job_of(tmp_path, **changes):
    base = tmp_path / "base.ply"
    if not base.exists():
        tiny.ply(base)
        write_cameras(tmp_path / "cameras.json", tiny.cameras(3))
    settings = {"steps": 0, "seed": 0, "views": "given"}
    return replace(Job(Base(base, tmp_path / "cameras.json"), tmp_path / "out.ply", 0.5, settings=settings), **changes)


# The command


def test_a_broken_scene_does_not_stop_the_others(run, scenes):
    (scenes / "broken.ply").write_text("no splats")
    code, out, err = run("adapt", scenes / "broken.ply", scenes / "chair", scenes / "lego", "--scale", "1/2", "--scale", "4", *NO_STEP)
    assert code == 2 and "2 of 6 jobs failed" in err
    assert "6 jobs: 2 failed, 4 done" in out and "broken.ply" in out
    assert {path.name for path in scenes.iterdir()} >= {"chair_x0.5", "chair_x4", "lego_x0.5", "lego_x4"}


def test_jobs_that_fail_side_by_side_leave_no_empty_folder(run, scenes, tmp_path, monkeypatch):
    """Each of them removes what it made, but not what the other one had made before."""

    def failing(many, jobs, threads):
        jobs[0].target.parent.mkdir(parents=True)
        yield from (Outcome(job, "failed", reason="the disk is full") for job in jobs)

    monkeypatch.setattr("mipmap_plugin.commands.many.engine", failing)
    assert run("adapt", scenes / "lego", scenes / "chair", "--scale", "1/2", "--output", tmp_path / "new" / "out")[0] == 2
    assert not (tmp_path / "new").exists()


def test_no_job_replaces_the_base_of_another(run, tmp_path):
    for seed, name in enumerate(("a.ply", "a_x0.5.ply")):
        tiny.ply(tmp_path / name, seed=seed)
    before = (tmp_path / "a_x0.5.ply").read_bytes()
    code, _, err = run("adapt", tmp_path / "a.ply", tmp_path / "a_x0.5.ply", "--scale", "1/2", "--overwrite", *NO_STEP)
    assert code == 2 and "a_x0.5.ply holds a checkpoint that is to be adapted too" in err
    assert (tmp_path / "a_x0.5.ply").read_bytes() == before


def test_this_folder_is_a_checkpoint_too(run, scenes, monkeypatch):
    monkeypatch.chdir(scenes / "lego")
    code, out, _ = run("adapt", ".", "../chair", "--scale", "1/2", *NO_STEP)
    assert code == 0 and "2 done" in out and (scenes / "lego_x0.5").is_dir()


def test_two_scales_of_one_name_are_refused(run, scenes):
    code, _, err = run("adapt", scenes / "lego", "--scale", "1/3", "--scale", "0.3333333", *NO_STEP)
    assert code == 2 and "would both be written to" in err and not (scenes / "lego_x0.333333").exists()


def test_json_says_what_failed_and_why(run, scenes):
    code, out, _ = run("adapt", scenes / "nowhere", scenes / "lego", "--scale", "4", "--json", *NO_STEP)
    wrong, right = json.loads(out)
    assert code == 2
    assert wrong["outcome"] == "failed" and "nowhere does not exist" in wrong["reason"] and wrong["report"] is None
    assert right["outcome"] == "done" and right["report"]["scale"] == 4 and Path(right["file"]).is_file()


def test_what_is_finished_is_skipped(run, scenes, monkeypatch):
    command = ["adapt", scenes / "chair", scenes / "lego", "--scale", "1/2", *QUICK]
    assert run(*command)[0] == 0
    monkeypatch.setattr(Wrapped, "adapt", lambda *_, **__: pytest.fail("worked in vain"))
    code, out, _ = run(*command)
    assert code == 0 and "2 jobs: 2 finished before" in out
    code, out, _ = run(*command, "--overwrite", "--skip-existing")
    assert code == 0 and "2 jobs: 2 finished before" in out
    assert run("adapt", scenes / "chair", "--scale", "1/2", "--skip-existing", *QUICK)[0] == 0


def test_other_outputs_are_replaced_only_when_asked(run, scenes):
    command = ["adapt", str(scenes / "*"), "--scale", "4", *NO_STEP]
    assert run(*command)[0] == 0
    code, out, err = run(*command, "--seed", "1")
    assert code == 2 and "exists already; pass --overwrite" in out and "left out, because an adaptation made them: chair_x4, lego_x4" in err
    code, out, _ = run(*command, "--seed", "1", "--overwrite")
    assert code == 0 and "2 jobs: 2 done" in out


def test_a_list_file_and_a_folder_for_all(run, scenes, tmp_path):
    (tmp_path / "scenes.txt").write_text(f"# two scenes\n{scenes / 'chair'}\n\n{scenes}/le*  # a pattern\n")
    code, out, _ = run("adapt", "--list", tmp_path / "scenes.txt", "--scale", "4", "--output", tmp_path / "new", *NO_STEP)
    assert code == 0 and "2 jobs: 2 done" in out
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["chair_x4", "lego_x4"]


def test_cameras_of_each_scene(run, tmp_path):
    for name in ("a", "b"):
        tiny.ply(tmp_path / f"{name}.ply")
        tiny.scene(tmp_path / "data" / name, train=tiny.cameras(3))
    code, out, _ = run("adapt", tmp_path / "a.ply", tmp_path / "b.ply", "--scale", "1/2", "--cameras", tmp_path / "data" / "{name}", "--json", *QUICK)
    assert code == 0 and [each["report"]["views"] for each in json.loads(out)] == ["the 5 given views"] * 2


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("--scale 4", "there is no checkpoint to adapt"),
        ("a.ply b.ply", "give --scale"),
        ("a.ply b.ply --scale 4 --bytes 2MB", "one checkpoint at a time"),
        ("a.ply b.ply --scale 4 --report", "one checkpoint at a time"),
        ("a.ply b.ply --scale 4 --steps -1", "setting steps"),
        ("a.ply b.ply --scale 4 --viewer nobody", "nobody"),
        ("a.ply b.ply --scale 4 --backend nobody", "there is no backend 'nobody'"),
        ("a.ply b.ply --scale 4 --shard 3", "--shard 3: give the part"),
        ("a.ply b.ply --scale 4 --shard 3/2", "--shard 3/2: there is no such part"),
        ("a.ply b.ply --scale 4 --jobs 0", "mipmap-plugin: --jobs must be at least 1, got 0\n"),
        ("a.ply b.ply --scale 4 --threads 0", "mipmap-plugin: --threads must be at least 1, got 0\n"),
        ("a.ply b.ply --scale 4 --jobs 2 --dask local:2", "leave one of them out"),
        ("x/a.ply y/a.ply --scale 4 --output new", "would both be written to"),
        ("*.spz --scale 4", "no file or folder fits this pattern"),
        ("--list nowhere.txt --scale 4", "nowhere.txt: No such file"),
    ],
)
def test_what_is_wrong_for_all_is_said_before_any_work(run, tmp_path, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("adapt", *words.split())
    assert (code, out) == (2, "") and reason in err and err.count("\n") == 1


# Lists


def test_shards_are_all_jobs_each_once():
    items = list(range(11))
    parts = [shard(items, part, 4) for part in range(1, 5)]
    assert sorted(item for part in parts for item in part) == items and {len(part) for part in parts} == {2, 3}
    assert shard(items[:2], 4, 4) == []
    with pytest.raises(SettingsError, match="no such part"):
        shard(items, 0, 4)


def test_a_checkpoint_given_twice_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny.ply(tmp_path / "a.ply")
    (tmp_path / "b[1].ply").write_bytes((tmp_path / "a.ply").read_bytes())
    assert find_checkpoints([Path("a.ply"), tmp_path / "a.ply", Path("*.ply")]) == [Path("a.ply"), Path("b[1].ply")]
    assert find_checkpoints([Path("b[1].ply")]) == [Path("b[1].ply")]  # a name, though it looks like a pattern


def test_a_list_of_cameras_beside_checkpoints_is_left_out_and_told_of(run, tmp_path):
    tiny.ply(tmp_path / "a.ply")
    write_cameras(tmp_path / "cameras.json", tiny.cameras(3))
    words = ["--scale", "1/2", "--output", tmp_path / "out", "--cameras", tmp_path / "cameras.json", *NO_STEP]
    code, out, err = run("adapt", tmp_path / "*", *words)
    assert code == 0 and "1 job: 1 done" in out and f"left out, because they list cameras: {tmp_path / 'cameras.json'}" in err
    assert run("adapt", tmp_path / "cameras.json", "--jobs", "2", *words)[0] == 2


def test_a_list_that_is_no_text(tmp_path):
    (tmp_path / "list").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingsError, match="not a text file"):
        read_list(tmp_path / "list")


def test_files_that_adaptations_leave_are_left_out(tmp_path):
    job = job_of(tmp_path)
    run_job(job)
    (tmp_path / "out.ply.resume").write_bytes(b"")
    (tmp_path / "ladder").mkdir()
    (tmp_path / "ladder" / "levels.json").write_text("{}")
    kept, left_out = without_outputs(sorted(tmp_path.iterdir()))
    assert kept == [tmp_path / "base.ply", tmp_path / "cameras.json"]
    assert {path.name for path in left_out} == {"ladder", "out.ply", "out.ply.adaptation.json", "out.ply.resume"}


# What counts as finished


def test_only_the_same_request_is_finished(tmp_path):
    job = job_of(tmp_path)
    assert finished(job) is None
    assert run_job(job).status == "done"
    file, report = finished(job)
    assert file == tmp_path / "out.ply" and report["scale"] == 0.5
    for other in ({"scale": 0.25}, {"viewer": "spark"}, {"recipe": "thorough"}, {"settings": {**job.settings, "seed": 1}}):
        assert finished(replace(job, **other)) is None


def test_a_large_scene_that_took_fewer_steps_is_finished(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", dict(steps=8, most_draws=1.0, check_every=2))
    job = job_of(tmp_path, settings={"seed": 0, "views": "given"})
    assert run_job(job).report["settings"]["steps"] == 2
    assert finished(job) is not None and run_job(job).status == "finished before"
    for other in ({"steps": 8}, {"extra_views": 40}):  # the former takes all of them
        assert finished(replace(job, settings=job.settings | other)) is None


def test_a_file_is_finished_by_the_views_for_validation_that_were_asked_for(tmp_path):
    """A time budget, here one for the fewest, does not tell these from fewer that somebody asked for."""
    job = job_of(tmp_path, settings={"steps": 1, "seed": 0, "views": "given", "time_budget_s": 1e-3}, overwrite=True)
    fewest = replace(job, settings=job.settings | {"validation_views": MIN_VIEWS})
    for made, other in ((fewest, job), (job, fewest)):
        assert run_job(made).status == "done"
        assert finished(made) is not None and finished(other) is None


def test_another_base_or_another_file_is_not_finished(tmp_path):
    job = job_of(tmp_path)
    run_job(job)
    output = (tmp_path / "out.ply").read_bytes()
    tiny.ply(tmp_path / "other.ply", seed=1)
    (tmp_path / "out.ply").write_bytes((tmp_path / "other.ply").read_bytes())  # the report stays
    assert finished(job) is None
    (tmp_path / "out.ply").write_bytes(output)
    assert finished(job) is not None
    (tmp_path / "base.ply").write_bytes((tmp_path / "other.ply").read_bytes())
    assert finished(job) is None


def test_other_cameras_background_or_photographs_are_not_finished(tmp_path):
    scene = tiny.scene(tmp_path / "scene", train=tiny.cameras(3), count=30)
    job = job_of(tmp_path, images=scene, scale=2.0, settings={"steps": 1, "seed": 0, "views": "train"})
    assert run_job(job).status == "done" and finished(job) is not None
    for changed in ({"background": "white"}, {"screen_filter": "mip"}, {"cameras": None}):
        assert finished(replace(job, base=replace(job.base, **changed))) is None
    assert finished(replace(job, images=None)) is None
    photograph = next((tmp_path / "scene").rglob("*.png"))
    content = photograph.read_bytes()
    photograph.write_bytes(content + b"0")
    assert finished(job) is None
    photograph.write_bytes(content)
    write_cameras(tmp_path / "cameras.json", tiny.cameras(4), overwrite=True)
    assert finished(job) is None
    write_cameras(tmp_path / "cameras.json", tiny.cameras(3), overwrite=True)
    assert finished(job) is not None


@pytest.mark.usefixtures("small_orbits")
def test_another_vertical_is_not_finished(tmp_path):
    job = job_of(tmp_path)
    job = replace(job, base=replace(job.base, cameras=None, up="z"))
    assert run_job(job).status == "done" and finished(job) is not None
    for up in ("-z", None):
        assert finished(replace(job, base=replace(job.base, up=up))) is None
    assert "up" not in Base(job.base.checkpoint).asked()  # so that files of before the option are still finished


def test_other_options_of_the_training_are_not_finished(tmp_path):
    folder = tiny.folder(tmp_path / "scene", count=30)
    job = replace(job_of(tmp_path), base=Base(folder))
    assert run_job(job).status == "done" and finished(job) is not None
    (folder / "cfg_args").write_text("Namespace(sh_degree=1, white_background=True)")
    assert finished(job) is None


@pytest.mark.parametrize("given", ["", "transforms_train.json"])
def test_a_job_that_travels_makes_the_same_bytes(tmp_path, given):
    scene = tiny.scene(tmp_path / "scene", train=tiny.cameras(3), count=30)
    here = job_of(tmp_path, images=scene / given, scale=2.0, skip_finished=False, settings={"steps": 1, "seed": 0, "views": "train"})
    assert run_job(here).status == "done"
    away = replace(here, target=tmp_path / "away" / "new.ply")
    parcel = pack(away)
    for place in (tmp_path / "base.ply", tmp_path / "cameras.json", scene):
        place.rename(place.with_name(f"gone_{place.name}"))
    delivery = do_parcel(parcel, run_job)
    outcome = unpack(delivery, away)
    assert (outcome.status, outcome.file, outcome.job) == ("done", away.target, away)
    assert away.target.read_bytes() == here.target.read_bytes()
    assert {path.name for path in away.target.parent.iterdir()} == {"new.ply", "new.ply.adaptation.json"}
    with pytest.raises(OutputExists):
        unpack(delivery, away)
    failed = unpack(do_parcel(replace(parcel, job=replace(parcel.job, viewer="nobody")), run_job), away)
    assert failed.status == "failed" and "nobody" in failed.reason


def test_files_that_are_links_travel_as_what_they_are_links_to(tmp_path):
    """Checkpoints and photographs on another disk often are links, files and folders."""
    disk, folder = tmp_path / "disk", tmp_path / "base"
    model, scene = tiny.folder(disk / "model", tiny.cameras(3)), tiny.scene(tmp_path / "scene", train=tiny.cameras(2))
    folder.mkdir()
    for name in ("cfg_args", "cameras.json", "point_cloud"):
        (folder / name).symlink_to(model / name)
    (scene / "train").rename(disk / "train")
    (scene / "train").symlink_to(disk / "train")
    (scene / "again").symlink_to(scene)
    job = Job(Base(folder), tmp_path / "out", 2.0, images=scene)
    found = []

    def look(job):
        found.append((len(job.base.load().cameras), len(job.base.photographs(job.images).images)))
        return Outcome(job, "failed")

    do_parcel(pack(job), look)
    assert found == [(3, 4)]


def test_the_name_of_the_folder_above_a_capture_travels(tmp_path):
    """Deformable 3D Gaussians takes the size and split of a HyperNeRF capture from it."""
    scene = tiny.scene(tmp_path / "vrig-chicken/scene", train=tiny.cameras(1))
    job = replace(job_of(tmp_path, images=scene), base=Base(tmp_path / "base.ply", scene))
    above = []

    def look(job):
        above.extend(path.parent.name for path in (job.base.cameras, job.images) if (path / "transforms_train.json").is_file())
        return Outcome(job, "failed")

    do_parcel(pack(job), look)
    assert above == ["vrig-chicken"] * 2


def test_photographs_outside_the_folder_of_their_list_do_not_travel(tmp_path):
    scene = tiny.scene(tmp_path / "scene", train=tiny.cameras(1), count=30)
    (scene / "lists").mkdir()
    file = scene / "lists" / "transforms_train.json"
    file.write_text((scene / "transforms_train.json").read_text().replace('"file_path": "', '"file_path": "../'))
    with pytest.raises(SettingsError, match="lies outside its folder"):
        pack(job_of(tmp_path, images=file))


@pytest.mark.parametrize(("changes", "kept"), [({}, [".resume"]), (dict(scale=2.0, viewer="antialiased"), [".resume", ".resume.x1"])])
def test_an_interrupted_run_travels_with_its_states(tmp_path, changes, kept):
    """A zoom-in for another viewer has that of its conversion too."""
    settings = {"steps": 4, "seed": 0, "views": "given", "warm_up": 0}
    job = replace(job_of(tmp_path, target=tmp_path / "new" / "out.ply", settings=settings), **changes)

    def interrupted(job):
        def stopped(run, task, config, stop, observe):
            return adapt(run, task, config, stop, lambda run: stop(run) if run.step == 2 and task.scale == job.scale else None)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr("mipmap_plugin.adaptation.session.adapt", stopped)
            try:
                run_job(job)
            except KeyboardInterrupt as interrupt:
                return Outcome(job, "interrupted", reason=str(interrupt))

    outcome = unpack(do_parcel(pack(job), interrupted), job)
    states = [job.target.with_name(f"out.ply{ending}") for ending in kept]
    assert outcome.status == "interrupted" and sorted(job.target.parent.glob("*.resume*")) == states and not job.target.exists()
    began = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, *rest: began.append(run.step) or adapt(run, *rest))
        assert unpack(do_parcel(pack(job), run_job), job).status == "done"
    assert began == [2] and not any(state.exists() for state in states)
    whole = replace(job, target=tmp_path / "whole.ply")
    assert run_job(whole).status == "done" and whole.target.read_bytes() == job.target.read_bytes()


def test_tiles_do_not_travel(tmp_path):
    with pytest.raises(SettingsError, match="tiles need a folder that all workers see"):
        pack(TileJob(**vars(job_of(tmp_path))))


@pytest.mark.parametrize("given", ["", "point_cloud/iteration_30000/point_cloud.ply"])
@pytest.mark.parametrize("suffix", ["", ".ply"])
def test_a_model_folder_travels(tmp_path, suffix, given):
    folder = tiny.folder(tmp_path / "base", tiny.cameras(3))
    (folder / "cfg_args").write_text("Namespace(sh_degree=1, white_background=True)")
    job = Job(Base(folder / given), tmp_path / f"here{suffix}", 0.5, settings={"steps": 0, "seed": 0, "views": "given"})
    assert run_job(job).status == "done"
    away = replace(job, target=tmp_path / f"away{suffix}")
    assert unpack(do_parcel(pack(away), run_job), away).status == "done"
    here, there = (path.read_bytes() if suffix else next(path.rglob("*.ply")).read_bytes() for path in (job.target, away.target))
    assert here == there and finished(away) is not None


@pytest.mark.parametrize("given", ["", "point_cloud/iteration_30000/point_cloud.ply"])
def test_given_cameras_have_the_image_size_of_the_training(tmp_path, given):
    """Its options lie in the model folder, whether that or a file in it is named."""
    folder = tiny.folder(tmp_path / "base", tiny.cameras(3))
    (folder / "cfg_args").write_text("Namespace(sh_degree=1, resolution=2)")
    base = Base(folder / given, cameras=folder / "cameras.json")
    views = base.load().cameras
    assert {view.size for view in views} == {(tiny.HEIGHT // 2, tiny.WIDTH // 2)}
    assert base.asked()["cameras"] == digest_of(views)


@pytest.mark.parametrize("given", ["", "cameras.json"])
def test_cameras_that_are_sent_keep_the_image_size_of_their_training(tmp_path, given):
    folder, lone = tiny.folder(tmp_path / "base", tiny.cameras(3)), tiny.ply(tmp_path / "lone.ply")
    (folder / "cfg_args").write_text("Namespace(sh_degree=1, resolution=2)")
    job = Job(Base(lone, cameras=folder / given), tmp_path / "out.ply", 0.5)
    sizes = []

    def look(job):
        sizes.extend(view.size for view in job.base.load().cameras)
        return Outcome(job, "failed")

    do_parcel(pack(job), look)
    assert sizes == [(tiny.HEIGHT // 2, tiny.WIDTH // 2)] * 3


def test_options_beside_an_exchange_format_are_not_of_its_training(tmp_path):
    """Loading it does not read them."""
    file = corpus.SAMPLES[".spz"].make(tmp_path / "base")
    (tmp_path / "base" / "cfg_args").write_text("Namespace(sh_degree=1, white_background=True)")
    write_cameras(tmp_path / "base" / "cameras.json", tiny.cameras(3))
    assert Base(file, cameras=tmp_path / "base" / "cameras.json").asked()["options"] == ""


def test_what_comes_back_never_replaces_the_base(tmp_path):
    """The worker has copies of the base elsewhere, so that it cannot know."""
    job = job_of(tmp_path)
    delivery = do_parcel(pack(job), run_job)
    onto_base = replace(job, target=job.base.checkpoint, overwrite=True)
    before = job.base.checkpoint.read_bytes()
    with pytest.raises(OutputExists, match="is the base checkpoint itself"):
        pack(onto_base)  # before any work
    with pytest.raises(OutputExists, match="is the base checkpoint itself"):
        unpack(delivery, onto_base)
    assert job.base.checkpoint.read_bytes() == before


def test_a_model_folder_comes_back_as_a_whole(tmp_path):
    folder = tiny.folder(tmp_path / "base", tiny.cameras(3))
    settings = {"steps": 0, "seed": 0, "views": "given"}
    job = Job(Base(folder), tmp_path / "away", 0.5, settings=settings, overwrite=True)
    delivery = do_parcel(pack(job), run_job)
    old = tmp_path / "away" / "point_cloud" / "iteration_99999" / "point_cloud.ply"
    old.parent.mkdir(parents=True)
    old.write_text("of an older run")
    assert unpack(delivery, job).status == "done" and not old.exists()
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "letter.txt").write_text("mine")
    delivery = do_parcel(pack(replace(job, target=tmp_path / "new" / "own")), run_job)
    with pytest.raises(OutputExists, match="other things in it"):
        unpack(delivery, replace(job, target=tmp_path / "own"))
    assert (tmp_path / "own" / "letter.txt").exists()


def test_a_damaged_report_is_not_finished(tmp_path):
    job = job_of(tmp_path)
    run_job(job)
    (tmp_path / "out.ply.adaptation.json").write_text("{")
    assert finished(job) is None


def test_a_file_for_several_viewers_is_recognized(tmp_path):
    """Whose settings are not quite the recipe's."""
    job = job_of(tmp_path, viewer="portable", settings={"steps": 0, "views": "given"})
    assert run_job(job).status == "done"
    assert finished(job) is not None


def test_splats_that_are_not_merged_are_recognized(tmp_path):
    job = job_of(tmp_path)
    job = replace(job, base=replace(job.base, checkpoint=anchor_checkpoints.write(tmp_path / "scaffold")), target=tmp_path / "out")
    assert run_job(job).status == "done"
    assert finished(job) is not None


def test_a_job_that_another_process_finished_meanwhile(tmp_path, monkeypatch):
    job = job_of(tmp_path)
    save = Wrapped.refuse_output

    def after_the_other(self, *arguments, **options):
        monkeypatch.undo()
        assert run_job(job).status == "done"
        return save(self, *arguments, **options)

    monkeypatch.setattr(Wrapped, "refuse_output", after_the_other)
    assert run_job(job).status == "finished before"


def test_a_bug_is_an_outcome_with_its_trace(tmp_path, monkeypatch):
    monkeypatch.setattr(Wrapped, "adapt", lambda *_, **__: 1 / 0)
    outcome = run_job(job_of(tmp_path))
    assert outcome.status == "failed" and outcome.reason == "ZeroDivisionError: division by zero" and "Traceback" in outcome.trace


def test_out_of_memory_is_one_sentence(tmp_path, monkeypatch):
    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(Wrapped, "adapt", full)
    assert run_job(job_of(tmp_path)).reason.startswith("out of memory; use a smaller scale")


# Workers


def test_a_list_of_another_editor_is_read_and_an_empty_one_is_named(tmp_path):
    (tmp_path / "list").write_bytes(b"\xef\xbb\xbfa.ply\r\n")
    assert read_list(tmp_path / "list") == [Path("a.ply")]
    (tmp_path / "list").write_text("# nothing yet\n")
    with pytest.raises(SettingsError, match="list lists no checkpoint"):
        read_list(tmp_path / "list")


def test_workers_share_all_threads_where_jobs_are_few(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("mipmap_plugin.jobs.engines.Worker", lambda threads: made.append(threads) or SimpleNamespace(stop=list, close=list))
    monkeypatch.setattr("mipmap_plugin.jobs.engines.do", lambda job, worker: Outcome(job, "done"))
    assert len(list(in_workers([job_of(tmp_path)] * 2, count=8, threads=16))) == 2 and made == [8, 8]


def test_workers_begin_with_what_takes_longest(tmp_path):
    job = job_of(tmp_path)
    large = replace(job, base=replace(job.base, checkpoint=tmp_path / "large.ply"))
    (tmp_path / "large.ply").write_bytes(8 * (tmp_path / "base.ply").read_bytes())
    missing = replace(job, base=replace(job.base, checkpoint=tmp_path / "missing.ply"))
    half, double = job, replace(job, scale=2.0)
    assert longest_first([missing, half, large, double]) == [large, double, half, missing]
    assert longest_first([half, replace(half, viewer="gsplat"), large])[1:] == [half, replace(half, viewer="gsplat")]


@pytest.fixture
def worker():
    worker = Worker(1)
    yield worker
    worker.close()


def test_a_job_whose_worker_is_killed_is_done_again(worker, tmp_path, monkeypatch):
    begin, killed = worker.begin, []

    def kill(most):
        def begin_and_kill(job):
            begin(job)
            if len(killed) < most:
                killed.append(os.kill(worker._process.pid, signal.SIGKILL))

        monkeypatch.setattr(worker, "begin", begin_and_kill)

    kill(1)
    outcome = do(job_of(tmp_path), worker)
    assert killed and outcome.status == "done" and (tmp_path / "out.ply").exists()
    kill(9)
    failed = do(job_of(tmp_path, target=tmp_path / "other.ply"), worker)
    assert failed.status == "failed" and "was killed, perhaps for want of memory" in failed.reason
    worker.stop()
    assert do(job_of(tmp_path), worker).status == "interrupted"


@pytest.mark.slow
def test_nothing_is_lost_whenever_a_worker_is_killed(tmp_path):
    """At 20 moments, from the worker's start to its answer."""
    job, moments = job_of(tmp_path, settings={"steps": 40, "seed": 0, "views": "given"}), random.Random(0)
    began = time.monotonic()
    assert do(replace(job, target=tmp_path / "whole.ply"), Worker(1)).status == "done"
    seconds, killed = time.monotonic() - began, 0
    for number in range(20):
        again, worker = replace(job, target=tmp_path / f"{number}.ply"), Worker(1)

        def kill_once(worker=worker):
            nonlocal killed
            if worker._process is not None:
                killed += 1
                os.kill(worker._process.pid, signal.SIGKILL)

        timer = threading.Timer(moments.uniform(0, seconds), kill_once)
        timer.start()
        assert do(again, worker).status in ("done", "finished before")  # before, if it was killed on its way to say so
        timer.cancel()
        worker.close()
        assert again.target.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert killed >= 10 and not list(tmp_path.glob("*.resume*")) and not list(tmp_path.glob(".*"))


def test_side_by_side_makes_the_same_bytes_as_one_after_the_other(run, scenes, tmp_path):
    command = ["adapt", scenes / "chair", scenes / "lego", "--scale", "1/2", *QUICK]
    for name, words in {"one": [], "two": ["--jobs", "2"]}.items():
        code, out, err = run(*command, "--output", tmp_path / name, *words)
        assert code == 0 and "2 jobs: 2 done" in out, err
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.ply"))
    assert len(files) == 2
    assert [(tmp_path / "one" / file).read_bytes() for file in files] == [(tmp_path / "two" / file).read_bytes() for file in files]


@pytest.mark.parametrize("engine", [["--jobs", "2"], pytest.param(["--dask", "local:2"], marks=pytest.mark.slow)], ids=["jobs", "dask"])
def test_ctrl_c_saves_the_state_of_every_running_job(run, scenes, tmp_path, engine):
    if "--dask" in engine:
        pytest.importorskip("distributed")
    words = ["adapt", scenes / "chair", scenes / "lego", "--scale", "1/2", "--scale", "1/4", "--views", "given"]
    command = [sys.executable, "-m", "mipmap_plugin", *map(str, words), "--steps", "100000", "--recipe", "paper", *engine]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=saving_often(tmp_path / "site")
    )
    try:
        wait_until(lambda: len(list(scenes.glob("*.resume"))) == 2 or process.poll() is not None)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        out, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "mipmap-plugin: interrupted; run the same command again to go on where it stopped" in err and "Traceback" not in err
    assert out.strip().endswith("4 jobs: 4 interrupted" if "--dask" in engine else "4 jobs: 2 interrupted, 2 not begun")
    assert len(list(scenes.glob("*.resume"))) == 2 and not list(scenes.glob(".*.lock"))


def test_the_db_before_are_the_bases_and_of_no_other_state():
    told = {"the base as it is": 38.7, "the start": 21.9, "the last state": 25.0}
    assert summary._psnr({"validation": told, "returned": "the last state"}) == "38.70 -> 25.00"
    assert summary._psnr({"validation": {"the start": 21.9}, "returned": "the start"}) == ""
    assert summary._psnr({"validation": told, "returned": "the last state", "written": 24.5}) == "38.70 -> 24.50"  # as its format rounds it


def test_an_interruption_is_told_once(tmp_path):
    outcome = Outcome(job_of(tmp_path), "interrupted", reason="interrupted at step 132")
    assert str(outcome).count("interrupted") == 1 and str(replace(outcome, reason="")).endswith(": interrupted")


def test_without_words_a_checkpoint_is_asked_for(run):
    code, _, err = run("adapt")
    assert code == 2 and "there is no checkpoint to adapt; give a PLY" in err


def test_a_worker_that_is_stopped_while_it_starts_begins_nothing(monkeypatch, tmp_path):
    worker, start = Worker(1), jobs_worker._start
    monkeypatch.setattr(jobs_worker, "_start", lambda threads: worker.stop() or start(threads))
    try:
        with pytest.raises(WorkerDied, match="was stopped"):
            worker.begin(Job(Base(tmp_path), tmp_path / "out.ply", 0.5))
    finally:
        worker.close()
