"""Which outputs count as finished, and which belong to another request."""

from dataclasses import replace
from unittest.mock import Mock

import moving
import pytest
import tiny
from small_jobs import job_of

from mipmap_plugin.adaptation.views.for_validation import MIN_VIEWS
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.finished import finished
from mipmap_plugin.jobs.run import run as run_job
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped


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


@pytest.mark.parametrize(("scale", "cameras", "fits", "other"), [
    (1 / 2, True, "pil-bicubic", "area"),
    (1 / 16, True, "area", "pil-bicubic"),  # 2 px
    (1 / 16, False, "area", "pil-bicubic"),
    (2.0, True, "pil-bicubic", "lanczos"),
])  # fmt: skip
def test_only_a_filter_that_fits_is_finished(tmp_path, scale, cameras, fits, other):
    job = job_of(tmp_path, recipe="default", scale=scale, overwrite=True)
    job = job if cameras else replace(job, base=replace(job.base, cameras=None))
    for resize in (fits, other):
        assert run_job(replace(job, settings=job.settings | {"resize": resize})).status == "done"
        assert (finished(job) is not None) == (resize == fits)


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


def test_what_is_finished_is_found_without_a_look_at_photographs(tmp_path, monkeypatch):
    scene = tiny.scene(tmp_path / "scene", train=tiny.cameras(3))
    job = job_of(tmp_path, base=Base(tiny.ply(tmp_path / "base.ply"), scene))
    assert run_job(job).status == "done"
    tiny.ply(tmp_path / "other.ply", seed=1).replace(tmp_path / "base.ply")
    monkeypatch.setattr("mipmap_plugin.wrap.doubt_about", None)
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


def test_another_network_of_that_name_is_not_finished(tmp_path):
    network = tmp_path / "net.pth"
    network.write_bytes(b"one")
    job = job_of(tmp_path, scale=2.0, settings={"steps": 0, "seed": 0, "views": "given", "upsampler": str(network)})
    assert run_job(job).status == "done" and finished(job) is not None
    network.write_bytes(b"other")
    assert finished(job) is None


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


@pytest.mark.parametrize("text", ["{", "[" * 50_000], ids=["cut off", "nested too deep"])
def test_a_damaged_report_is_not_finished(tmp_path, text):
    job = job_of(tmp_path)
    run_job(job)
    (tmp_path / "out.ply.adaptation.json").write_text(text)
    assert finished(job) is None


def test_a_file_for_several_viewers_is_recognized(tmp_path):
    """Whose settings are not quite the recipe's."""
    job = job_of(tmp_path, viewer="portable", settings={"steps": 0, "views": "given"})
    assert run_job(job).status == "done"
    assert finished(job) is not None


def test_splats_that_are_not_merged_are_recognized(tmp_path):
    job = job_of(tmp_path)
    job = replace(job, base=replace(job.base, checkpoint=moving.write_deformable(tmp_path / "moving")), target=tmp_path / "out")
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
    monkeypatch.setattr(Wrapped, "adapt", Mock(side_effect=MemoryError))
    assert run_job(job_of(tmp_path)).reason.startswith("out of memory; use a smaller scale")
