"""Exchange formats are told by their bytes, whatever they are called, and answered with the one command that makes a PLY."""

import gzip
import json
import shlex
import shutil
import struct
import zipfile

import numpy as np
import pytest
from ply_files import write

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models import load_model
from mipmap_plugin.models.ply import read_ply

# FORMATS §13, T5: a real record of a .splat file.
RECORD = bytes.fromhex("7a72abc1b6e792c1f011b5c1b6cbe23f9f59683f0c309c4075c9fffff779599a")
# Niantic's header: magic, version 3, one point, SH degree 0, 12 fractional bits, no flags.
SPZ = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20)

MADE = [("spz", SPZ), ("spz", gzip.compress(SPZ)), ("ksplat", b"\0\1\0\0" + bytes(6000)), ("splat", RECORD * 3)]


def sentence(path):
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    return str(caught.value)


def commands(path):
    """The commands that the sentence names, split as a shell splits them."""
    return [shlex.split(part) for part in sentence(path).partition("convert it first: ")[2].split(" && ")]


@pytest.mark.parametrize(("ending", "content"), MADE, ids=["spz v4", "spz v2", "ksplat", "splat"])
def test_a_file_is_told_by_its_bytes_and_gets_its_command(tmp_path, ending, content):
    path = tmp_path / f"my scene.{ending}"
    path.write_bytes(content)
    assert f"is {ending.upper()}, an exchange format" in sentence(path)
    assert commands(path) == [["splat-transform", str(path), str(tmp_path / "my scene.ply")]]


@pytest.mark.parametrize("name", ["scene.bin", "scene.ply", "scene"])
def test_a_file_with_a_strange_name_is_first_copied_to_the_one_that_splat_transform_knows(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(SPZ)
    spz, ply = str(tmp_path / "scene.spz"), str(tmp_path / ("scene-plain.ply" if name == "scene.ply" else "scene.ply"))
    assert commands(path) == [["cp", str(path), spz], ["splat-transform", spz, ply]]


def test_a_version_in_the_name_is_kept(tmp_path):
    (tmp_path / "scene.v2.spz").write_bytes(SPZ)
    assert commands(tmp_path / "scene.v2.spz")[0][2] == str(tmp_path / "scene.v2.ply")


@pytest.mark.parametrize(("name", "plain"), [("a.compressed.ply", "a.ply"), ("a.ply", "a-plain.ply")])
def test_compressed_ply_is_not_converted_onto_itself(tmp_path, name, plain):
    write(tmp_path / name, {"packed_position": np.zeros(1, np.int32)})
    assert "is compressed PLY" in sentence(tmp_path / name)
    assert commands(tmp_path / name) == [["splat-transform", str(tmp_path / name), str(tmp_path / plain)]]


def test_sog_as_a_file_and_as_a_folder(tmp_path):
    meta = json.dumps({"version": 2, "means": {"files": ["means_l.webp", "means_u.webp"]}})
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", meta)
        archive.writestr("means_l.webp", "")
    (tmp_path / "room").mkdir()
    (tmp_path / "room/meta.json").write_text(meta)
    assert commands(tmp_path / "a.sog") == [["splat-transform", str(tmp_path / "a.sog"), str(tmp_path / "a.ply")]]
    expected = [["splat-transform", str(tmp_path / "room/meta.json"), str(tmp_path / "room/room.ply")]]
    assert commands(tmp_path / "room") == commands(tmp_path / "room/meta.json") == expected


def test_a_streamed_sog_is_told_too(tmp_path):
    (tmp_path / "lod-meta.json").write_text(json.dumps({"lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"]}))
    assert "is SOG" in sentence(tmp_path)


def test_other_json_is_no_sog(tmp_path):
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    assert "no checkpoint that is known here" in sentence(tmp_path / "transforms.json")
    (tmp_path / "scene.gltf").write_text('{"asset": {}, "extensionsUsed": ["KHR_gaussian_splatting"]}')
    assert "is glTF" in sentence(tmp_path / "scene.gltf")


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


@pytest.mark.parametrize("kind", ["SPZ", "SOG", "SPLAT", "compressed PLY"])
def test_a_real_capture_in_each_format_under_any_name(shared_data, tmp_path, kind):
    source = shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply"
    path = tmp_path / "capture.dat"
    if kind in ("SPZ", "SOG"):
        published = source.with_suffix(f".{kind.lower()}")
        assert f"is {kind}, an exchange format" in sentence(published)
        assert commands(published) == [["splat-transform", str(published), str(source)]]
        shutil.copyfile(published, path)
    else:
        path.write_bytes({"SPLAT": as_splat, "compressed PLY": as_compressed_ply}[kind](read_ply(source).columns))
    assert f"is {kind}, an exchange format" in sentence(path)
    assert commands(path)[-1][0] == "splat-transform"


def test_the_ply_of_the_same_capture_loads(shared_data):
    assert len(load_model(shared_data / "checkpoints/yashica-t4/yashica-t4-top8192.ply")) == 8192
