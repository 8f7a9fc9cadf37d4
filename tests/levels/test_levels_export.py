"""What viewers of levels read: streamed SOG and 3D Tiles, with files through splat-transform."""

import gzip
import json
import struct
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import pytest
import tiny
import torch
from two_levels import CHUNKS, LADDER

from mipmap_plugin import cli
from mipmap_plugin.commands.ladder_summary import _below
from mipmap_plugin.errors import OutputError, OutputExists, SettingsError
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.streamed_sog import read_chunks
from mipmap_plugin.levels.exported import readable
from mipmap_plugin.levels.manifest import MANIFEST
from mipmap_plugin.levels.streamed import EXTENT, Approach, distances, viewer_settings, write_streamed
from mipmap_plugin.levels.tiles import bounding_box, bounds, tileset, write_tile, write_tiles
from mipmap_plugin.models import load_model
from mipmap_plugin.models.vanilla import VanillaModel

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")


@pytest.fixture
def ladder(tmp_path):
    """A ladder's folder."""
    for level in LADDER["levels"]:
        tiny.ply(tmp_path / "ladder" / level["file"])
    write_json(tmp_path / "ladder" / MANIFEST, LADDER, overwrite=False)
    return tmp_path / "ladder"


def made_of_two_levels(folder, *options):
    """A command that makes a ladder in the folder."""
    base = tiny.folder(folder / "base", tiny.cameras(2, width=16, height=12), count=20)
    words = ["levels", str(base), "--viewer", "playcanvas", "--output", str(folder / "ladder"), "--coarsest", "1/2"]
    return [*words, "--by", "zoom", "--views", "given", *options]


def test_of_a_scene_too_small_for_playcanvas_the_command_says_so(ladder, tool):
    write_json(ladder / MANIFEST, LADDER | {"base_pixel": 1e-5}, overwrite=True)
    with pytest.warns(UserWarning, match="no level nearer than 0.1 units, and level 0 should end at 0.017: .* enlarge the scene"):
        write_streamed(ladder, 1000)


def test_chunks_of_a_scene_in_small_units_have_an_extent(ladder, tool):
    write_json(ladder / MANIFEST, LADDER | {"base_pixel": 0.001}, overwrite=True)
    assert EXTENT * distances(LADDER | {"base_pixel": 0.001}, 1000)[0] < 0.5
    words = json.loads(write_streamed(ladder, 1000).read_text())["asked"]
    assert words[words.index("--lod-chunk-extent") + 1] == "1"


def test_a_ladder_of_one_level_is_not_streamed(ladder, tool):
    write_json(ladder / MANIFEST, LADDER | {"switches": []}, overwrite=True)
    with pytest.raises(SettingsError, match="a single level"):
        write_streamed(ladder)


def test_the_box_of_a_tile_holds_the_large_splats_of_coarser_levels_too(ladder, tool):
    fine = tiny.gaussians()
    coarse = VanillaModel.from_gaussians(replace(fine, scales=3 * fine.scales))
    coarse.save(ladder / "level_2.ply", provenance={}, overwrite=True)
    root = json.loads(write_tiles(ladder).read_text())["root"]
    assert root["boundingVolume"]["box"] == pytest.approx(bounding_box(*bounds([coarse])), abs=1e-5)
    assert root["content"]["uri"] == "level_2.glb"


def test_streamed_sog_is_written_with_its_levels_and_settings(ladder, tool):
    made = write_streamed(ladder, 1000)
    words = json.loads(made.read_text())["asked"]
    assert words[-8::3] == ["--tag-lod"] * 3 and words[-7::3] == ["0", "1", "2"]
    assert words[words.index("--lod-chunk-extent") + 1] == str(round(EXTENT * distances(LADDER, 1000)[0]))
    assert read_chunks(made) == CHUNKS
    approach = Approach.to(LADDER["middle"], CHUNKS)
    assert json.loads((made.parent / "playcanvas.json").read_text()) == viewer_settings(LADDER, approach, 1000)
    with pytest.raises(OutputExists):
        write_streamed(ladder)


