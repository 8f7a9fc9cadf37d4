"""Exchange formats are recognized by their bytes, not names, and go through splat-transform; without it the error names the command to install it."""

import gzip
import hashlib
import json
import math
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import gltf_files
import numpy as np
import pytest
import tiny
import torch
from ply_files import write, write_splats

from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, OutputError, SettingsError
from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.formats.splat_transform import refuse_exchange, refuse_unread
from mipmap_plugin.formats.tags import mark_antialiased
from mipmap_plugin.levels.tiles import write_tile
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.adapted_name import adapted_name
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.surfels import SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.harmonics import basis
from mipmap_plugin.splatting.projection import axes_of
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

# FORMATS §13, T5: a real record of a .splat file.
RECORD = bytes.fromhex("7a72abc1b6e792c1f011b5c1b6cbe23f9f59683f0c309c4075c9fffff779599a")
# Niantic's header: magic, version 3, one point, SH degree 0, 12 fractional bits, no flags.
SPZ = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20)

MADE = [("spz", SPZ), ("spz", gzip.compress(SPZ)), ("ksplat", b"\0\1\0\0" + bytes(6000)), ("splat", RECORD * 3)]

# A stand-in for splat-transform: it returns the PLY beside it, and records its arguments. Its own choice is SPZ 4, which Spark does not read.
STAND_IN = """#!{python}
import json, pathlib, shutil, sys
here = pathlib.Path(__file__).parent
if sys.argv[1:] == ["--version"]:
    sys.exit(print("splat-transform v3.7.0 (0a1b2c3)", file=sys.stderr))
*options, source, target = sys.argv[1:]
if ("--spz-version" in options) != target.endswith(".spz") or target.endswith(".spz") and options[options.index("--spz-version") + 1] != "3":
    sys.exit("Error: expected --spz-version 3 for SPZ, and for nothing else")
(here / "asked.json").write_text(json.dumps([options, source, target, pathlib.Path(source).read_bytes().hex()[:64]]))
if pathlib.Path(source).stat().st_size == 13:
    print("  ✗ Error: Invalid header\\n    at parseSpz (cli.mjs:37217:15)\\n✗ failed in 0.051s  [peak cpu=85.1MB]", file=sys.stderr)
    sys.exit(1)
shutil.copyfile(here / "answer.ply" if target.endswith("plain.ply") else source, target)
"""


@pytest.fixture
def tool(tmp_path_factory, monkeypatch):
    """The folder of a stand-in that is the only program on the path."""
    place = tmp_path_factory.mktemp("bin")
    (place / "splat-transform").write_text(STAND_IN.format(python=sys.executable))
    (place / "splat-transform").chmod(0o755)
    tiny.ply(place / "answer.ply")
    monkeypatch.setenv("PATH", str(place))
    return place


def tool_request(tool):
    return json.loads((tool / "asked.json").read_text())


def sentence(path):
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    return str(caught.value)


