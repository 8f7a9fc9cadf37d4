"""Exchange formats are recognized by their bytes, not names, and go through splat-transform to be read."""

import gzip
import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny
from exchange_files import RECORD, SPZ, answer_by, sentence, tool_request
from ply_files import write, write_splats
from zip_files import archive

from mipmap_plugin.errors import CheckpointError, OutputError
from mipmap_plugin.formats.magic import kind_of
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.splat_transform import reason_in
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.adapted_name import adapted_name

pytestmark = pytest.mark.usefixtures("few_views")

# Without the time, which would be in the names of tests: those of all processes of pytest-xdist must be the same.
ZIPPED = gzip.compress(SPZ, mtime=0)

MADE = [("spz", SPZ), ("spz", ZIPPED), ("ksplat", b"\0\1\0\0" + bytes(6000)), ("splat", RECORD * 3)]


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


def test_of_an_error_without_a_text_its_type_is_told_and_not_how_long_it_took():
    trace = "\n    at Gunzip.onerror (node:internal/streams:149:14)\n✗ failed in 0.211s  [peak cpu=88.9MB]\n"
    assert reason_in("  ✗ TypeError" + trace) == "TypeError" and reason_in("✗ RangeError: too long" + trace) == "too long"
    assert reason_in("✗ failed in 0.2s") == "✗ failed in 0.2s" and reason_in("") == ""


def test_what_the_tool_refuses_is_one_sentence(tmp_path, tool):
    (tmp_path / "a.spz").write_bytes(b"NGSP" + bytes(9))
    assert "splat-transform does not read it (Invalid header)" in sentence(tmp_path / "a.spz")


@pytest.mark.parametrize("answer", ["ply\nformat ascii 1.0\nelement vertex null\nend_header\n", None])
def test_what_is_wrong_with_what_the_tool_made_of_a_file_is_said_of_the_file(tmp_path, tool, answer):
    """And not of a temporary PLY, which nobody knows."""
    if answer:
        (tool / "answer.ply").write_text(answer)
    else:
        columns = read_ply(tool / "answer.ply").columns
        write(tool / "answer.ply", columns | {"x": np.full_like(columns["x"], np.nan)})
    (tmp_path / "a.spz").write_bytes(SPZ)
    assert sentence(tmp_path / "a.spz").startswith(f"{tmp_path / 'a.spz'}, as splat-transform reads it: ")


def test_what_is_doubtful_in_what_the_tool_made_of_a_file_is_said_of_the_file(tmp_path, tool):
    columns = read_ply(tool / "answer.ply").columns
    columns["x"][0] = np.nan
    write(tool / "answer.ply", columns)
    (tmp_path / "a.spz").write_bytes(SPZ)
    with pytest.warns(UserWarning) as caught:
        load_model(tmp_path / "a.spz")
    assert [str(each.message).split(":")[0] for each in caught] == [f"{tmp_path / 'a.spz'}, as splat-transform reads it"]


@pytest.mark.parametrize(("lost", "kind"), [(1, "splat"), (2, "unknown")])
def test_a_splat_file_may_hold_some_records_without_numbers(tmp_path, lost, kind):
    """As its converters leave them where a training did; they are left out like those of a PLY."""
    (tmp_path / "a.splat").write_bytes(RECORD * (3 - lost) + (b"\xff" * 12 + RECORD[12:]) * lost)
    assert kind_of(tmp_path / "a.splat") == kind


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


@pytest.mark.parametrize(("name", "adapted"), [("phone.bin", "phone_x0.25.ply"), ("phone", "phone_x0.25.ply"), ("phone.SPZ", "phone_x0.25.SPZ")])
def test_the_adaptation_of_a_file_with_another_ending_is_a_ply(tmp_path, name, adapted):
    """It was a folder whose name had the ending in its middle."""
    (tmp_path / name).write_bytes(SPZ)
    assert adapted_name(tmp_path / name, 1 / 4).lower() == adapted.lower()


