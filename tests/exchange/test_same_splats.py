"""Splats and how they are drawn are the same in every format, by every version of splat-transform."""

import gzip
import json
import math
import shutil
import subprocess
from dataclasses import replace

import gltf_files
import numpy as np
import pytest
import tiny
import torch
from exchange_files import RECORD, SPZ, sentence
from ply_files import write
from zip_files import archive

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.formats.splat_transform import refuse_exchange
from mipmap_plugin.formats.tags import mark_antialiased
from mipmap_plugin.levels.tiles import write_tile
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.splatting.harmonics import basis
from mipmap_plugin.splatting.projection import axes_of

pytestmark = pytest.mark.usefixtures("few_views")


def seen(splats, turn):
    """Places, covariances, and colors in every direction, of splats after a turn [3, 3] of the scene."""
    axes = turn @ axes_of(splats.quats, splats.scales)
    directions = torch.nn.functional.normalize(torch.randn(9, 1, 3, generator=torch.Generator().manual_seed(0)), dim=2)
    colors = (basis(directions @ turn, 4)[..., None] * splats.sh).sum(2)  # a direction of the turned scene, turned back
    return splats.means @ turn.T, axes @ axes.mT, colors


@pytest.mark.parametrize(("version", "turns"), [("2.0.6", False), ("2.1.0", True), ("2.7.1", True), ("3.0.0", False)])
def test_spz_is_read_and_written_as_it_is_stored_by_every_version(tmp_path, tool, version, turns):
    """From 2.1 until 3.0 splat-transform turns SPZ by half a turn about x. The stand-in does not, so that what takes it back is seen."""
    (tool / "splat-transform").write_text((tool / "splat-transform").read_text().replace("3.7.0", version))
    stored = tiny.model(degree=4)
    stored.save(tool / "answer.ply", provenance={}, overwrite=True)
    (tmp_path / "a.spz").write_bytes(SPZ)
    read = load_model(tmp_path / "a.spz")
    still, turn = torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]) if turns else torch.ones(3))
    for found, expected in zip(seen(read.gaussians(), still), seen(stored.gaussians(), turn), strict=True):
        assert torch.allclose(found, expected, atol=1e-5)
    (tmp_path / "a.splat").write_bytes(RECORD * 3)
    assert torch.equal(load_model(tmp_path / "a.splat").parameters()["means"], stored.parameters()["means"])  # only SPZ was turned
    if version >= "2.1":
        tiny.model(degree=3).save(tool / "answer.ply", provenance={}, overwrite=True)  # with the bands that are written
        load_model(tmp_path / "a.spz").save(tmp_path / "b.spz", provenance={})
        written = read_ply(tmp_path / "b.spz").columns
        assert all(np.array_equal(column, written[name]) for name, column in read_ply(tool / "answer.ply").columns.items())


needs_tool = pytest.mark.skipif(shutil.which("splat-transform") is None, reason="splat-transform is not installed")


def agree(first, second, nearest):
    """Whether two models are the same splats but for rounding; `nearest`: their order may differ."""
    a, b = (replace(g, scales=g.scales.clamp_min(math.exp(-10))) for g in (first.gaussians(), second.gaussians()))  # the least that SPZ holds
    if nearest:
        b = b[torch.cdist(a.means, b.means).argmin(1)]
    close = [(a.means - b.means).norm(dim=1) < 0.02, (a.opacities - b.opacities).abs() < 0.02, ((a.sh[:, 0] - b.sh[:, 0]).abs() < 0.1).all(1)]
    close += [((a.scales / b.scales).log().abs() < 0.2).all(1), (a.quats * b.quats).sum(1).abs() > 0.99]
    return torch.stack(close).float().mean(1)


@needs_tool
def test_a_published_sog_is_the_capture_that_its_ply_is(shared_data):
    place = shared_data / "checkpoints/yashica-t4"
    ply, sog = (load_model(place / f"yashica-t4-top8192.{ending}") for ending in ("ply", "sog"))
    assert (agree(ply, sog, nearest=True) > 0.97).all()


@needs_tool
def test_a_published_spz_reads_as_its_format_says(shared_data):
    """The file is of other splats than its neighbors; its positions are decoded here. Their frame is left as it is."""
    path = shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.spz"
    packed = np.frombuffer(gzip.decompress(path.read_bytes())[16 : 16 + 9 * 8192], np.uint8).reshape(8192, 3, 3).astype(np.int32)
    value = packed[..., 0] | packed[..., 1] << 8 | packed[..., 2] << 16
    value = np.where(value >= 1 << 23, value - (1 << 24), value) / 2**12
    assert np.allclose(load_model(path).parameters()["means"].numpy(), value, atol=1e-6)


