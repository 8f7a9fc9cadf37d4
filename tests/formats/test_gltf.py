"""Splats in glTF are those of a PLY, turned from y up; what is not read is said in a sentence."""

import base64
import json
from dataclasses import replace

import gltf_files
import numpy as np
import pytest
import tiny
import torch
from exchange_files import sentence
from gltf_files import EXTENSION

from mipmap_plugin.cli import main
from mipmap_plugin.errors import OutputError, OutputExists, SettingsError
from mipmap_plugin.formats import glb
from mipmap_plugin.formats.gltf import read_gltf
from mipmap_plugin.formats.readers import refuse_unread
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.adapted_name import adapted_name
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.splatting.harmonics import basis, rotated
from mipmap_plugin.splatting.projection import axes_of

HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))  # from y up to a PLY's frame, about z
# A rotation by 120 degrees about (1, 1, 1), x -> y -> z -> x, as a quaternion xyzw.
CYCLE, CYCLED = [0.5, 0.5, 0.5, 0.5], torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def load(tmp_path, made, data):
    """The splats of a document that is written as a GLB."""
    return load_model(gltf_files.write_glb(tmp_path / "a.glb", made, data)).gaussians()


def covariances(splats):
    axes = axes_of(splats.quats, splats.scales)
    return axes @ axes.transpose(1, 2)


def towards(splats, directions):
    """The colors [N, D, 3] of splats towards directions [D, 3]."""
    return basis(directions, splats.sh_degree) @ splats.sh