def test_a_terminal_shows_how_many_files_are_written(ladder, tool, monkeypatch):
    seen = []

    @contextmanager
    def told(what, unit):
        yield lambda *numbers: seen.append((what, unit, *numbers))

    monkeypatch.setattr("mipmap_plugin.formats.streamed_sog.told", told)
    write_streamed(ladder)
    assert seen == [("writing Streamed SOG", "file", number, 6) for number in range(1, 7)]


def test_tiles_are_written_with_their_files(ladder, tool):
    made = write_tiles(ladder)
    assert sorted(file.name for file in made.parent.iterdir()) == ["level_0.glb", "level_1.glb", "level_2.glb", "tileset.json"]


def test_a_tile_is_a_glb_of_spz(ladder, tool, tmp_path):
    """Its accessors have the count and the coefficients that the SPZ says, and no bytes; the only ones are the SPZ's."""
    write_tile(ladder / "level_1.ply", tmp_path / "tile.glb")
    content = (tmp_path / "tile.glb").read_bytes()
    magic, version, length, text, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON") and len(content) % 4 == text % 4 == 0
    document, (size, kind) = json.loads(content[20 : 20 + text]), struct.unpack_from("<I4s", content, 20 + text)
    assert kind == b"BIN\0" and gzip.decompress(content[28 + text :][: document["buffers"][0]["byteLength"]])[:4] == b"NGSP" and size % 4 == 0
    (primitive,) = document["meshes"][0]["primitives"]
    assert len(primitive["attributes"]) == 4 + 3 and [each["count"] for each in document["accessors"]] == [60] * 7
    assert not any("bufferView" in each for each in document["accessors"])
    assert document["extensionsRequired"] == ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert not list(tmp_path.glob("*.spz"))


def test_a_tile_tells_what_its_spz_cuts_off(ladder, tool, tmp_path):
    model = load_model(ladder / "level_1.ply")
    model.parameters()["scales"].data[:2] = 7.0
    model.save(tmp_path / "huge.ply", provenance={})
    with pytest.warns(UserWarning, match=r"^tile.glb: SPZ cuts off, of 60 splats, 2 longer than 379 units; a .ply keeps them$"):
        write_tile(tmp_path / "huge.ply", tmp_path / "tile.glb")


@pytest.mark.parametrize("write", [write_tiles, write_streamed])
def test_bands_that_splat_transform_does_not_read_are_left_out_with_a_warning(ladder, tool, write):
    (level := ladder / LADDER["levels"][0]["file"]).unlink()
    tiny.ply(level, degree=4)
    with pytest.warns(UserWarning, match="SH bands above degree 3 are dropped from what viewers stream"):
        assert write(ladder).is_file()
    assert load_model(level).sh_degree == 4


def test_what_it_reads_is_a_level_without_these_bands(tmp_path):
    whole, level = tiny.ply(tmp_path / "whole.ply", degree=4), tiny.ply(tmp_path / "level.ply", degree=3)
    assert readable(level, tmp_path / "copy.ply") == level
    with pytest.warns(UserWarning):
        copy = load_model(readable(whole, tmp_path / "copy.ply")).parameters()
    for name, tensor in load_model(whole).parameters().items():
        assert torch.equal(copy[name], tensor[:, :15] if name == "shN" else tensor)


def test_cesium_is_told_in_the_tileset_that_tiles_are_splats():
    assert tileset([0.0] * 12, [0.0])["extensions"]["3DTILES_content_gltf"]["extensionsRequired"] == [
        "KHR_gaussian_splatting",
        "KHR_gaussian_splatting_compression_spz_2",
    ]


def test_a_failed_conversion_leaves_nothing(ladder, tool):
    level = ladder / "level_2.ply"
    level.write_bytes(level.read_bytes().replace(b"end_header", b"comment broken\nend_header"))
    with pytest.raises(OutputError, match=r"splat-transform does not write it \(EFBIG: file too large, write\)"):
        write_streamed(ladder)
    assert not (ladder / "streamed").exists()


@pytest.mark.parametrize(
    ("bound", "value", "by"), [("--coarsest", "0.9", "zoom"), ("--coarsest", "0.9", "distance"), ("--until-splats", "1000", "zoom")]
)
def test_streamed_sog_of_one_level_is_refused_before_any_work(tmp_path, tool, capsys, monkeypatch, bound, value, by):
    monkeypatch.setattr("mipmap_plugin.levels.ladder.make_levels", None)
    words = ["levels", str(tiny.folder(tmp_path / "base")), "--viewer", "playcanvas", "--output", str(tmp_path / "ladder"), bound, value]
    assert cli.main([*words, "--by", by, "--streamed-sog"]) == 2
    assert f"a single level, which needs no streaming; give a smaller {bound}, or" in capsys.readouterr().err
    assert not (tmp_path / "ladder").exists()


