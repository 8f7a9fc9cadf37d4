"""`adapt`: what it writes, and how it goes on after Ctrl-C."""

import gc
import json
import re
import signal
import weakref
from pathlib import Path
from unittest.mock import Mock

import pressing
import pytest
import tiny
from commands_run import NO_STEP, QUICK, refused
from pages_read import record_of

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import Wrapped

pytestmark = pytest.mark.usefixtures("few_views")


def splats_of(report):
    """The bytes of the splats of an adapted PLY, whose header has the seconds of the run."""
    return Path(report["file"]).read_bytes().partition(b"end_header\n")[2]


def test_adapt_two_scales_into_a_folder(run, model_folder, tmp_path):
    words = ["adapt", model_folder, "--scale", "1/4", "--scale", "2", "--output", tmp_path / "out", "--log", tmp_path / "log.txt", *QUICK]
    code, out, _ = run(*words)
    assert code == 0
    what, where = out.splitlines()[::2], out.splitlines()[1::2]
    for scale, name in [(0.25, "base_x0.25"), (2, "base_x2")]:
        ply = tmp_path / "out" / name / "point_cloud/iteration_30000/point_cloud.ply"
        assert provenance_of(read_ply(ply).comments)["scale"] == scale
        assert json.loads(ply.with_name("point_cloud.ply.adaptation.json").read_text())["scale"] == scale
        assert where.pop(0).startswith(f"{ply}, made for renderers that draw as 3DGS does")
        assert re.fullmatch(rf"x{scale:g}: (\S+ -> \S+ dB on views|holds the base as it is, ).*, 60 -> \d+ splats, \d+\.\d s", what.pop(0))
    log = (tmp_path / "log.txt").read_text()
    assert "ended by 2 steps" in log and "backend cpu: " in log and "the 4 given views" in log
    assert not list(tmp_path.rglob("*.resume"))


@pytest.mark.parametrize(
    "words",
    ["", "--scale 1/2 --recipe mine", "--scale 1/2 --steps -1", "--scale 1/2 --viewer nobody", "--splats 9 --steps -1",
     "--splats 0", "--bytes 9parsecs"],
)  # fmt: skip
def test_what_is_wrong_whatever_the_checkpoint_is_said_before_it_is_read(run, model_folder, monkeypatch, words):
    """Reading a large one takes long."""
    monkeypatch.setattr("mipmap_plugin.commands.adapt.wrap", lambda *_: pytest.fail("it was read"))
    refused(run("adapt", model_folder, *words.split()))


def test_a_folder_that_is_given_for_a_file_is_not_offered_to_be_replaced(run, model_folder, tmp_path):
    base = tiny.ply(tmp_path / "base.ply")
    said = f"{tmp_path} is a folder; give the path of what is to be written, such as {tmp_path / 'base_x0.5.ply'}"
    assert "--overwrite" not in refused(run("adapt", base, "--scale", "1/2", "--output", tmp_path), said)
    assert run("adapt", base, "--scale", "1/2", "--output", tmp_path / "one" / "a.ply", *NO_STEP)[0] == 0
    refused(run("adapt", base, "--scale", "1/2", "--output", tmp_path / "one"), "one is a folder; ")  # though an adaptation made all that is in it
    words = ["adapt", model_folder, "--scale", "1/2", "--output", tmp_path / "made", *NO_STEP]
    assert run(*words)[0] == 0
    refused(run(*words), "made exists already; pass --overwrite")


def test_a_link_that_is_replaced_has_its_page_beside_it(run, tmp_path):
    """The page lay beside what the link had led to, under that one's name."""
    base, link, other = tiny.ply(tmp_path / "base.ply"), tmp_path / "made" / "link.ply", tmp_path / "other"
    link.parent.mkdir()
    other.mkdir()
    link.symlink_to(tiny.ply(other / "a.ply"))
    assert run("adapt", base, "--scale", "1/2", "--output", link, "--overwrite", "--report", *NO_STEP)[0] == 0
    assert (link.parent / "link.ply.report.html").is_file() and [file.name for file in other.iterdir()] == ["a.ply"]


def test_the_name_of_one_checkpoint_stands_in_paths_too(run, tmp_path):
    """As with several: the scene was looked for in a folder {name}."""
    tiny.scene(tmp_path / "data" / "base", train=tiny.cameras(3))
    answer = run("adapt", tiny.ply(tmp_path / "base.ply"), "--scale", "1/2", "--cameras", tmp_path / "data" / "{name}", "--json", *QUICK)
    assert answer[0] == 0 and "the 5 given views" in json.loads(answer[1])[0]["views"]


