"""What of glTF is not read is said in a sentence."""

import json

import gltf_files
import pytest
import tiny
from exchange_files import sentence
from gltf_files import EXTENSION


def test_meshes_without_splats(tmp_path):
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians()))
    del made["meshes"][0]["primitives"][0]["extensions"]
    assert "is glTF without Gaussian splats" in sentence(gltf_files.write_glb(tmp_path / "a.glb", made, data))


@pytest.mark.parametrize(
    ("path", "to", "told"),
    [
        ((*gltf_files.SAID, "kernel"), "cube", "have the kernel 'cube'"),
        ((*gltf_files.SAID, "colorSpace"), "lin_rec709_display", "its colors are in 'lin_rec709_display', in which its splats are blended too"),
        (("nodes", 0, "scale"), [1, 2, 1], "stretches them unevenly"),
        (("nodes", 0, "scale"), [-1, 1, 1], "mirrors its splats"),
        (("nodes", 0, "scale"), [0, 0, 0], "stretches them unevenly"),
        (("nodes", 0, "children"), [0], "lies in two others"),
        (("accessors", 0, "sparse"), {}, "accessor 0 is sparse"),
        (("bufferViews", 0, "extensions"), {"EXT_meshopt_compression": {}}, "compressed by meshopt"),
        (("bufferViews", 0, "byteStride"), 0, "the rows of view 0 overlap"),
        (("bufferViews", 0, "byteLength"), 10**9, "ends before its view 0"),
        (("accessors", 0, "count"), 10**9, "is a damaged glTF file"),
        (("accessors", 0, "count"), 59, "its attributes do not fit each other"),
        (("accessors", 1, "type"), "VEC3", "its attributes do not fit each other"),
        (("accessors", 0, "bufferView"), 99, "is a damaged glTF file"),
        (("bufferViews", 0, "buffer"), 1, "is a damaged glTF file"),
        (("accessors", 0, "type"), "MAT9", "which lacks 'MAT9'"),
        (("nodes",), [{"children": [*range(1, 102)]}, *[{"mesh": 0}] * 101], "its nodes repeat splats 101 times"),
        (("buffers", 0, "uri"), "../a.bin", "does not lie in its folder"),
        (("buffers", 0, "uri"), "https://example.com/a.bin", "does not lie in its folder"),
    ],
)
def test_what_is_not_read_is_said_in_a_sentence(tmp_path, path, to, told):
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians()))
    assert told in sentence(gltf_files.write_glb(tmp_path / "a.glb", gltf_files.changed(made, *path, to=to), data))


def test_a_file_of_no_splats(tmp_path):
    assert "holds no splats" in sentence(gltf_files.glb(tmp_path / "a.glb", tiny.gaussians(0)))


@pytest.mark.parametrize(
    ("missing", "told"),
    [
        (["SH_DEGREE_1_COEF_2"], "its degrees of spherical harmonics are not whole"),
        (["SH_DEGREE_2_COEF_0"], "its degrees of spherical harmonics are not whole"),
        (["SCALE", "OPACITY"], "lacks SCALE, COLOR_0"),
    ],
)
def test_missing_attributes_are_told_of(tmp_path, missing, told):
    named = gltf_files.attributes(tiny.gaussians(degree=3))
    for name in missing:
        del named[f"{EXTENSION}:{name}"]
    assert told in sentence(gltf_files.write_glb(tmp_path / "a.glb", *gltf_files.document(named)))


def test_a_tileset_names_its_tiles(tmp_path):
    (tmp_path / "tileset.json").write_text(json.dumps({"asset": {"version": "1.1"}, "geometricError": 1, "extensionsUsed": [EXTENSION]}))
    assert "is the tileset of 3D Tiles; give one of its tiles" in sentence(tmp_path / "tileset.json")


def test_a_file_that_is_cut_off_is_damaged(tmp_path):
    path = gltf_files.glb(tmp_path / "a.glb", tiny.gaussians())
    path.write_bytes(path.read_bytes()[:-100])
    assert "is a damaged glTF file" in sentence(path)