@pytest.mark.parametrize(("ending", "content"), MADE, ids=["spz v4", "spz v2", "ksplat", "splat"])
def test_without_the_tool_a_file_is_recognized_by_its_bytes_and_the_install_command_is_named(tmp_path, ending, content, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / f"my scene.{ending}"
    path.write_bytes(content)
    assert f"is {ending.upper()}, an exchange format" in sentence(path)
    assert sentence(path).endswith("run: npm install -g @playcanvas/splat-transform")


@pytest.mark.parametrize(("ending", "content"), MADE, ids=["spz v4", "spz v2", "ksplat", "splat"])
@pytest.mark.parametrize("named", [True, False])
def test_a_file_is_read_under_the_ending_that_the_tool_knows(tmp_path, tool, ending, content, named):
    path = tmp_path / (f"my scene.{ending}" if named else "-scene.bin")
    path.write_bytes(content)
    model = load_model(path)
    assert len(model) == 60 and model.family == "3dgs" and "rounds the trained values" in model.notes[0]
    assert (model.source, model.digest, model.folder) == (path, hashlib.sha256(content).hexdigest(), None)
    options, source, target, began = tool_request(tool)
    assert Path(source).is_absolute() and source.endswith(f".{ending}") and bytes.fromhex(began) == content[:32]
    assert (source == str(path)) == named and not Path(target).exists() and "--quiet" in options


def test_what_the_tool_refuses_is_one_sentence(tmp_path, tool):
    (tmp_path / "a.spz").write_bytes(b"NGSP" + bytes(9))
    assert "splat-transform does not read it (Invalid header)" in sentence(tmp_path / "a.spz")


def test_compressed_ply_is_recognized_by_its_columns(tmp_path, tool):
    write(tmp_path / "a.ply", {"packed_position": np.zeros(1, np.int32)})
    assert len(load_model(tmp_path / "a.ply")) == 60
    assert tool_request(tool)[1].endswith(".compressed.ply")


def test_a_plain_ply_with_the_name_of_a_compressed_one_stays_plain(tmp_path):
    """Its adaptation is not rounded, which would lose some of what the base has."""
    plain = write_splats(tmp_path / "a.compressed.ply")
    assert adapted_name(plain, 1 / 4) == "a_x0.25.ply"
    packed = write(tmp_path / "b.compressed.ply", {"packed_position": np.zeros(1, np.int32)})
    assert adapted_name(packed, 1 / 4) == "b_x0.25.compressed.ply"


def test_a_sog_whose_checksums_are_wrong_is_refused(tmp_path, tool):
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps({"version": 2, "means": {"files": ["means_l.webp"]}}))
        archive.writestr("means_l.webp", b"abcd")
    (tmp_path / "a.sog").write_bytes((tmp_path / "a.sog").read_bytes().replace(b"abcd", b"abce"))
    with pytest.raises(CheckpointError, match=r"is damaged \(the checksum of means_l.webp is wrong\)"):
        load_model(tmp_path / "a.sog")


@pytest.mark.parametrize("where", ["a.sog", "room", "room/meta.json"])
def test_sog_as_a_file_and_as_a_folder(tmp_path, tool, where):
    meta = json.dumps({"version": 2, "means": {"files": ["means_l.webp", "means_u.webp"]}})
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", meta)
        archive.writestr("means_l.webp", "")
    (tmp_path / "room").mkdir()
    (tmp_path / "room/meta.json").write_text(meta)
    assert len(load_model(tmp_path / where)) == 60
    assert tool_request(tool)[1] == str(tmp_path / ("a.sog" if where == "a.sog" else "room/meta.json"))


def test_npx_is_tried_where_the_tool_is_not_on_the_path(tmp_path, tool):
    """Installed for one project only; nothing is downloaded."""
    (tool / "splat-transform").rename(tool / "real")
    (tool / "npx").write_text(f"#!{sys.executable}\nimport os, sys\nassert sys.argv[1:3] == ['--no-install', 'splat-transform']\n"
        f"sys.exit(0) if sys.argv[3:] == ['--version'] else os.execv('{tool / 'real'}', ['real', *sys.argv[3:]])\n")
    (tool / "npx").chmod(0o755)
    (tmp_path / "a.spz").write_bytes(SPZ)
    assert len(load_model(tmp_path / "a.spz")) == 60
    (tool / "npx").write_text(f"#!{sys.executable}\nimport sys\nsys.exit(1)\n")
    assert "npm install" in sentence(tmp_path / "a.spz")


def test_certain_opacities_are_finite(tmp_path, tool):
    columns = read_ply(tool / "answer.ply").columns
    columns["opacity"][:2] = np.inf, -np.inf
    write(tool / "answer.ply", columns)
    (tmp_path / "a.spz").write_bytes(SPZ)
    logits = load_model(tmp_path / "a.spz").parameters()["opacities"]
    assert logits.isfinite().all() and logits[0].sigmoid() > 0.99999


def test_adapt_reads_and_writes_spz(tmp_path, tool, capsys):
    """The result is written beside the input, in the same format."""
    (tmp_path / "phone.spz").write_bytes(SPZ)
    assert main(["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant"]) == 0
    assert (tmp_path / "phone_x0.25.spz").read_bytes().startswith(b"ply")  # the stand-in's
    assert tool_request(tool)[1].endswith("plain.ply") and tool_request(tool)[2].endswith("made.spz")
    assert json.loads((tmp_path / "phone_x0.25.spz.adaptation.json").read_text())["scale"] == 0.25
    assert {path.name for path in tmp_path.iterdir()} == {"phone.spz", "phone_x0.25.spz", "phone_x0.25.spz.adaptation.json"}
    assert main(["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant"]) == 2
    assert "--overwrite" in capsys.readouterr().err


