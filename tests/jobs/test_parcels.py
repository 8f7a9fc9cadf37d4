"""A job that travels to another machine makes the same bytes there, and what comes back is whole."""

import importlib.util
from dataclasses import replace

import corpus
import pytest
import tiny
import torch
from small_jobs import job_of

from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.camera import digest_of
from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.finished import finished
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.jobs.parcel import do_parcel, pack, unpack
from mipmap_plugin.jobs.run import run as run_job
from mipmap_plugin.models.places import PAGE_TITLE
from mipmap_plugin.process.torchvision_absent import torchvision_optional
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.tiles.job import TileJob


def found_there(job, look):
    """What a look at a job finds where it has traveled to."""
    found = []
    do_parcel(pack(job), lambda job: found.append(look(job)) or Outcome(job, "failed"))
    return found[0]


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
    page = away.target.with_name("new.ply.report.html")
    page.write_bytes(PAGE_TITLE)
    assert unpack(delivery, replace(away, overwrite=True)).status == "done" and not page.exists()
    failed = unpack(do_parcel(replace(parcel, job=replace(parcel.job, viewer="nobody")), run_job), away)
    assert failed.status == "failed" and "nobody" in failed.reason


def test_the_network_of_a_job_travels(tmp_path, monkeypatch):
    """The worker has another folder, where the path of the settings leads nowhere."""
    if importlib.util.find_spec("spandrel") is None:
        pytest.skip("spandrel is in the extra sr")
    with torchvision_optional():
        from spandrel.architectures.Compact.__arch.SRVGG import SRVGGNetCompact
    monkeypatch.setenv("MIPMAP_PLUGIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    torch.save(SRVGGNetCompact(num_feat=8, num_conv=2, upscale=2).state_dict(), "net.pth")
    settings = {"steps": 1, "seed": 0, "views": "given", "upsampler": "net.pth"}
    here = job_of(tmp_path, scale=2.0, settings=settings, network=tmp_path / "net.pth")
    assert run_job(here).status == "done"
    parcel, away = pack(there := replace(here, target=tmp_path / "away" / "new.ply")), tmp_path / "other"
    away.mkdir()
    monkeypatch.chdir(away)
    delivery = do_parcel(parcel, run_job)
    monkeypatch.chdir(tmp_path)
    outcome = unpack(delivery, there)
    assert outcome.status == "done" and outcome.file.read_bytes() == here.target.read_bytes()
    assert finished(there)


def test_the_report_of_a_job_that_traveled_names_no_folder_of_the_worker(tmp_path):
    job = job_of(tmp_path)
    delivery = do_parcel(pack(job), run_job)
    assert delivery.outcome.status == "done" and delivery.outcome.report["cameras_from"] == {}


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
    assert found_there(job, lambda job: (len(job.base.load().cameras), len(job.base.photographs(job.images).images))) == (3, 4)


def test_the_name_of_the_folder_above_a_capture_travels(tmp_path):
    """Deformable 3D Gaussians takes the size and split of a HyperNeRF capture from it."""
    scene = tiny.scene(tmp_path / "vrig-chicken/scene", train=tiny.cameras(1))
    job = replace(job_of(tmp_path, images=scene), base=Base(tmp_path / "base.ply", scene))

    def look(job):
        return [path.parent.name for path in (job.base.cameras, job.images) if (path / "transforms_train.json").is_file()]

    assert found_there(job, look) == ["vrig-chicken"] * 2


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
            return run_job(job)

    delivery = do_parcel(pack(job), interrupted)
    outcomes = [unpack(delivery, job) for _ in range(2)]  # where the state of an earlier interruption lies, too
    states = [job.target.with_name(f"out.ply{ending}") for ending in kept]
    assert {outcome.status for outcome in outcomes} == {"interrupted"}
    assert sorted(job.target.parent.glob("*.resume*")) == states and not job.target.exists()
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
    assert found_there(job, lambda job: [view.size for view in job.base.load().cameras]) == [(tiny.HEIGHT // 2, tiny.WIDTH // 2)] * 3


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
