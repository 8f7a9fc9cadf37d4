"""Scaffold-GS is saved so that the original reads it."""

import anchor_checkpoints as checkpoints
import pytest
import torch
from anchor_models import LAYOUTS, assert_saved, is_same, load, state_of

from mipmap_plugin.errors import OutputExists, SettingsError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import load_model

pytestmark = pytest.mark.usefixtures("few_views")


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_round_trip_repeats_the_rows_and_the_networks_byte_for_byte(tmp_path, name):
    assert_saved(tmp_path, LAYOUTS[name])


def test_the_original_reader_finds_its_columns(folder, tmp_path):
    """scene/gaussian_model.py reads by name and by count, and the viewer by order."""
    ply = read_ply(load_model(folder).save(tmp_path / "a" / "point_cloud.ply", provenance={}))
    wanted = ["x", "y", "z", "nx", "ny", "nz", *(f"f_offset_{i}" for i in range(9)), *(f"f_anchor_feat_{i}" for i in range(8)), "opacity"]
    assert list(ply.columns) == [*wanted, *(f"scale_{i}" for i in range(6)), *(f"rot_{i}" for i in range(4))]
    assert {column.dtype.str for column in ply.columns.values()} == {"<f4"}


@pytest.mark.parametrize("name", ["feature bank", "distance of colors, appearance"])
def test_networks_that_moved_are_written_as_the_original_reads_them(tmp_path, name):
    layout = LAYOUTS[name]
    student = load(tmp_path, layout).copy()
    with torch.no_grad():
        for held in student.shared_parameters().values():
            held.mul_(1.25)
    place = student.save(tmp_path / "moved" / "point_cloud.ply", provenance={}).parent
    assert is_same(state_of(student), state_of(load_model(place / "point_cloud.ply")))
    state = {key: torch.from_numpy(held) * 1.25 for key, held in checkpoints.weights(layout)["opacity_mlp"].items()}
    values = torch.rand(4, layout.inputs("opacity_mlp"))
    if layout.united:
        network = torch.nn.Sequential(torch.nn.Linear(*state["0.weight"].T.shape), torch.nn.ReLU(), torch.nn.Linear(8, 3), torch.nn.Tanh())
        network.load_state_dict(torch.load(place / "checkpoints.pth", weights_only=True)["opacity_mlp"])
    else:
        network = torch.jit.load(place / "opacity_mlp.pt")
        assert torch.jit.load(place / "embedding_appearance.pt")(torch.tensor([4])).shape == (1, 4)
    hidden = (values @ state["0.weight"].T + state["0.bias"]).relu()
    torch.testing.assert_close(network(values), (hidden @ state["2.weight"].T + state["2.bias"]).tanh())


def test_networks_that_moved_are_the_same_bytes_whatever_was_traced_before_and_name_no_path(folder, tmp_path):
    student = load_model(folder).copy()
    with torch.no_grad():
        student.shared_parameters()["opacity_mlp.0.bias"].add_(1)
    student.save(tmp_path / "b" / "a.ply", provenance={})
    first = (tmp_path / "b" / "opacity_mlp.pt").read_bytes()
    torch.jit.trace(torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Tanh()), torch.zeros(1, 2))
    student.save(tmp_path / "b" / "b.ply", provenance={})  # which the same networks serve
    student.save(tmp_path / "c" / "a.ply", provenance={})
    assert (tmp_path / "c" / "opacity_mlp.pt").read_bytes() == first
    assert b"site-packages" not in first and b".py(" not in first


def test_a_folder_without_cfg_args_gets_what_the_original_asks_for(tmp_path):
    load(tmp_path, LAYOUTS["distance of colors, appearance"], cfg=False).save(tmp_path / "saved", provenance={})
    text = (tmp_path / "saved/cfg_args").read_text()
    options = "feat_dim=8", "n_offsets=3", "appearance_dim=4", "add_color_dist=True", "add_cov_dist=False", "use_feat_bank=False", "voxel_size=0.001"
    for option in (*options, "eval=None"):
        assert option in text


def test_other_anchors_networks_are_never_replaced_unasked(folder, tmp_path):
    model = load_model(folder)
    student = model.copy()
    with torch.no_grad():
        student.shared_parameters()["opacity_mlp.0.bias"].add_(1)
    student.save(tmp_path / "b" / "a.ply", provenance={})
    model.save(tmp_path / "c" / "a.ply", provenance={})
    model.save(tmp_path / "c" / "b.ply", provenance={})  # the same networks may serve two
    with pytest.raises(OutputExists, match=r"holds other networks \(opacity_mlp.pt\)"):
        model.save(tmp_path / "b" / "b.ply", provenance={})
    with pytest.raises(OutputExists, match="holds other networks"):
        student.save(model.source.with_name("adapted.ply"), provenance={}, overwrite=True)
    assert is_same(state_of(load_model(folder)), state_of(model))
    model.save(tmp_path / "b" / "a.ply", provenance={}, overwrite=True)
    assert is_same(state_of(load_model(tmp_path / "b" / "a.ply")), state_of(model))


def test_a_file_that_is_called_compressed_is_not_written_uncompressed(folder, tmp_path):
    with pytest.raises(SettingsError, match=r"is not written as compressed PLY; give a \.ply"):
        load_model(folder).save(tmp_path / "a.compressed.ply", provenance={})
    assert not (tmp_path / "a.compressed.ply").exists()