def test_a_sog_whose_checksums_are_wrong_is_refused(tmp_path, tool):
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as stored:
        stored.writestr("meta.json", json.dumps({"version": 2, "means": {"files": ["means_l.webp"]}}))
        stored.writestr("means_l.webp", b"abcd")
    (tmp_path / "a.sog").write_bytes((tmp_path / "a.sog").read_bytes().replace(b"abcd", b"abce"))
    with pytest.raises(CheckpointError, match=r"is damaged \(the checksum of means_l.webp is wrong\)"):
        load_model(tmp_path / "a.sog")


@pytest.mark.parametrize(("content", "why"), [(ZIPPED[:-12], "it is cut off"), (ZIPPED + b"ab", "other bytes follow its end")])
def test_what_is_wrong_with_a_gzipped_spz_is_said(tmp_path, tool, content, why):
    """splat-transform told its time and memory, in place of a reason."""
    (tmp_path / "a.spz").write_bytes(content)
    assert sentence(tmp_path / "a.spz") == f"{tmp_path / 'a.spz'} is damaged ({why}); download or export it again"
    (tmp_path / "a.spz").write_bytes(gzip.compress(SPZ) + gzip.compress(b""))
    assert len(load_model(tmp_path / "a.spz")) == 60


def test_a_second_stream_that_begins_where_a_block_of_the_file_ends_is_no_other_thing(tmp_path, tool, monkeypatch):
    """Of whose two first bytes one is read with the first stream."""
    content = gzip.compress(SPZ)
    monkeypatch.setattr("mipmap_plugin.formats.damage.BLOCK", len(content) + 1)
    (tmp_path / "a.spz").write_bytes(content + gzip.compress(b""))
    assert len(load_model(tmp_path / "a.spz")) == 60


@pytest.mark.parametrize("packed", ["spz", "sog"])
def test_a_bomb_is_not_unpacked(tmp_path, tool, packed):
    path, content = tmp_path / f"a.{packed}", json.dumps({"version": 2, "means": {"files": ["means_l.webp"]}})
    if packed == "spz":
        path.write_bytes(gzip.compress(SPZ + bytes(1 << 20)))
    else:
        archive(path, {"meta.json": content, "means_l.webp": bytes(1 << 20)})
    assert "is damaged (it would be more than 100 times as large unpacked" in sentence(path)
    assert not (tool / "asked.json").exists()


@pytest.mark.parametrize("where", ["a.sog", "room", "room/meta.json"])
def test_sog_as_a_file_and_as_a_folder(tmp_path, tool, where):
    meta = json.dumps({"version": 2, "means": {"files": ["means_l.webp", "means_u.webp"]}})
    archive(tmp_path / "a.sog", {"meta.json": meta, "means_l.webp": ""})
    (tmp_path / "room").mkdir()
    (tmp_path / "room/meta.json").write_text(meta)
    assert len(load_model(tmp_path / where)) == 60
    assert tool_request(tool)[1] == str(tmp_path / ("a.sog" if where == "a.sog" else "room/meta.json"))


def test_npx_is_tried_where_the_tool_is_not_on_the_path(tmp_path, tool):
    """Installed for one project only; nothing is downloaded."""
    (tool / "splat-transform").rename(tool / "real")
    asked = "assert sys.argv[1:3] == ['--no-install', 'splat-transform']"
    answer_by(tool, f"{asked}\nsys.exit(0) if sys.argv[3:] == ['--version'] else os.execv('{tool / 'real'}', ['real', *sys.argv[3:]])", "npx")
    (tmp_path / "a.spz").write_bytes(SPZ)
    assert len(load_model(tmp_path / "a.spz")) == 60
    answer_by(tool, "sys.exit(1)", "npx")
    assert "npm install" in sentence(tmp_path / "a.spz")


def test_certain_opacities_are_finite(tmp_path, tool):
    columns = read_ply(tool / "answer.ply").columns
    columns["opacity"][:2] = np.inf, -np.inf
    write(tool / "answer.ply", columns)
    (tmp_path / "a.spz").write_bytes(SPZ)
    logits = load_model(tmp_path / "a.spz").parameters()["opacities"]
    assert logits.isfinite().all() and logits[0].sigmoid() > 0.99999