def test_a_file_that_is_written_takes_no_memory_while_the_next_is_made(run, model_folder, tmp_path, monkeypatch):
    made, left, adapt = [], [], Wrapped.adapt

    def watched(*arguments, **options):
        gc.collect()
        left.append([each() for each in made])
        adapted = adapt(*arguments, **options)
        made.append(weakref.ref(adapted))
        return adapted

    monkeypatch.setattr(Wrapped, "adapt", watched)
    assert run("adapt", model_folder, "--scale", "1/4", "--scale", "1/2", "--output", tmp_path / "out", *NO_STEP)[0] == 0
    assert left == [[], [None]]


def test_adapt_writes_beside_the_checkpoint_unless_told_otherwise(run, tmp_path):
    base = tiny.ply(tmp_path / "base.ply")
    code, out, _ = run("adapt", base, "--scale", "4", *NO_STEP, "--json")
    assert code == 0
    [report] = json.loads(out)
    assert report["file"] == str(tmp_path / "base_x4.ply") and report["settings"]["recipe"] == "default"
    assert len(load_model(tmp_path / "base_x4.ply")) == 60


def test_one_splat_is_told_as_one(run, tmp_path):
    code, out, _ = run("adapt", tiny.ply(tmp_path / "base.ply"), "--scale", "1/2", *NO_STEP, "--splats", "1")
    assert code == 0 and ", 60 -> 1 splat, " in out


def test_files_and_pages_are_told_by_their_paths_from_here(run):
    """Files beside the checkpoint were told by their whole paths, and those of --output as they were given; the JSON has whole paths."""
    tiny.folder(Path("base"))
    words = ["adapt", "base", "--scale", "1/2", *NO_STEP]
    _, beside, _ = run(*words, "--report")
    assert beside.splitlines()[1].startswith("base_x0.5/point_cloud/") and beside.splitlines()[-1] == "page: base_x0.5.report.html"
    _, out, err = run(*words, "--jobs", "1", "--output", "other.ply")
    assert out.splitlines()[1].endswith(" other.ply") and err.startswith("base x0.5: done")
    _, report, _ = run(*words, "--output", "third.ply", "--json")
    assert json.loads(report)[0]["file"] == str(Path("third.ply").absolute())


def test_adapt_hands_its_options_on(run, model_folder, tmp_path):
    options = ["--recipe", "paper", "--seed", "7", "--resize", "area", "--upsampler", "lanczos", "--background", "white", "--time-budget-s", "60",
               "--farthest", "1"]  # fmt: skip
    code, out, _ = run("adapt", model_folder, "--scale", "1/2", "--output", tmp_path / "a.ply", "--json", *options, *QUICK)
    assert code == 0
    settings = json.loads(out)[0]["settings"]
    assert {name: settings[name] for name in ("recipe", "seed", "resize", "upsampler", "time_budget_s", "steps", "views", "farthest")} == {
        "recipe": "paper", "seed": 7, "resize": "area", "upsampler": "lanczos", "time_budget_s": 60, "steps": 2, "views": "given", "farthest": 1,
    }  # fmt: skip


def test_the_same_scale_twice_is_one_scale(run, model_folder, tmp_path):
    code, out, _ = run("adapt", model_folder, "--scale", "4", "--scale", "4/1", "--output", tmp_path / "a.ply", *NO_STEP)
    assert code == 0 and out.count("x4:") == 1


def test_an_output_that_exists_needs_overwrite_and_is_refused_before_any_work(run, tmp_path, monkeypatch):
    base = tiny.ply(tmp_path / "base.ply")
    (tmp_path / "base_x4.ply").write_text("precious")
    with monkeypatch.context() as first:
        first.setattr(Wrapped, "adapt", lambda *_, **__: pytest.fail("worked in vain"))
        refused(run("adapt", base, "--scale", "2", "--scale", "4"), "base_x4.ply exists already; pass --overwrite")
    assert (tmp_path / "base_x4.ply").read_text() == "precious" and not (tmp_path / "base_x2.ply").exists()
    assert run("adapt", base, "--scale", "4", "--overwrite", *NO_STEP)[0] == 0
    assert len(load_model(tmp_path / "base_x4.ply")) == 60