UP_TO_2, NONE = "reads .spz up to version 2, and splat-transform writes 3 at least", "read no .spz"
WITH_FILTER = "reads PLYs only, with a column filter_3D that .spz has no place for"
UNREAD = [("gaussian-splats-3d", UP_TO_2), ("mkkellogg", UP_TO_2), ("gsplat-js", NONE), ("drei", NONE), ("mip", WITH_FILTER)]


@pytest.mark.parametrize(("viewer", "why"), UNREAD)
def test_spz_is_not_written_for_a_viewer_that_does_not_read_it(tmp_path, tool, capsys, viewer, why):
    (tmp_path / "phone.spz").write_bytes(SPZ)
    words = ["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant", "--viewer", viewer]
    assert main(words) == 2
    assert f"{why}; give a .ply by --output" in capsys.readouterr().err
    assert main([*words, "--output", str(tmp_path / "phone.ply")]) == 0


def test_spz_for_several_viewers_is_written_with_a_warning_of_those_that_do_not_read_it(tmp_path, recwarn):
    refuse_unread(tmp_path / "a.spz", ["spark", "three"])
    refuse_unread(tmp_path / "a.ply", ["spark", "gaussian-splats-3d"])
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"GaussianSplats3D .*; antimatter15/splat, .* read no .spz; give a .ply by --output if it is for these too"):
        refuse_unread(tmp_path / "a.spz", ["spark", "gaussian-splats-3d", "antimatter15"])


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".ply"])
@pytest.mark.parametrize("viewer", [None, "antialiased"])
def test_splats_that_not_all_viewers_of_a_format_draw_as_trained_are_told_of(tmp_path, tool, ending, viewer, capsys):
    """Without a viewer they are for renderers of the training; whoever names a viewer knows it."""
    base, output = tiny.ply(tmp_path / "base.ply"), tmp_path / f"new{ending}"
    words = ["adapt", str(base), "--scale", "1/2", "--recipe", "instant", "--screen-filter", "antialiased", "--output", str(output)]
    assert main([*words, *(["--viewer", viewer] if viewer else [])]) == 0
    told = f"(antialiased, 0.3 px²), which not all viewers of {ending} do"
    report = json.loads(output.with_name(output.name + ".adaptation.json").read_text())
    count = int(viewer is None and ending != ".ply")
    assert capsys.readouterr().err.count(told) == sum(told in note for note in report["notes"]) == count


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply"])
def test_columns_that_a_format_has_no_place_for_are_told_of_and_in_the_report(tmp_path, tool, ending, capsys):
    """Normals that are not 0 too, which 3DGS does not have."""
    columns = {**read_ply(tiny.ply(tmp_path / "a.ply")).columns, "confidence": np.ones(60, np.float32), "nx": np.ones(60, np.float32)}
    write(tmp_path / "b.ply", columns)
    told = f"the extra columns nx, ny, nz, confidence are dropped, since {ending} has no place for them; a .ply has"
    assert main(["adapt", str(tmp_path / "b.ply"), "--scale", "1", "--output", str(tmp_path / f"c{ending}")]) == 0
    assert capsys.readouterr().err.count(told) == 1
    assert told in json.loads((tmp_path / f"c{ending}.adaptation.json").read_text())["notes"]
    assert main(["adapt", str(tmp_path / "b.ply"), "--scale", "1", "--output", str(tmp_path / "d.ply")]) == 0
    assert json.loads((tmp_path / "d.ply.adaptation.json").read_text())["notes"] == []


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".ply"])
def test_bands_that_splat_transform_does_not_write_are_left_out_and_told_of(tmp_path, tool, ending, capsys):
    base, made = tiny.ply(tmp_path / "a.ply", degree=4), tmp_path / f"b{ending}"
    assert main(["adapt", str(base), "--scale", "1", "--output", str(made)]) == 0
    told, count = "SH bands above degree 3 are dropped, which splat-transform does not write; a .ply has them", int(ending != ".ply")
    assert capsys.readouterr().err.count(told) == json.loads(made.with_name(made.name + ".adaptation.json").read_text())["notes"].count(told) == count
    written, rest = read_ply(made).columns, [f"f_rest_{number}" for number in range(45 if count else 72)]  # the stand-in writes what it is given
    assert [name for name in written if name.startswith("f_rest")] == rest
    own = load_model(base).parameters()["shN"][:, 14, 2].detach()
    np.testing.assert_array_equal(written["f_rest_44" if count else "f_rest_62"], own)


