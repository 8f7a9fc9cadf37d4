"""What an adapted model writes, and what it never replaces."""

import hashlib
import json

import pytest
import tiny
import torch
from brief_runs import BRIEF, wrapped

from mipmap_plugin.errors import OutputExists
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of, render_mode
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.wrap import wrap_model


def test_saving_writes_the_splats_the_tag_the_provenance_and_the_report(tmp_path):
    adapted = wrap_model(tiny.ply(tmp_path / "base.ply"), cameras=tiny.cameras()).adapt(1 / 4, **BRIEF)
    saved = adapted.save(tmp_path / "new.ply")
    comments = read_ply(saved).comments
    assert saved == tmp_path / "new.ply" and "SplatRenderMode: default" in comments and render_mode(comments) == "classic"
    provenance = provenance_of(comments)
    assert (provenance["scale"], provenance["base"]) == (0.25, hashlib.sha256((tmp_path / "base.ply").read_bytes()).hexdigest())
    assert provenance["settings"]["steps"] == 7 and "seconds" not in json.dumps(provenance)
    sidecar = json.loads((tmp_path / "new.ply.adaptation.json").read_text())
    assert sidecar == json.loads(json.dumps(adapted.report.model_dump()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["base.ply", "new.ply", "new.ply.adaptation.json"]


def test_any_classic_viewer_shows_the_file_as_the_adapted_model_shows_itself(tmp_path):
    model = wrap_model(tiny.model(40, TrainedScale(screen_filter="antialiased")), cameras=tiny.cameras())
    adapted = model.adapt(1 / 4, viewer="classic", **BRIEF)
    loaded = wrap_model(adapted.save(tmp_path / "new.ply"))
    small = tiny.cameras()[0].zoomed(1 / 4)
    torch.testing.assert_close(loaded.render(small, screen_filter="classic").image, adapted.render(small).image, atol=1e-5, rtol=0)


def test_a_model_folder_becomes_a_model_folder(tmp_path):
    saved = wrap_model(tiny.folder(tmp_path / "base")).adapt(4, recipe="instant").save(tmp_path / "new")
    assert saved == tmp_path / "new/point_cloud/iteration_30000/point_cloud.ply"
    assert saved.with_name("point_cloud.ply.adaptation.json").is_file()
    assert len(wrap_model(tmp_path / "new").cameras) == 4


@pytest.mark.parametrize("name", ["new.ply", "new.ply.adaptation.json"])
def test_an_output_that_exists_is_not_overwritten_unless_asked(tmp_path, name):
    adapted = wrapped().adapt(4, recipe="instant")
    (tmp_path / name).write_text("precious")
    with pytest.raises(OutputExists, match=f"{name} exists already; pass --overwrite"):
        adapted.save(tmp_path / "new.ply")
    assert [file.name for file in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "precious"
    adapted.save(tmp_path / "new.ply", overwrite=True)
    assert len(load_model(tmp_path / "new.ply")) == 40 and json.loads((tmp_path / "new.ply.adaptation.json").read_text())["scale"] == 4


def test_a_base_that_is_gone_from_the_disk_is_adapted_all_the_same(tmp_path):
    base = wrap_model(tiny.ply(tmp_path / "a.ply"), cameras=tiny.cameras())
    (tmp_path / "a.ply").unlink()
    assert base.adapt(0.5, steps=0).report.ended_by == "0 steps"