def test_ctrl_c_ends_with_130_and_the_same_command_goes_on(run, model_folder, tmp_path, monkeypatch):
    command = ["adapt", model_folder, "--scale", "1/4", *QUICK]
    run(*command, "--output", tmp_path / "whole.ply")
    pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))(1)
    code, out, err = run(*command, "--output", tmp_path / "new.ply")
    assert (code, out) == (130, "")
    assert "interrupted at step 1; run the same command again to continue from" in err and "Traceback" not in err
    assert (tmp_path / "new.ply.resume").exists() and not (tmp_path / "new.ply").exists()
    assert run(*command, "--output", tmp_path / "new.ply")[0] == 0
    assert (tmp_path / "new.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert not (tmp_path / "new.ply.resume").exists()


def test_ctrl_c_between_two_files_and_the_same_command_goes_on(run, model_folder, tmp_path, monkeypatch):
    """What is finished is not made again; the page says of it what it can."""
    command = ["adapt", model_folder, "--scale", "1/4", "--scale", "1/2", *QUICK]
    whole = json.loads(run(*command, "--output", tmp_path / "whole", "--json")[1])
    pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))(3)
    command += ["--output", tmp_path / "new", "--report"]
    code, _, err = run(*command)
    assert code == 130 and "run the same command again to continue from" in err
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["base_x0.25", "base_x0.5.resume"]
    code, out, err = run(*command, "--json")
    again = json.loads(out)
    assert (code, err) == (0, "") and [report["scale"] for report in again] == [0.25, 0.5]
    assert [Path(report["file"]).relative_to(tmp_path / "new") for report in again] == [
        Path(report["file"]).relative_to(tmp_path / "whole") for report in whole
    ]
    assert [splats_of(report) for report in again] == [splats_of(report) for report in whole]
    record = record_of(tmp_path / "new" / "base_adapted.report.html")
    assert [report["title"] for report in record["adaptations"]] == ["×1/4", "×1/2"] and [zoom["label"] for zoom in record["zooms"]] == ["×1/2"]
    assert record["notes"][0] == "×1/4: an earlier command made it, and its pictures are not drawn again"


def test_a_page_of_files_that_are_finished_stays(run, model_folder, tmp_path):
    """Its being there was an error, and nothing was printed of the files."""
    command = ["adapt", model_folder, "--scale", "1/4", "--scale", "1/2", "--output", tmp_path / "out", "--report", *NO_STEP]
    made, again = run(*command), run(*command)
    page = tmp_path / "out" / "base_adapted.report.html"
    assert made[0] == again[0] == 0 and again[1].count("finished before\n") == 2 and again[1].endswith(f"page: {page}, of an earlier command\n")
    (tmp_path / "out" / "base_x0.5").rename(tmp_path / "elsewhere")
    code, _, told = run(*command)
    assert code == 2 and f"{page} exists already" in told


def test_adapt_to_the_bases_own_scale_gives_the_base(run, model_folder, tmp_path):
    code, out, err = run("adapt", model_folder, "--scale", "1", "--output", tmp_path / "same.ply", "--report")
    assert (code, err) == (0, "") and out.startswith("x1: holds the base as it is, 60 -> 60 splats, 0.0 s\n")
    assert read_ply(tmp_path / "same.ply").columns["x"].shape == (60,)


def test_ctrl_c_anywhere_else_says_interrupted(run, model_folder, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.models.load_model", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    code, _, err = run("inspect", model_folder)
    assert code == 130 and err.strip() == "mipmap-plugin: interrupted"


@pytest.mark.parametrize("more", [(), ("--tiles", "2")])
def test_a_page_goes_with_the_file_that_it_shows(run, model_folder, tmp_path, more):
    words = ["adapt", model_folder, "--scale", "1/2", "--output", tmp_path / "a.ply", "--recipe", "instant"]
    run(*words, "--report")
    assert (tmp_path / "a.ply.report.html").exists()
    assert run(*words, *more, "--overwrite")[0] == 0
    assert (tmp_path / "a.ply").exists() and not (tmp_path / "a.ply.report.html").exists()


@pytest.mark.parametrize("error", [OutputError("the disk is full"), KeyboardInterrupt()])
def test_a_file_is_kept_whose_page_fails(run, model_folder, tmp_path, monkeypatch, error):
    monkeypatch.setattr("mipmap_plugin.pages.html.write_page", Mock(side_effect=error))
    code, _, told = run("adapt", model_folder, "--scale", "1/2", "--output", tmp_path / "a.ply", "--recipe", "instant", "--report")
    assert code == (130 if isinstance(error, KeyboardInterrupt) else 2) and (str(error) or "interrupted") in told
    assert (tmp_path / "a.ply").exists() and not (tmp_path / "a.ply.report.html").exists()