def test_a_ladder_that_came_out_as_one_level_is_kept_for_a_command_that_does_not_stream_it(tmp_path, tool, capsys, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.levels.ladder._no_use", lambda *_: "no better")
    words = made_of_two_levels(tmp_path, "--recipe", "instant")
    assert cli.main([*words, "--streamed-sog"]) == 2
    told = "a single level, which needs no streaming; leave --streamed-sog out, which goes on from what is made"
    assert told in capsys.readouterr().err and not (tmp_path / "ladder").exists()
    monkeypatch.setattr("mipmap_plugin.wrap.Wrapped.adapt", None)
    assert cli.main(words) == 0 and (tmp_path / "ladder" / "level_0.ply").is_file()


@pytest.mark.parametrize("at", ["mipmap_plugin.levels.finished.write_levels", "mipmap_plugin.levels.store.LevelStore._loaded"])
def test_a_disk_that_fills_leaves_the_finished_levels_for_the_same_command(tmp_path, capsys, monkeypatch, at):
    words = made_of_two_levels(tmp_path, "--steps", "1")
    with monkeypatch.context() as first:
        first.setattr(at, Mock(side_effect=OutputError("the disk is full")))
        assert cli.main(words) == 2
    told = f"the disk is full; run the same command again to go on with the levels that {tmp_path / 'ladder.resume'} keeps"
    assert told in capsys.readouterr().err and not (tmp_path / "ladder").exists()
    assert cli.main(words) == 0 and (tmp_path / "ladder" / "level_1.ply").is_file()


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (OutputError("the disk is full"), 2)], ids=["Ctrl-C", "error"])
def test_an_export_that_ends_early_loses_no_level(tmp_path, tool, capsys, monkeypatch, error, code):
    words = made_of_two_levels(tmp_path, "--steps", "1", "--streamed-sog")
    with monkeypatch.context() as first:
        first.setattr("mipmap_plugin.levels.streamed.write_streamed", Mock(side_effect=error))
        assert cli.main(words) == code
    assert "the same command goes on" in capsys.readouterr().err
    levels = (tmp_path / "ladder" / "level_1.ply").read_bytes()
    monkeypatch.setattr("mipmap_plugin.wrap.Wrapped.adapt", None)
    assert cli.main(words) == 0
    assert (tmp_path / "ladder" / "level_1.ply").read_bytes() == levels and (tmp_path / "ladder" / "streamed").is_dir()
    assert not (tmp_path / "ladder.resume").exists()


def test_without_splat_transform_the_command_says_so_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    base, output = tiny.folder(tmp_path / "base"), tmp_path / "base_x0.5"
    for option in ("--streamed-sog", "--tiles"):
        assert cli.main(["levels", str(base), "--viewer", "spark", "--output", str(output), option]) == 2
        assert capsys.readouterr().err.strip().endswith("npm install -g @playcanvas/splat-transform")  # and not to give a .ply
    assert not output.exists() and not (tmp_path / "base_x0.5.resume").exists()


def test_a_canvas_without_distances_to_compute_is_refused(tmp_path, capsys):
    words = ["levels", str(tiny.ply(tmp_path / "base.ply")), "--viewer", "playcanvas", "--output", str(tmp_path / "ladder")]
    assert cli.main([*words, "--canvas", "2160"]) == 2
    assert "--canvas is for the distances of Streamed SOG and 3D Tiles; give --streamed-sog or --tiles" in capsys.readouterr().err


def test_levels_below_the_db_that_were_asked_for_are_named():
    levels = [{"file": "level_0.ply", "psnr_db": {"1": 40.0}}, {"file": "level_1.ply", "psnr_db": {"0.5": 31.0, "0.7": 35.0}}]
    assert _below({"least_db": 33.0, "levels": levels}) == ["level_1.ply"]
    assert _below({"least_db": None, "levels": levels}) == [] == _below({"levels": levels})
