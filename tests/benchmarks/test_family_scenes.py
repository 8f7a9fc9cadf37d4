"""The scenes that the families' table is measured on are what its caption says."""


import pytest
import torch
from families import Change, Quality, Row, table
from family_scenes import FAMILIES, Pictures, views

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.models import load_model


@pytest.mark.parametrize("family", FAMILIES)
def test_each_is_written_in_its_own_format(tmp_path, family):
    FAMILIES[family].write(tmp_path / "world")
    model = load_model(tmp_path / "world")
    assert model.family == family.split("-")[0]
    assert len(model) >= 100


@pytest.mark.parametrize("family", ["deformable", "octree"])
def test_true_pictures_are_means_of_the_finest_ones(tmp_path, family):
    FAMILIES[family].write(tmp_path / "world")
    pictures, view = Pictures(load_model(tmp_path / "world")), views(3, "train", moves=FAMILIES[family].moves)[1]
    assert pictures(view, 4).shape == (192, 256, 3)
    torch.testing.assert_close(pictures(view), resize(pictures(view, 4), view.size, "box"))
    torch.testing.assert_close(pictures(view, 1 / 4), resize(pictures(view), (12, 16), "pil-bicubic").clamp(0, 1))


def test_views_are_held_out_and_times_spread():
    train, test = views(12, "train", moves=True), views(6, "test", moves=True)
    assert sorted(view.time for view in train) == pytest.approx([number / 11 for number in range(12)])
    assert len({view.time for view in test}) == 6
    assert min(float((one.center - other.center).norm()) for one in train for other in test) > 0.05


def test_the_table_has_no_empty_cell():
    change = Change(Quality(10.0, 9.0), Quality(20.0, 19.5), None)
    seconds = {"load": 0.01, "render": 0.002, "adapt": 2.25, "save": 0.02, "evaluate": 1.0}
    lines = table([Row("A", "none", Quality(30.0, 29.0), seconds, {"×1/4": change, "×4": change})]).splitlines()
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == [
        "A", "10 ms", "2 ms", "2.2 s", "20 ms", "1.0 s", *["10.0 → 20.0 · 9.0 → 19.5"] * 2, "none",
    ]  # fmt: skip
