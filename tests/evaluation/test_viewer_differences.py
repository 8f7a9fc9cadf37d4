"""The line of `inspect` on how viewers render a checkpoint."""

import re
from statistics import fmean

import moving
import pytest
import tiny
import torch_checkpoints

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation import viewer_differences as module
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.viewer_differences import viewer_differences
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.wrap import Wrapped


def loaded(tmp_path, **options) -> Wrapped:
    pytest.importorskip("numba")
    return wrap_model(tiny.folder(tmp_path / "model", tiny.cameras(6), **options))


def decibels(sentence: str) -> dict[str, float]:
    return {name: float(number) for name, number in re.findall(r"(\S+) ([\d.]+) dB", sentence)}


def test_the_difference_of_a_viewer_is_that_of_its_images(tmp_path):
    model = loaded(tmp_path)
    views = [model.cameras[nth] for nth in (0, 2, 4)]
    differences = decibels(viewer_differences(model))
    assert list(differences) == ["spark", "playcanvas", "gaussian-splats-3d", "antialiased"]  # classic is the same
    for viewer, number in differences.items():
        assert number == pytest.approx(fmean(psnr(model.render(v, viewer=viewer).image, model.render(v).image) for v in views), abs=0.051)


def test_what_was_trained_with_compensation_looks_wrong_in_a_classic_viewer(tmp_path):
    model = loaded(tmp_path, trained=TrainedScale("antialiased"))
    line = viewer_differences(model)
    assert "antialiased the same" in line and decibels(line)["classic"] < decibels(line)["spark"]


def test_an_adapted_file_is_drawn_at_its_own_scale(tmp_path):
    """At x1, where it never looks right, how viewers draw it is of no use."""
    adapted = loaded(tmp_path).adapt(1 / 2, recipe="instant").save(tmp_path / "adapted.ply")
    assert viewer_differences(wrap_model(adapted, cameras=tmp_path / "model/cameras.json")).endswith("at x0.5 in 3 views")


def test_fewer_views_are_drawn_of_more_splats_and_none_of_too_many(tmp_path, monkeypatch):
    model = loaded(tmp_path)
    monkeypatch.setattr(module, "SPLATS", 119)
    assert viewer_differences(model).endswith("at x1 in 1 view")
    monkeypatch.setattr(module, "SPLATS", 59)
    monkeypatch.setattr(model, "render", None)  # nothing is drawn
    assert viewer_differences(model).startswith("not drawn: 60 splats on 768 pixels take too long")


def test_of_a_model_that_no_viewer_draws_no_splats_are_made(tmp_path, monkeypatch):
    """By a network, which takes long."""
    model = wrap_model(moving.write_deformable(tmp_path / "model"))
    monkeypatch.setattr(type(model.model), "gaussians", None)
    assert viewer_differences(model) == "not drawn: a network moves its splats, which none of the viewers supports"


def test_a_slow_backend_draws_nothing(tmp_path):
    model = wrap_model(tiny.folder(tmp_path / "model"), backend="reference")
    assert viewer_differences(model).startswith("not drawn: only the reference backend can, which takes too long")


def test_where_training_drew_what_only_a_slow_backend_draws_nothing_is_drawn(tmp_path, monkeypatch):
    model = loaded(tmp_path)
    own = wrap_model(model.model, backend="reference").backend()
    chosen = model.backend
    monkeypatch.setattr(model, "backend", lambda *, viewer=None, **options: chosen(viewer=viewer, **options) if viewer else own)
    assert viewer_differences(model).startswith("not drawn")


def test_a_file_of_another_project_is_not_rendered_and_the_note_says_what_to_do(tmp_path):
    model = wrap_model(torch_checkpoints.gsplat_folder(tmp_path / "run", torch_checkpoints.splats()), cameras=tiny.cameras(1))
    assert viewer_differences(model).startswith("not drawn: its own project alone opens such a file; `mipmap-plugin adapt --scale 1 --viewer NAME")