def test_a_format_that_is_only_read_is_saved_as_a_ply(tmp_path, tool):
    (tmp_path / "phone.splat").write_bytes(RECORD * 3)
    assert main(["adapt", str(tmp_path / "phone.splat"), "--scale", "1/4", "--recipe", "instant"]) == 0
    assert len(load_model(tmp_path / "phone_x0.25.ply")) == 60


@pytest.mark.parametrize("name", ["out.splat", "out.KSPLAT"])
def test_no_folder_is_named_as_a_file_of_these_formats_is(tmp_path, name):
    with pytest.raises(SettingsError, match=r"is not written as K?SPLAT; give a \.ply"):
        tiny.model().save(tmp_path / name, provenance={})


@pytest.mark.parametrize("name", ["out.sog", "out.spz", "out.compressed.ply"])
def test_any_splats_are_written_so_where_the_name_asks_for_it(tmp_path, tool, name):
    tiny.model().save(tmp_path / name, provenance={})
    assert tool_request(tool)[2].endswith(name.partition(".")[2])
    assert len(read_ply(tmp_path / name).columns["x"]) == 60


@pytest.mark.parametrize(
    ("cards", "options"), [("[0] llvmpipe (LLVM 15)", ["--gpu", "cpu", "--sh-iterations", "1"]), ("[0] Apple M4", ["--gpu", "0"])]
)
def test_sog_is_made_by_a_gpu_or_in_one_iteration(tmp_path, tool, cards, options):
    script = (tool / "splat-transform").read_text()
    listing = f"import sys\nif sys.argv[1:] == ['--list-gpus']:\n    sys.exit(print({cards!r}))\n"
    (tool / "splat-transform").write_text(script.replace("import json", f"{listing}import json", 1))
    tiny.model().save(tmp_path / "out.sog", provenance={})
    assert tool_request(tool)[0] == ["--quiet", "--overwrite", *options]
    tiny.model().save(tmp_path / "out.spz", provenance={})
    assert tool_request(tool)[0] == ["--quiet", "--overwrite", "--gpu", "cpu", "--spz-version", "3"]


def test_a_failed_writing_leaves_the_old_file(tmp_path, tool):
    (tool / "splat-transform").write_text(f"#!{sys.executable}\nimport sys\nprint('no room', file=sys.stderr)\nsys.exit(3)\n")
    (tmp_path / "out.spz").write_bytes(b"old")
    with pytest.raises(OutputError, match="no room"):
        tiny.model().save(tmp_path / "out.spz", provenance={}, overwrite=True)
    assert (tmp_path / "out.spz").read_bytes() == b"old" and [path.name for path in tmp_path.iterdir()] == ["out.spz"]


def test_what_no_viewer_of_it_shows_is_not_written(tmp_path, tool, monkeypatch):
    flat = SurfelModel(tiny.model().parameters(), flat_trained(tiny.model().trained))
    with pytest.raises(SettingsError, match=r"the filter of their own project \(surfel, 0.5 px²\); give a .ply or a folder"):
        flat.save(tmp_path / "out.spz", provenance={})
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SettingsError, match="npm install"):
        tiny.model().save(tmp_path / "out.spz", provenance={})


def moved_by(offset):
    splats = tiny.gaussians()
    return VanillaModel.from_gaussians(replace(splats, means=splats.means + splats.means.new_tensor([0.0, 0.0, offset])))


def test_spz_is_not_written_of_splats_that_are_too_far_away_for_it(tmp_path, tool):
    """Their coordinates would begin anew after 2,048 units, at -2,048."""
    far = moved_by(-2060.0)
    refused = r"60 of 60 splats lie 2,048 or more units from the origin .*; remove them, move or shrink the scene, or give a .sog or a .ply"
    with pytest.raises(SettingsError, match=refused):
        far.save(tmp_path / "out.spz", provenance={})
    with pytest.raises(SettingsError, match=refused):  # before any work
        wrap_model(far, cameras=tiny.cameras(2)).refuse_output(tmp_path / "out.spz", overwrite=False)
    far.save(tmp_path / "out.ply", provenance={})
    with pytest.raises(SettingsError, match="move or shrink the scene, or open the level itself"):
        write_tile(tmp_path / "out.ply", tmp_path / "out.glb")
    assert not (tmp_path / "out.glb").exists()
    far.save(tmp_path / "out.compressed.ply", provenance={})
    moved_by(2000.0).save(tmp_path / "out.spz", provenance={})


