"""Without cameras a base and what is adapted from it are looked at from the same places."""

from __future__ import annotations

import json
from functools import partial

import pytest
import tiny
import torch
from torch_checkpoints import gsplat_folder, splatfacto_folder, splats

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation import views
from mipmap_plugin.cli import main
from mipmap_plugin.models import load_model
from mipmap_plugin.models.adapted_scale import adapted_orbit

SCALE = 0.125


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    monkeypatch.setattr(views, "ORBIT_PIXELS", 16)


def poses(path) -> torch.Tensor:
    return torch.stack([view.viewmat for view in wrap_model(path, backend="reference").views()])


@pytest.fixture
def files(tmp_path):
    """A base, and a file that was adapted from it, whose splats have other means."""
    base = tiny.ply(tmp_path / "base.ply")
    adapted = wrap_model(base, backend="reference").adapt(SCALE, recipe="instant", extra_views=4)
    with torch.no_grad():
        adapted.model.parameters()["means"].add_(0.01)
    return base, adapted.save(tmp_path / "adapted.ply")


@pytest.mark.parametrize("kept", ["both", "report", "header"])
def test_an_adapted_file_is_seen_from_where_its_base_is(files, kept):
    base, adapted = files
    if kept == "header":
        adapted.with_name(adapted.name + ".adaptation.json").unlink()
    elif kept == "report":
        adapted.write_bytes(adapted.read_bytes().replace(b"comment mipmap_plugin {", b"comment another_plugin {"))
    assert torch.equal(poses(adapted), poses(base))


def test_and_so_is_what_is_adapted_from_it_again(files, tmp_path):
    base, _ = files
    fewer = {"recipe": "instant", "most_splats": 20, "extra_views": 4}
    first = wrap_model(base, backend="reference").adapt(1.0, viewer="classic", **fewer).save(tmp_path / "first.ply")
    second = wrap_model(first, backend="reference").adapt(SCALE, recipe="instant", extra_views=4).save(tmp_path / "second.ply")
    assert torch.equal(poses(second), poses(base))


@pytest.mark.filterwarnings("ignore:no cameras")
def test_and_so_is_what_is_adapted_in_tiles(files, tmp_path):
    base, _ = files
    first = wrap_model(base, backend="reference").adapt(1.0, viewer="classic", recipe="instant", most_splats=20, extra_views=4)
    first.save(tmp_path / "first.ply")
    words = ["--scale", "1/4", "--recipe", "instant", "--backend", "reference", "--tiles", "2"]
    for path in (base, tmp_path / "first.ply"):
        assert main(["adapt", str(path), "--output", str(tmp_path / "tiled.ply"), "--overwrite", *words]) == 0
        assert torch.equal(poses(tmp_path / "tiled.ply"), poses(base))


@pytest.mark.parametrize("orbit", [None, 3, {}, {"center": [1, 2], "up": [0.0, 0.0, 1.0], "distance": 1.0}])
def test_a_report_without_an_orbit_is_taken_as_one_of_before(files, orbit):
    _, adapted = files
    adapted.write_bytes(adapted.read_bytes().replace(b"comment mipmap_plugin {", b"comment another_plugin {"))
    report = adapted.with_name(adapted.name + ".adaptation.json")
    report.write_text(json.dumps(json.loads(report.read_text()) | {"orbit": orbit}))
    assert adapted_orbit(adapted) is None and len(poses(adapted)) > 1


@pytest.mark.parametrize(("comment", "up"), [("Vertical Axis: z", (0.0, 0.0, 1.0)), ("Vertical axis: y", None)], ids=["nerfstudio", "Brush"])
def test_a_header_tells_the_vertical_but_for_what_a_program_writes_into_every_file(tmp_path, comment, up):
    base = tiny.ply(tmp_path / "base.ply")
    base.write_bytes(base.read_bytes().replace(b"element vertex", f"comment {comment}\nelement vertex".encode(), 1))
    assert views.orbit_of(wrap_model(base, backend="reference").model).up == up


@pytest.mark.parametrize(
    ("make", "up"),
    [(splatfacto_folder, (0.0, 0.0, 1.0)), (gsplat_folder, (0.0, 0.0, 1.0)), (partial(gsplat_folder, normalized="false"), None)],
    ids=["nerfstudio", "gsplat", "gsplat, as COLMAP has it"],
)
def test_a_project_that_turns_its_scenes_tells_the_vertical(tmp_path, make, up):
    assert views.orbit_of(load_model(make(tmp_path / "r", splats()))).up == up
