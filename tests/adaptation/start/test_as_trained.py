"""Bases that were trained with compensation: what is made of them without a viewer, and what is told where their own renderer shows them better."""

from dataclasses import replace

import mip_checkpoints
import ply_files
import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.optimization.validation import Quality, mean_db
from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.candidates import Candidates
from mipmap_plugin.adaptation.start.clock import start_clock
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.search import StartSearch
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.effects import Effects
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale, Traits
from mipmap_plugin.models.inria_folder import ANTIALIASING

TOLD = "drawn as its training drew it"


def wrapped(screen_filter: str, eps2d: float, count: int = 60):
    trained = TrainedScale(screen_filter, eps2d)
    return wrap_model(tiny.model(count, trained), cameras=tiny.cameras())


@pytest.mark.parametrize("scale", [1 / 8, 4])
def test_the_closed_form_helps_in_the_bases_own_renderer_too(scale):
    base = wrapped("antialiased", 0.3)
    adapted = base.adapt(scale, recipe="instant")
    assert adapted.report.returned.startswith("the start, the closed form")
    assert adapted.report.psnr_after() > adapted.report.psnr_before() + 0.5
    for view in tiny.cameras(2, seed=9):  # that nothing was adapted to
        own, small = base.render(view).image.clamp(0, 1), view.zoomed(scale)
        size = min(own.shape[:2], small.size)
        truth, new, old = (resize(image, size, "area") for image in (own, adapted.render(small).image, base.render(small).image))
        assert psnr(new, truth) > psnr(old, truth)


@pytest.mark.parametrize(("formed_db", "steps", "forms"), [(31.0, 0, True), (29.0, 0, False), (31.0, 9, True), (29.0, 9, False)])
def test_merged_splats_keep_their_shapes_where_the_filter_alone_is_better(monkeypatch, formed_db, steps, forms):
    """The base as it is has 30 dB."""
    reshaped = []

    class Splats:
        traits = Traits()

        def parameters(self):
            return {"means": torch.zeros(100, 3)}

        def reshape(self, form, views):
            reshaped.append(self)

    base, antialiased = wrapped("antialiased", 0.3), Effects(0, "antialiased")
    config = base.adapt(1 / 4, recipe="instant").report.settings.model_copy(update={"merge_to": 0.5, "steps": steps})
    problem = StartProblem(
        Splats, base.cameras, base.cameras, 1 / 4, antialiased, antialiased, config, ReferenceBackend(), False,
        lambda model: Quality(*[30.0 if model not in reshaped else formed_db] * 2), lambda _: torch.no_grad(),
    )  # fmt: skip
    monkeypatch.setattr(BaseWeights, "measured", lambda *_: torch.ones(100))
    monkeypatch.setattr(Candidates, "merge", lambda *_: torch.ones(50))
    best, name = StartSearch(problem, start_clock(problem)).best()
    assert (best in reshaped) == forms and name == ("the closed form of merged splats" if forms else "merged splats")


def test_a_base_that_its_own_renderer_shows_better_is_told_of():
    base = wrapped("mip", 0.1)
    with pytest.warns(UserWarning, match=TOLD):
        adapted = base.adapt(0.9, viewer="antimatter15", recipe="instant", returns="last", closed_form=False)
    report = adapted.report
    assert report.as_trained > report.psnr_after()
    [note] = [note for note in report.notes if TOLD in note]
    assert f"(mip 0.1 px²), the base itself has {report.as_trained:.2f} dB" in note and f"this file's {report.psnr_after():.2f}" in note


def test_what_the_base_has_in_its_own_renderer_is_measured_on_the_same_views():
    base = wrapped("antialiased", 0.3)
    adapted = base.adapt(1 / 2, viewer="classic", recipe="instant", validation_views=4)
    chosen = adapted.adapted_to[-2:]
    backend, splats = ReferenceBackend(), base.model.gaussians()
    exact = replace(splats, **{name: value.double() for name, value in vars(splats).items() if isinstance(value, torch.Tensor)})
    errors = []
    for view in chosen:
        whole, small = (backend.render(exact, camera, base.effects()).image.clamp(0, 1) for camera in (view, view.zoomed(1 / 2)))
        errors.append(float((resize(whole, small.shape[:2], "pil-bicubic").clamp(0, 1) - small).square().mean()))
    assert adapted.report.as_trained == pytest.approx(mean_db(errors), abs=1e-3)


@pytest.mark.parametrize(("scale", "viewer"), [(1.0, "classic"), (1 / 2, None), (1 / 2, "antialiased")])
def test_where_there_is_nothing_to_tell(scale, viewer):
    adapted = wrapped("antialiased", 0.3).adapt(scale, viewer=viewer, recipe="instant")
    assert adapted.report.as_trained is None


@pytest.mark.parametrize("name", ["mip", "gof", "analytic"])
def test_the_notes_of_a_filtered_file_do_not_call_it_classic_and_its_filter_a_stray_column(tmp_path, name):
    folder = mip_checkpoints.folder(tmp_path / "model", name)
    (folder / "cfg_args").write_text((folder / "cfg_args").read_text().replace("resolution=1", "resolution=1, train_test_exp=False"))
    saved = wrap_model(folder, cameras=tiny.cameras()).adapt(1 / 2, recipe="instant").save(tmp_path / "small")
    for path in (folder, saved):
        notes = " ".join(load_model(path).notes)
        assert "carried along" not in notes and "classic" not in notes and "header" not in notes


@pytest.mark.parametrize(("screen_filter", "asked"), [([], True), (["--screen-filter", "antialiased"], False)])
def test_inspect_asks_for_the_filter_until_it_is_told(tmp_path, capsys, screen_filter, asked):
    folder = tiny.folder(tmp_path / "base")
    ply_files.write(next(folder.rglob("point_cloud.ply")), ply_files.splat_columns(5))  # without a tag, as 3DGS writes it
    (folder / "cfg_args").write_text("Namespace(sh_degree=3, train_test_exp=False)")
    assert main(["inspect", str(folder), "--no-viewers", *screen_filter]) == 0
    told = capsys.readouterr().out
    assert (ANTIALIASING in told) == asked
    assert ("--scale 1/4 --screen-filter antialiased" in told) == (not asked)


def test_the_command_names_the_filter_that_the_file_is_for(tmp_path, capsys):
    folder = tiny.folder(tmp_path / "base", trained=TrainedScale("antialiased"))
    assert main(["adapt", str(folder), "--scale", "1/2", "--recipe", "instant"]) == 0
    assert "made for renderers that draw as its training did (antialiased, 0.3 px²)" in capsys.readouterr().out