def test_a_streamed_sog_is_recognized_too(tmp_path):
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"]}))
    assert detect(tmp_path).family == "exchange"


def test_other_json_is_no_sog(tmp_path):
    (tmp_path / "scene.json").write_text('{"frames": []}')
    assert "no checkpoint that is known here" in sentence(tmp_path / "scene.json")


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


def test_streamed_sog_is_read_by_a_splat_transform_that_knows_it(tmp_path, tool):
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"], "tree": {}}))
    assert len(load_model(tmp_path)) == 60
    assert tool_request(tool)[1] == str(tmp_path / "lod-meta.json")
    answer_by(tool, "print('splat-transform v2.7.1 (b42b60c)', file=sys.stderr)")
    assert sentence(tmp_path).endswith(
        "lod-meta.json is Streamed SOG: splat-transform 2.7.1 is too old for it, and 3.2 or newer is needed, which needs Node.js 22; "
        "run: npm install -g @playcanvas/splat-transform@latest"
    )


@pytest.mark.parametrize("name", ["env/meta.json", "environment.sog"])
def test_the_environment_of_a_streamed_sog_is_read_with_it(tmp_path, tool, name):
    """The sky of a capture, which splat-transform leaves out of a scene."""
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 1, "environment": name, "filenames": ["0_0/meta.json"], "tree": {}}))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("{}")
    assert len(load_model(tmp_path)) == 60
    options, environment, _, _ = tool_request(tool)
    assert (options[-1], environment) == (str(tmp_path / "lod-meta.json"), str(tmp_path / name))


@pytest.mark.parametrize("name", ["environment.sog", "../environment.sog", "https://a.b/environment.sog", "environment.mjs"])
def test_an_environment_that_is_not_in_the_folder_is_refused(tmp_path, tool, name):
    """And not loaded from elsewhere, nor executed."""
    for place in ("environment.sog", "streamed/environment.mjs"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text("{}")
    (tmp_path / "streamed/lod-meta.json").write_text(json.dumps({"lodLevels": 1, "environment": name, "filenames": ["0_0/meta.json"], "tree": {}}))
    assert f"names an environment that is missing, {name}; copy or download its whole folder again" in sentence(tmp_path / "streamed")


@pytest.mark.parametrize("name, advice", [("lod-meta.json", "copy or download its whole folder again"), ("a.sog", "export it again")])
def test_of_a_folder_that_is_not_whole_it_is_said_so(tmp_path, tool, name, advice):
    """As where only the lod-meta.json was downloaded, which names the others."""
    missing = "ENOENT: no such file or directory, stat '0_0/meta.json'"
    answer_by(tool, f'sys.exit("✗ Error: {missing}") if "--version" not in sys.argv else print("splat-transform v3.7.0 (0f60b17)", file=sys.stderr)')
    (tmp_path / name).write_text(json.dumps({"lodLevels": 1, "filenames": ["0_0/meta.json"], "tree": {}}))
    assert sentence(tmp_path / name).endswith(f"is SOG, but splat-transform does not read it ({missing}); {advice}")


def test_a_splat_transform_that_does_not_start_is_no_fault_of_the_file(tmp_path, tool):
    answer_by(tool, "sys.exit(\"Error [ERR_MODULE_NOT_FOUND]: Cannot find package 'webgpu'\")")
    (tmp_path / "a.spz").write_bytes(SPZ)
    assert sentence(tmp_path / "a.spz").endswith(
        "a.spz is SPZ, which splat-transform reads, but splat-transform does not start (Cannot find package 'webgpu'); "
        "run: npm install -g @playcanvas/splat-transform"
    )


def test_an_error_of_node_is_told(tmp_path, tool):
    answer_by(tool, "print('failed in 0.006s')\nsys.exit('TypeError [ERR_PARSE_ARGS_UNKNOWN_OPTION]: Unknown option')")
    with pytest.raises(OutputError, match=r"does not write it \(Unknown option\)"):
        tiny.model().save(tmp_path / "a.spz", provenance={})