@needs_tool
@pytest.mark.parametrize("ending", ["spz", "sog", "compressed.ply"])
def test_real_splats_survive_each_format(shared_data, tmp_path, ending):
    base, path = load_model(shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply"), tmp_path / f"a.{ending}"
    try:
        refuse_exchange(path)
    except SettingsError as error:
        if "is too old for it" not in str(error):
            raise
        pytest.skip(str(error))
    saved = base.save(path, provenance={})
    assert (agree(base, load_model(saved), nearest=True) > 0.95).all()


@pytest.fixture
def old_tool(tool):
    """A version of before 3.0, which loses what a file says of how it is to be drawn."""
    write_ply(tool / "answer.ply", read_ply(tool / "answer.ply").columns, overwrite=True)
    forget = 'pathlib.Path(target).write_bytes(b"".join(line for line in pathlib.Path(source).open("rb") if b"comment" not in line))'
    with (tool / "splat-transform").open("a") as script:
        script.write(f"if not target.endswith('plain.ply'):\n    {forget}\n")
    return tool


def as_sog(path, model):
    meta = {"version": 2, "model": model, "means": {"files": ["means_l.webp"]}}
    return archive(path, {"a/meta.json": json.dumps(meta), "a/means_l.webp": b"abcd"})


@pytest.mark.parametrize("flag", [0, 1, 2, 3])
@pytest.mark.parametrize("packed", [gzip.compress, bytes])
def test_an_spz_of_antialiased_splats_is_drawn_so_whatever_version_of_the_tool_reads_it(tmp_path, old_tool, flag, packed):
    spz = bytearray(SPZ)
    spz[14] = flag
    (tmp_path / "a.spz").write_bytes(packed(bytes(spz)))
    assert load_model(tmp_path / "a.spz").trained.screen_filter == ("antialiased" if flag & 1 else "classic")


@pytest.mark.parametrize(("model", "screen_filter"), [("antialiased", "antialiased"), (None, "classic"), (["antialiased"], "classic")])
def test_a_sog_is_drawn_as_its_meta_says_whatever_version_of_the_tool_reads_it(tmp_path, old_tool, model, screen_filter):
    assert load_model(as_sog(tmp_path / "a.sog", model)).trained.screen_filter == screen_filter


def test_a_sog_of_flat_splats_is_not_taken_for_one_of_others(tmp_path, old_tool):
    assert "its splats are of 2D Gaussian splatting, not read from this format" in sentence(as_sog(tmp_path / "a.sog", "2dgs"))


def test_a_compressed_ply_is_drawn_as_its_header_says_whatever_version_of_the_tool_reads_it(tmp_path, old_tool):
    write(tmp_path / "a.ply", {"packed_position": np.zeros(1, np.int32)}, comments=["SplatRenderMode: mip"])
    assert load_model(tmp_path / "a.ply").trained.screen_filter == "antialiased"


def test_antialiased_splats_are_marked_where_the_tool_does_not(tmp_path, old_tool):
    (tmp_path / "a.spz").write_bytes(gzip.compress(SPZ))
    mark_antialiased(tmp_path / "a.spz")
    assert load_model(tmp_path / "a.spz").trained.screen_filter == "antialiased"
    for screen_filter, told in (("antialiased", ["SplatRenderMode: mip"]), ("classic", [])):
        model = tiny.model(trained=TrainedScale(screen_filter=screen_filter))
        assert read_ply(model.save(tmp_path / f"{screen_filter}.compressed.ply", provenance={})).comments == tuple(told)


@pytest.mark.parametrize("inside", [True, False])
def test_gltf_of_spz_is_drawn_as_the_spz_says(tmp_path, tool, inside):
    """By the extension of today, and by that of a draft."""
    tiny.model(trained=TrainedScale(screen_filter="antialiased")).save(tool / "answer.ply", provenance={}, overwrite=True)
    made, _ = gltf_files.document({})
    compression = {"KHR_gaussian_splatting_compression_spz_2" if inside else "KHR_spz_gaussian_splats_compression": {"bufferView": 0}}
    extensions = {"KHR_gaussian_splatting": {"extensions": compression}} if inside else compression
    made["meshes"][0]["primitives"][0]["extensions"] = extensions
    made |= {"bufferViews": [{"buffer": 0, "byteLength": len(SPZ)}], "buffers": [{"byteLength": len(SPZ)}]}
    model = load_model(gltf_files.write_glb(tmp_path / "a.glb", made, SPZ))
    assert len(model) == 60 and model.trained.screen_filter == "antialiased" and "SPZ in it rounds the trained values" in model.notes[1]


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased"])
def test_meshes_of_gltf_have_to_be_drawn_alike(tmp_path, tool, screen_filter):
    """One is SPZ, whose converted header has comments, the other is not, and is drawn as 3DGS does."""
    tiny.model(trained=TrainedScale(screen_filter=screen_filter)).save(tool / "answer.ply", provenance={}, overwrite=True)
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians(10)))
    compression = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": len(made["bufferViews"])}}
    splats = {"attributes": {}, "extensions": {"KHR_gaussian_splatting": {"extensions": compression}}}
    made["meshes"][0]["primitives"].append(splats)
    made["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(SPZ)})
    path = gltf_files.write_glb(tmp_path / "a.glb", made, data + SPZ)
    if screen_filter == "classic":
        assert len(load_model(path)) == 70
    else:
        assert "its meshes are to be drawn in different ways" in sentence(path)


@needs_tool
def test_a_tile_is_read_as_the_splats_that_it_was_made_of(shared_data, tmp_path):
    """glTF of SPZ, whose node turns it."""
    ply = shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply"
    write_tile(ply, tmp_path / "a.glb")
    assert (agree(load_model(ply), load_model(tmp_path / "a.glb"), nearest=True) > 0.95).all()


@needs_tool
def test_the_gltf_of_splat_transform_is_its_ply(shared_data, tmp_path):
    """Nothing in it is rounded but once."""
    ply = shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply"
    done = subprocess.run(["splat-transform", "--quiet", str(ply), str(tmp_path / "a.glb")], capture_output=True, check=False)
    if done.returncode:
        pytest.skip("this version of splat-transform writes no .glb")
    plain, read = (load_model(path).gaussians() for path in (ply, tmp_path / "a.glb"))
    torch.testing.assert_close(read.means, plain.means)
    torch.testing.assert_close(read.sh, plain.sh, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(axes_of(read.quats, read.scales).abs(), axes_of(plain.quats, plain.scales).abs(), atol=1e-6, rtol=1e-4)
