"""Many checkpoints at many scales by one command: what is skipped, what fails alone, and the lists of them."""

import json
import os
from pathlib import Path

import pytest
import tiny
from small_jobs import QUICK, job_of

from mipmap_plugin.commands.many import Request, jobs_of
from mipmap_plugin.errors import SettingsError, warn
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Outcome
from mipmap_plugin.jobs.listing import find_checkpoints, read_list, shard, without_outputs
from mipmap_plugin.jobs.run import run as run_job
from mipmap_plugin.jobs.summary import warned
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped

NO_STEP = ["--views", "given", "--steps", "0"]


# The command


def test_a_broken_scene_does_not_stop_the_others(run, scenes):
    (scenes / "broken.ply").write_text("no splats")
    code, out, err = run("adapt", scenes / "broken.ply", scenes / "chair", scenes / "lego", "--scale", "1/2", "--scale", "4", *NO_STEP)
    assert code == 2 and "2 of 6 jobs failed" in err
    assert "6 jobs: 2 failed, 4 done" in out and "broken.ply" in out
    assert {path.name for path in scenes.iterdir()} >= {"chair_x0.5", "chair_x4", "lego_x0.5", "lego_x4"}


def test_what_a_job_failed_by_is_told_by_its_path_from_here(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny.ply(tmp_path / "a b.ply")
    code, out, err = run("adapt", "a b.ply", "no where.ply", "--scale", "1/2", *NO_STEP)
    assert code == 2 and "  no where.ply does not exist" in out and "failed, no where.ply does not exist" in err
    assert str(tmp_path) not in out + err


@pytest.mark.parametrize("jobs", [[], ["--jobs", "2"]], ids=["in this process", "in workers"])
def test_what_jobs_warn_of_is_told_of_each(run, tmp_path, monkeypatch, jobs):
    """It was lost in workers, and in this process told of the first of them alone, without its name."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.ply", "b.ply"):
        tiny.ply(tmp_path / name)
    words = ["adapt", "a.ply", "b.ply", "--scale", "1/2", "--recipe", "instant", *jobs]
    code, _, err = run(*words)
    assert code == 0 and "mipmap-plugin: a.ply x0.5, b.ply x0.5: no cameras are known: " in err and err.count("no cameras") == 1
    told = json.loads(run(*words, "--overwrite", "--json")[1])
    assert all("no cameras are known" in each["warnings"][0] for each in told)


def test_of_many_jobs_that_warn_of_the_same_a_few_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcomes = [Outcome(job_of(tmp_path, scale=1 / number), "done", warnings=("mind this",)) for number in range(1, 1001)]
    assert warned(outcomes)[0].endswith(" x0.25, base.ply x0.2 and 995 more: mind this") and len(warned(outcomes)) == 1
    assert warned(outcomes[:1]) == ["base.ply x1: mind this"]


@pytest.mark.parametrize(("words", "again"), [([], ""), (["--overwrite"], " with --skip-existing"), (["--overwrite", "--skip-existing"], "")])
def test_what_failed_is_done_again_alone_by_the_command_that_is_told(run, scenes, words, again):
    """With --overwrite the same command does all again."""
    (scenes / "broken.ply").write_text("no splats")
    command = ["adapt", scenes / "broken.ply", scenes / "chair", "--scale", "1/2", *NO_STEP, *words]
    assert f"1 of 2 jobs failed; the same command{again} does these again, and no other" in run(*command)[2]
    assert "2 jobs: 1 failed, 1 finished before" in run(*command, *again.split()[1:])[1]


def test_a_quiet_batch_tells_what_failed_and_its_log_tells_all(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny.folder(tmp_path / "a", tiny.cameras(3))
    _, out, err = run("adapt", "a", "nowhere.ply", "--scale", "1/2", "--quiet", "--log", "log", *NO_STEP)
    assert out == "" and "nowhere.ply x0.5: failed, nowhere.ply does not exist" in err and "a x0.5: done" not in err
    log = (tmp_path / "log").read_text()
    assert log.index("a x0.5: done") < log.index("2 jobs: 1 done, 1 failed")


def test_a_job_that_is_interrupted_in_this_process_is_in_the_table_and_its_warnings_are_told(run, scenes, monkeypatch):
    """It was said not to have begun."""

    def interrupted(*_, **__):
        warn("its state cannot be written")
        raise KeyboardInterrupt("interrupted at step 7")

    monkeypatch.setattr(Wrapped, "adapt", interrupted)
    code, out, err = run("adapt", scenes / "chair", scenes / "lego", "--scale", "1/2")
    assert code == 130 and "chair x0.5: interrupted at step 7" in err and "chair x0.5: its state cannot be written\n" in err
    assert "  interrupted at step 7\n" in out and out.endswith("2 jobs: 1 interrupted, 1 not begun\n")


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


@pytest.mark.parametrize("more", [[], ["--jobs", "1"], ["--overwrite"]], ids=" ".join)
def test_a_link_to_itself_is_no_checkpoint(run, tmp_path, more):
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    code, out, err = run("adapt", tmp_path / "loop.ply", "--scale", "1/2", *more)
    assert code == 2 and "loop.ply" in err and "Traceback" not in out + err


def test_this_folder_is_a_checkpoint_too(run, scenes, monkeypatch):
    monkeypatch.chdir(scenes / "lego")
    code, out, _ = run("adapt", ".", "../chair", "--scale", "1/2", *NO_STEP)
    assert code == 0 and "2 done" in out and (scenes / "lego_x0.5").is_dir()


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
        ("", "there is no checkpoint to adapt; give a PLY"),
        ("--scale 4", "there is no checkpoint to adapt; give a PLY"),
        ("a.ply b.ply", "give --scale"),
        ("a.ply b.ply --scale 4 --bytes 2MB", "one checkpoint at a time"),
        ("a.ply b.ply --scale 4 --report", "one checkpoint at a time"),
        ("a.ply --scale 4 --report --skip-existing", "without --tiles, --jobs, --dask, --shard, --send-files and --skip-existing"),
        ("a.ply --jobs 2", "several checkpoints, jobs and tiles need a scale"),
        ("a.ply b.ply --scale 4 --steps -1", "setting steps"),
        ("a.ply b.ply --scale 4 --viewer nobody", "nobody"),
        ("a.ply b.ply --scale 4 --backend nobody", "there is no backend 'nobody'"),
        ("a.ply b.ply --scale 4 --shard 3", "--shard 3: give the part"),
        ("a.ply b.ply --scale 4 --shard 3/2", "--shard 3/2: there is no such part"),
        ("a.ply b.ply --scale 4 --jobs 0", "mipmap-plugin: --jobs must be at least 1, got 0\n"),
        ("a.ply b.ply --scale 4 --threads 0", "mipmap-plugin: --threads must be at least 1, got 0\n"),
        ("a.ply b.ply --scale 4 --jobs 2 --dask local:2", "leave one of them out"),
        ("a.ply --scale 4 --send-files", "--send-files sends them to the workers of --dask"),
        ("a.ply b.ply --scale 4 --jobs 2 --send-files", "--send-files sends them to the workers of --dask"),
        ("x/a.ply y/a.ply --scale 4 --output new", ": x/a.ply and y/a.ply would both be written to new/a_x4.ply; leave --output out"),
        ("a.ply --scale 4 --scale 4.0000001", ": two scales of a.ply would both be written to a_x4.ply; give scales that differ more"),
        ("*.spz --scale 4", "no file or folder fits this pattern"),
        ("--list nowhere.txt --scale 4", "nowhere.txt: No such file"),
    ],
)
def test_what_is_wrong_for_all_is_said_before_any_work(run, tmp_path, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("adapt", *words.split())
    assert (code, out) == (2, "") and reason in err and err.count("\n") == 1


# Lists


def test_jobs_know_where_the_network_lies_that_the_command_names_from_its_folder(tmp_path, monkeypatch):
    """A worker may run in another folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.pth").write_bytes(b"")
    for name, file in {"net.pth": tmp_path / "net.pth", "lanczos": None}.items():
        request = Request([(2.0, None)], None, {"recipe": "default", "upsampler": name}, None, False)
        [job] = jobs_of(tmp_path / "a.ply", request, Base(Path()), several=False)
        assert (job.network, job.settings["upsampler"]) == (file, name)


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


def test_a_link_is_another_checkpoint_than_what_it_leads_to(tmp_path):
    """Each is asked for by its name, and has an output of that name."""
    (tmp_path / "link.ply").symlink_to(tiny.ply(tmp_path / "a.ply"))
    given = [tmp_path / "link.ply", tmp_path / "a.ply"]
    assert find_checkpoints([*given, tmp_path / "." / "link.ply"]) == given


def test_a_list_of_cameras_beside_checkpoints_is_left_out_and_told_of(run, tmp_path):
    tiny.ply(tmp_path / "a.ply")
    write_cameras(tmp_path / "cameras.json", tiny.cameras(3))
    words = ["--scale", "1/2", "--output", tmp_path / "out", "--cameras", tmp_path / "cameras.json", *NO_STEP]
    code, out, err = run("adapt", tmp_path / "*", *words)
    assert code == 0 and "1 job: 1 done" in out and f"left out, because they list cameras: {tmp_path / 'cameras.json'}" in err
    assert run("adapt", tmp_path / "cameras.json", "--jobs", "2", *words)[0] == 2


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", "scan.ply\n".encode("utf-16-be")], ids=["cut off", "UTF-16 that does not say so"])
def test_a_list_that_is_no_text(tmp_path, content):
    (tmp_path / "list").write_bytes(content)
    with pytest.raises(SettingsError, match="not a text file"):
        read_list(tmp_path / "list")


@pytest.mark.parametrize("macos", [False, True])
def test_a_list_may_come_from_a_pipe_of_the_shell_but_not_from_one_that_nobody_may_open(tmp_path, monkeypatch, macos):
    if macos:  # where /dev/fd/3 is no link
        monkeypatch.setattr(os.path, "realpath", os.fspath)
    os.mkfifo(tmp_path / "list")
    with pytest.raises(SettingsError, match="list: a pipe with a name, whose other end nobody may open; --list takes a text file"):
        read_list(tmp_path / "list")
    reading, writing = os.pipe()
    with open(reading), open(writing, "w") as pipe:
        pipe.write("a.ply\n")
        pipe.close()
        assert read_list(Path(f"/dev/fd/{reading}")) == [Path("a.ply")]


def test_a_list_that_is_a_link_to_itself(tmp_path):
    (tmp_path / "list").symlink_to("list")
    with pytest.raises(SettingsError, match="list: Too many levels of symbolic links; --list takes a text file"):
        read_list(tmp_path / "list")


def test_files_that_adaptations_leave_are_left_out(tmp_path):
    job = job_of(tmp_path)
    run_job(job)
    (tmp_path / "out.ply.resume").write_bytes(b"")
    (tmp_path / "out.ply.report.html").write_text("<!doctype html>")
    for folder, file in {"ladder": "levels.json", "tiled.tiles": "plan.json"}.items():
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).write_text("{}")
    (tmp_path / "link.ply").symlink_to("out.ply")
    (tmp_path / "link of base.ply").symlink_to("base.ply")
    kept, left_out = without_outputs(sorted(tmp_path.iterdir()))
    assert kept == [tmp_path / "base.ply", tmp_path / "cameras.json", tmp_path / "link of base.ply"]
    beside = {f"out.ply.{ending}" for ending in ("adaptation.json", "report.html", "resume")}
    assert {path.name for path in left_out} == {"ladder", "link.ply", "out.ply", "tiled.tiles"} | beside


def test_a_list_of_another_editor_is_read_and_an_empty_one_is_named(tmp_path):
    (tmp_path / "list").write_bytes(b"\xef\xbb\xbfa.ply\r\n")
    assert read_list(tmp_path / "list") == [Path("a.ply")]
    (tmp_path / "list").write_text("# nothing yet\n")
    with pytest.raises(SettingsError, match="list lists no checkpoint"):
        read_list(tmp_path / "list")