def assert_moved(read, splats, turn, size=1.0, shift=(0.0, 0.0, 0.0)):
    """`read` are `splats`, turned, scaled and moved, and look towards R d as they looked towards d."""
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    torch.testing.assert_close(read.means, size * splats.means @ turn.T + torch.tensor(shift), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(covariances(read), size**2 * turn @ covariances(splats) @ turn.T, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(read.opacities, splats.opacities, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(towards(read, directions @ turn.T), towards(splats, directions), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_are_turned_to_the_frame_of_a_ply(tmp_path, degree):
    splats = tiny.gaussians(degree=degree)
    model = load_model(gltf_files.glb(tmp_path / "a.glb", splats))
    assert (model.sh_degree, model.source, len(model.digest)) == (degree, tmp_path / "a.glb", 64)
    assert_moved(model.gaussians(), splats, HALF_TURN)


def test_half_a_turn_changes_the_signs_of_harmonics_and_not_a_digit():
    sh = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(0))
    sh[:, 9:] = 0
    turned = rotated(sh, HALF_TURN)
    assert torch.equal(turned.abs(), sh.abs()) and torch.equal(rotated(turned, HALF_TURN), sh)


def test_nodes_turn_scale_and_move_splats(tmp_path):
    """A node that turns and scales lies in one that moves, given as a matrix, column by column."""
    splats = tiny.gaussians(degree=3)
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    nodes = [{"matrix": matrix.T.flatten().tolist(), "children": [1]}, {"mesh": 0, "rotation": CYCLE, "scale": [2, 2, 2]}]
    read = load(tmp_path, *gltf_files.document(gltf_files.attributes(splats), nodes=nodes))
    assert_moved(read, splats, HALF_TURN @ CYCLED, 2.0, (-1.0, -2.0, 3.0))


def test_primitives_are_joined_and_other_meshes_left_out(tmp_path):
    parts = tiny.gaussians(10, degree=1), tiny.gaussians(20, degree=0, seed=1)
    made, data = gltf_files.document(*map(gltf_files.attributes, parts))
    made["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}}]})
    made["nodes"].append({"mesh": 2})
    made["scenes"][0]["nodes"].append(2)
    read = load(tmp_path, made, data)
    assert len(read) == 30 and read.sh_degree == 1 and not read.sh[10:, 1:].any()
    torch.testing.assert_close(read.sh[10:, 0], parts[1].sh[:, 0])


def test_whole_numbers_are_fractions_of_the_largest(tmp_path):
    splats = tiny.gaussians()
    named = gltf_files.attributes(splats)
    for name, kind in {"ROTATION": "<i2", "SCALE": "<u2", "OPACITY": "<u1"}.items():
        named[f"{EXTENSION}:{name}"] = (named[f"{EXTENSION}:{name}"] * np.iinfo(kind).max).round().astype(kind)
    read = load(tmp_path, *gltf_files.document(named))
    turned = HALF_TURN @ covariances(splats) @ HALF_TURN
    torch.testing.assert_close(covariances(read), turned, atol=1e-4, rtol=0)
    torch.testing.assert_close(read.opacities, splats.opacities, atol=1 / 500, rtol=0)


def test_rows_may_lie_apart(tmp_path):
    """Positions and sizes, row by row, as files of meshes keep them."""
    splats = tiny.gaussians()
    made, data = gltf_files.document(gltf_files.attributes(splats))
    rows = np.concatenate([splats.means.numpy(), splats.scales.numpy()], axis=1)
    names = made["meshes"][0]["primitives"][0]["attributes"]
    made["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": rows.nbytes, "byteStride": 24})
    for name, offset in {"POSITION": 0, f"{EXTENSION}:SCALE": 12}.items():
        made["accessors"][names[name]] |= {"bufferView": len(made["bufferViews"]) - 1, "byteOffset": offset}
    assert_moved(load(tmp_path, made, data + rows.tobytes()), splats, HALF_TURN)


@pytest.mark.parametrize("inside", [True, False])
def test_as_json_its_bytes_lie_beside_it_or_inside(tmp_path, inside):
    splats = tiny.gaussians()
    made, data = gltf_files.document(gltf_files.attributes(splats))
    made["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}" if inside else "a%20b.bin"
    (tmp_path / "a.gltf").write_text(json.dumps(made))
    if not inside:
        assert "lacks its buffer a b.bin; put that file beside it" in sentence(tmp_path / "a.gltf")
        (tmp_path / "a b.bin").write_bytes(data)
    assert_moved(load_model(tmp_path).gaussians(), splats, HALF_TURN)


@pytest.mark.parametrize("space", ["BT.709-sRGB", "BT.709"])
def test_the_drafts_sizes_are_logarithms_and_their_colors_are_called_otherwise(tmp_path, space):
    splats = tiny.gaussians()
    named = gltf_files.attributes(splats)
    named[f"{EXTENSION}:SCALE"] = np.log(named[f"{EXTENSION}:SCALE"])
    made, data = gltf_files.document(named)
    read = load(tmp_path, gltf_files.changed(made, *gltf_files.SAID, "colorSpace", to=space), data)
    assert_moved(read, splats, HALF_TURN)


def test_the_drafts_sizes_are_logarithms_in_large_units_too(tmp_path):
    """Most of them are positive there; the review draft's other names are those of today."""
    splats = tiny.gaussians()
    splats = replace(splats, scales=splats.scales / splats.scales.quantile(0.2))
    named = gltf_files.attributes(splats)
    named[f"{EXTENSION}:SCALE"] = np.log(named[f"{EXTENSION}:SCALE"])
    assert 0.1 < (named[f"{EXTENSION}:SCALE"] < 0).mean() < 0.3
    assert_moved(load(tmp_path, *gltf_files.document(named)), splats, HALF_TURN)


def test_the_first_drafts_colors_and_opacities_are_those_of_points(tmp_path):
    splats = tiny.gaussians(degree=0)
    splats = replace(splats, sh=splats.sh.clamp(-1.5, 1.5))
    named = gltf_files.attributes(splats)
    opacity, dc = named.pop(f"{EXTENSION}:OPACITY"), named.pop(f"{EXTENSION}:SH_DEGREE_0_COEF_0")
    colors = np.concatenate([0.5 + 0.28209479177387814 * dc, opacity], axis=1).astype(np.float32)
    sizes = np.log(named[f"{EXTENSION}:SCALE"])
    drafted = {"POSITION": named["POSITION"], "_ROTATION": named[f"{EXTENSION}:ROTATION"], "_SCALE": sizes, "COLOR_0": colors}
    assert_moved(load(tmp_path, *gltf_files.document(drafted)), splats, HALF_TURN)


def test_one_negative_size_does_not_make_logarithms_of_the_others(tmp_path):
    splats = tiny.gaussians()
    splats.scales[0, 0] = -1e-9
    read = load_model(gltf_files.glb(tmp_path / "a.glb", splats)).gaussians()
    torch.testing.assert_close(read.scales[1:], splats.scales[1:])


def test_attributes_for_other_uses_are_not_read(tmp_path):
    """A normal may have no bytes, which stands for zeros."""
    splats = tiny.gaussians()
    made, data = gltf_files.document(gltf_files.attributes(splats))
    made["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = len(made["accessors"])
    made["accessors"].append({"componentType": 5126, "type": "VEC3", "count": 60})
    assert_moved(load(tmp_path, made, data), splats, HALF_TURN)


def test_a_zero_quaternion_turns_with_its_node(tmp_path):
    splats = tiny.gaussians()
    splats.quats[0] = 0
    named = gltf_files.attributes(splats)
    named[f"{EXTENSION}:ROTATION"] = np.nan_to_num(named[f"{EXTENSION}:ROTATION"])
    read = load(tmp_path, *gltf_files.document(named, nodes=[{"mesh": 0, "rotation": CYCLE}]))
    assert_moved(read, splats, HALF_TURN @ CYCLED)


def test_the_digest_is_of_all_files(tmp_path):
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians()))
    made["buffers"][0]["uri"] = "a.bin"
    (tmp_path / "a.gltf").write_text(json.dumps(made))
    (tmp_path / "a.bin").write_bytes(data)
    before = load_model(tmp_path / "a.gltf").digest
    (tmp_path / "a.bin").write_bytes(bytes(12) + data[12:])  # another place of the first splat
    assert load_model(tmp_path / "a.gltf").digest != before


def test_certain_opacities_and_flat_splats_are_finite(tmp_path):
    splats = tiny.gaussians()
    splats.opacities[:2] = torch.tensor([0.0, 1.0])
    splats.scales[0, 0] = 0
    model = load_model(gltf_files.glb(tmp_path / "a.glb", splats))
    assert len(model) == 60 and all(raw.isfinite().all() for raw in model.parameters().values())


# What is written


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_again(tmp_path, degree):
    """It is nothing but rounded once, and has y up."""
    model = tiny.model(degree=degree)
    before = model.gaussians()
    written = model.save(tmp_path / "a.glb", provenance={})
    [primitive], _ = read_gltf(written)
    torch.testing.assert_close(torch.from_numpy(primitive.attributes["POSITION"]), before.means @ HALF_TURN)
    assert_moved(load_model(written).gaussians(), before, torch.eye(3))
    with pytest.raises(OutputExists):
        model.save(written, provenance={})


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased"])
def test_how_splats_are_to_be_drawn_is_written_and_read(tmp_path, screen_filter):
    """As in all other formats; it was lost, and the file taken for one of classic renderers."""
    model = tiny.model(trained=TrainedScale(screen_filter))
    assert load_model(model.save(tmp_path / "a.glb", provenance={})).trained.screen_filter == screen_filter


@pytest.mark.parametrize("wrong", [7, {"SplatRenderMode": 7}, {"SplatRenderMode": "unheard"}, []])
def test_other_facts_about_a_file_are_not_looked_at(tmp_path, wrong):
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians()))
    path = gltf_files.write_glb(tmp_path / "a.glb", gltf_files.changed(made, "asset", to={"version": "2.0", "extras": wrong}), data)
    assert load_model(path).trained == TrainedScale()


def test_high_bands_and_columns_have_no_place(tmp_path):
    with pytest.warns(UserWarning, match="SH bands above degree 3 are dropped, which glTF has no place for"):
        assert load_model(tiny.model(degree=4).save(tmp_path / "a.glb", provenance={})).sh_degree == 3


def test_more_than_a_glb_holds_is_refused_in_a_sentence(tmp_path, monkeypatch):
    """Its length has 32 bits."""
    monkeypatch.setattr(glb, "MOST_BYTES", 1000)
    with pytest.raises(OutputError, match=r"a\.glb: a \.glb holds at most 4 GiB, and these 60 splats take .*; give a \.ply"):
        tiny.model().save(tmp_path / "a.glb", provenance={})
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("viewer", "ending"), [(None, "_x0.25.glb"), ("three", "_x0.25_three.glb"), ("spark", "_x0.25_spark.ply")])
def test_what_is_adapted_from_it_is_what_the_viewer_reads(tmp_path, viewer, ending):
    path = gltf_files.glb(tmp_path / "scan.glb", tiny.gaussians())
    assert adapted_name(path, 1 / 4, viewer) == f"scan{ending}" and detect(tmp_path).family == "gltf"


def test_a_viewer_that_does_not_read_it_is_told_of(tmp_path):
    words = ["adapt", str(tiny.folder(tmp_path / "base")), "--scale", "1/4", "--recipe", "instant", "--output", str(tmp_path / "a.glb")]
    with pytest.warns(UserWarning, match="spark reads no splats in glTF"):
        refuse_unread(tmp_path / "a.glb", ["spark", "three"])
    with pytest.raises(SettingsError, match=r"spark reads no splats in glTF; give a \.ply by --output"):
        refuse_unread(tmp_path / "a.glb", ["spark"])
    refuse_unread(tmp_path / "a.glb", ["kiosk"])  # of a package, of which nothing is known
    assert main([*words, "--viewer", "three"]) == 0 and len(load_model(tmp_path / "a.glb")) > 0