def test_levels_in_tiles_are_refused_of_such_splats_before_any_work(tmp_path, tool, capsys, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.levels.ladder.make_levels", None)
    moved_by(5e5).save(tmp_path / "city.ply", provenance={})
    assert main(["levels", str(tmp_path / "city.ply"), "--viewer", "cesium", "--output", str(tmp_path / "ladder"), "--tiles"]) == 2
    assert "60 of 60 splats lie 2,048 or more units" in (told := capsys.readouterr().err) and "leave --tiles out" in told


def test_a_streamed_sog_is_recognized_too(tmp_path):
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"]}))
    assert detect(tmp_path).family == "exchange"


def test_other_json_is_no_sog(tmp_path):
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    assert "no checkpoint that is known here" in sentence(tmp_path / "transforms.json")


# A real capture, as its author published it and as other programs would write it


def as_splat(columns):
    """antimatter15's records: position, lengths, RGBA and the quaternion as bytes."""
    stacked = lambda *names: np.stack([columns[name] for name in names], 1).astype(np.float64)  # noqa: E731
    quats = stacked("rot_0", "rot_1", "rot_2", "rot_3")
    rows = np.empty(len(quats), [("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
    rows["position"], rows["scale"] = stacked("x", "y", "z"), np.exp(stacked("scale_0", "scale_1", "scale_2"))
    rows["color"][:, :3] = np.clip(255 * (0.5 + 0.28209479177387814 * stacked("f_dc_0", "f_dc_1", "f_dc_2")), 0, 255)
    rows["color"][:, 3] = 255 / (1 + np.exp(-columns["opacity"].astype(np.float64)))
    rows["quat"] = np.clip(quats / np.linalg.norm(quats, axis=1, keepdims=True) * 128 + 128, 0, 255)
    return rows.tobytes()


def as_compressed_ply(columns):
    """SuperSplat's header and layout; the packed words themselves are not looked at."""
    count = len(columns["x"])
    bounds = [f"{end}_{what}" for what in ("x", "y", "z", "scale_x", "scale_y", "scale_z") for end in ("min", "max")]
    packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    chunks = -(-count // 256)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}", *(f"property float {name}" for name in bounds)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in packed), "end_header", ""]
    return "\n".join(lines).encode() + bytes(4 * 12 * chunks + 4 * 4 * count)


@pytest.mark.parametrize("kind", ["SPLAT", "compressed PLY"])
def test_a_real_capture_in_each_format_under_any_name(shared_data, tmp_path, kind):
    columns = read_ply(shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply").columns
    path = tmp_path / "capture.dat"
    path.write_bytes({"SPLAT": as_splat, "compressed PLY": as_compressed_ply}[kind](columns))
    assert detect(path).family == "exchange"


def test_a_splat_transform_that_is_too_old_for_sog_is_found_before_the_work(tmp_path, tool):
    (tool / "splat-transform").write_text(f"#!{sys.executable}\nimport sys\nprint('splat-transform v2.7.1 (b42b60c)', file=sys.stderr)\n")
    with pytest.raises(SettingsError, match=r"splat-transform 2.7.1 is too old for it, and 3.0 or newer is needed"):
        tiny.model().refuse_output(tmp_path / "a.sog", overwrite=False, networks_move=False)
    tiny.model().refuse_output(tmp_path / "a.spz", overwrite=False, networks_move=False)
    (tool / "splat-transform").write_text(f"#!{sys.executable}\nimport sys\nprint('splat-transform v2.0.6', file=sys.stderr)\n")
    with pytest.raises(SettingsError, match=r"2.0.6 is too old for it, and 2.1 or newer is needed; run: npm install -g \S+; or give a .ply"):
        tiny.model().refuse_output(tmp_path / "a.spz", overwrite=False, networks_move=False)


def test_streamed_sog_is_read_by_a_splat_transform_that_knows_it(tmp_path, tool):
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"], "tree": {}}))
    assert len(load_model(tmp_path)) == 60
    assert tool_request(tool)[1] == str(tmp_path / "lod-meta.json")
    (tool / "splat-transform").write_text(f"#!{sys.executable}\nimport sys\nprint('splat-transform v2.7.1 (b42b60c)', file=sys.stderr)\n")
    assert sentence(tmp_path).endswith(
        "lod-meta.json is Streamed SOG: splat-transform 2.7.1 is too old for it, and 3.2 or newer is needed, which needs Node.js 22; "
        "run: npm install -g @playcanvas/splat-transform@latest"
    )


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


def test_an_error_of_node_is_told(tmp_path, tool):
    script = "print('TypeError [ERR_PARSE_ARGS_UNKNOWN_OPTION]: Unknown option', file=sys.stderr)\nprint('failed in 0.006s')\nsys.exit(1)\n"
    (tool / "splat-transform").write_text(f"#!{sys.executable}\nimport sys\n{script}")
    with pytest.raises(OutputError, match=r"does not write it \(Unknown option\)"):
        tiny.model().save(tmp_path / "a.spz", provenance={})


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
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/meta.json", json.dumps({"version": 2, "model": model, "means": {"files": ["means_l.webp"]}}))
        archive.writestr("a/means_l.webp", b"abcd")
    return path


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


@pytest.fixture
def rounding(tool):
    """The stand-in writes SPZ that it reads as `answer.ply`, another model: as if the format rounded a lot."""
    script = (tool / "splat-transform").read_text()
    (tool / "splat-transform").write_text(script + f"pathlib.Path(target).write_bytes({gzip.compress(SPZ)!r}) if target.endswith('.spz') else None\n")
    tiny.model(seed=5).save(tool / "answer.ply", provenance={}, overwrite=True)


@pytest.mark.usefixtures("small_orbits", "rounding")
def test_the_db_of_a_file_are_of_what_its_format_keeps(tmp_path, capsys):
    words = ["--scale", "1/4", "--steps", "0", "--viewer", "classic"]
    source = tiny.ply(tmp_path / "scan.ply")
    assert main(["adapt", str(source), *words, "--output", str(tmp_path / "scan.spz"), "--report"]) == 0
    said = capsys.readouterr()
    report = json.loads((tmp_path / "scan.spz.adaptation.json").read_text())
    exact = next(psnr for state, psnr in report["validation"].items() if report["returned"].startswith(state))
    assert report["written"] < exact - 1
    assert f"-> {report['written']:.2f} dB on views" in said.out
    page = (tmp_path / "scan.spz.report.html").read_text()
    record = json.loads(re.search(r'<script type="application/json" id="record">(.*?)</script>', page, re.DOTALL)[1])
    [picture] = [picture for picture in record["zooms"][0]["pictures"] if picture["role"] == "adapted"]
    assert picture["mean"] == {"psnr_db": report["written"]} and picture["view"]["psnr_db"] < exact - 1
    assert f"→ {report['written']:.1f} dB on views" in record["lead"] and record["adaptations"][0]["written"] == report["written"]
    assert "its format rounds splats, which costs" in said.err and any("its format rounds splats" in note for note in report["notes"])
    base = report["validation"]["the base as it is"]
    worse = f"the file is worse than its base ({base:.2f} dB); keep the base, or give a .ply"
    assert report["written"] < base and worse in said.err and any(worse in note for note in report["notes"])


@pytest.mark.usefixtures("small_orbits", "rounding")
def test_the_db_in_each_of_several_viewers_are_of_what_a_format_keeps(tmp_path):
    adapted = wrap_model(tiny.ply(tmp_path / "scan.ply")).adapt(1 / 4, steps=0, merge_to=1.0, viewer="portable")
    exact, files = adapted.report.viewers, [adapted.save(tmp_path / f"a.{suffix}") for suffix in ("ply", "spz")]
    ply, spz = (json.loads(file.with_name(f"{file.name}.adaptation.json").read_text())["viewers"] for file in files)
    assert ply == exact and spz.keys() == exact.keys() and spz["classic"] < exact["classic"] - 1


@pytest.mark.usefixtures("small_orbits")
def test_a_ply_is_not_measured_again(tmp_path, capsys):
    words = ["--scale", "1/4", "--steps", "0"]
    assert main(["adapt", str(tiny.ply(tmp_path / "scan.ply")), *words, "--output", str(tmp_path / "out.ply")]) == 0
    assert json.loads((tmp_path / "out.ply.adaptation.json").read_text())["written"] is None
