"""PLY files: every kind that the format allows is read alike, and every broken one is refused in one sentence."""

import re
import warnings

import numpy as np
import pytest
from ply_files import splat_columns, write, write_splats

from mipmap_plugin.errors import CheckpointError, OutputExists, SettingsError
from mipmap_plugin.formats.ply import read_header, read_ply, write_ply


def header(*lines: str) -> bytes:
    return "\n".join(["ply", *lines, ""]).encode()


F4 = "property float x"


@pytest.mark.parametrize("newline", ["\n", "\r", "\r\n"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_reads_every_encoding_alike(tmp_path, form, newline):
    columns = splat_columns(7)
    file = read_ply(write(tmp_path / "a.ply", columns, form, newline, ("made by hand",)))
    assert (list(file.columns), file.comments) == (list(columns), ("made by hand",))
    for name, column in columns.items():
        np.testing.assert_array_equal(file.columns[name], column)


def test_a_file_is_not_overwritten_unasked(tmp_path):
    path = write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.float32)})
    with pytest.raises(OutputExists):
        write_ply(path, {"x": np.ones(1, np.float32)})
    assert read_ply(path).columns["x"].tolist() == [0]


def test_body_that_starts_with_a_newline_byte_after_a_cr_header(tmp_path):
    value = np.frombuffer(b"\n\r\n\x41", "<f4")
    file = read_ply(write(tmp_path / "a.ply", {"x": value}, newline="\r"))
    assert file.columns["x"].tobytes() == value.tobytes()


def test_line_breaks_may_be_mixed_and_the_last_one_missing(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat ascii 1.0\r\nelement vertex 2\nproperty float x\r\nend_header\r\n3\n4")
    assert read_ply(tmp_path / "a.ply").columns["x"].tolist() == [3, 4]


def test_mixed_types_keep_their_values(tmp_path):
    columns = {"x": np.array([0.1]), "id": np.array([2**31 - 1], np.int32), "red": np.array([255], np.uint8)}
    held = read_ply(write(tmp_path / "a.ply", columns)).columns
    assert [held[name][0] for name in columns] == [0.1, 2**31 - 1, 255]


def test_text_holds_the_largest_numbers_of_each_type(tmp_path):
    lines = header("format ascii 1.0", "element vertex 1", "property uint a", "property char b", "property double c", "end_header")
    (tmp_path / "a.ply").write_bytes(lines + b"4294967295 -128 0.1\n")
    held = read_ply(tmp_path / "a.ply").columns
    assert [(column.dtype, column[0]) for column in held.values()] == [(np.uint32, 2**32 - 1), (np.int8, -128), (np.float64, 0.1)]


def test_keeps_comments_and_obj_info_of_any_alphabet(tmp_path):
    lines = header("format ascii 1.0", "comment Brüder", "element vertex 1", "obj_info two", "comment three", "property float x", "end_header")
    (tmp_path / "a.ply").write_bytes(lines.replace(b"\xc3\xbc", b"\xfc") + b"1\n")
    assert read_ply(tmp_path / "a.ply").comments == ("Br\ufffdder", "two", "three")


@pytest.mark.parametrize("before", [b"element camera 2\nproperty uchar k\n", b"element face 1\nproperty list uchar int i\n"])
def test_skips_elements_before_the_vertices(tmp_path, before):
    body = b"\x01\x02" if b"camera" in before else b"\x00"
    text = b"ply\nformat binary_little_endian 1.0\n" + before + b"element vertex 1\nproperty float x\nend_header\n"
    (tmp_path / "a.ply").write_bytes(text + body + np.float32(3).tobytes())
    assert read_ply(tmp_path / "a.ply").columns["x"].tolist() == [3]


def test_ignores_elements_after_the_vertices(tmp_path):
    text = header("format ascii 1.0", "element vertex 1", "property float x", "element face 1", "property list uchar int i", "end_header")
    (tmp_path / "a.ply").write_bytes(text + b"3\n2 0 0\n")
    assert read_ply(tmp_path / "a.ply").columns["x"].tolist() == [3]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_reads_no_rows(tmp_path, form):
    assert len(read_ply(write(tmp_path / "a.ply", splat_columns(0), form)).columns["x"]) == 0


def test_surplus_bytes_are_tolerated_with_a_note(tmp_path):
    path = write_splats(tmp_path / "a.ply")
    path.write_bytes(path.read_bytes() + b"123")
    file = read_ply(path)
    assert len(file.columns["x"]) == 5
    assert "3 bytes more" in file.notes[0]


def test_elements_that_are_left_out_are_told_of(tmp_path):
    others = [f"element e{i} 1" for i in range(7)]
    text = header("format ascii 1.0", "element face 0", F4, "element vertex 1", F4, *(part for each in others for part in (each, F4)), "end_header")
    (tmp_path / "a.ply").write_bytes(text + b"1\n" * 8)
    [note] = read_ply(tmp_path / "a.ply").notes
    assert note == "beside its splats it holds e0, e1, e2, e3, e4, ..., which are left out of files that are made of it"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("prefix", ["scalar_", "scal_", "scalar_scal_"])
def test_columns_that_cloudcompare_named_have_their_own_names(tmp_path, prefix, form):
    columns = splat_columns(3)
    kept = ("x", "y", "z", "nx", "ny", "nz")
    file = read_ply(write(tmp_path / "a.ply", {name if name in kept else prefix + name: column for name, column in columns.items()}, form))
    assert list(file.columns) == list(columns)
    np.testing.assert_array_equal(file.columns["rot_3"], columns["rot_3"])
    assert f"CloudCompare gives them ({prefix}f_dc_0 and others)" in file.notes[0]


def test_a_column_keeps_a_prefix_whose_name_is_taken(tmp_path):
    columns = {"x": np.zeros(2, np.float32), "scalar_x": np.ones(2, np.float32), "scalar_f_dc_0": np.ones(2, np.float32)}
    assert list(read_ply(write(tmp_path / "a.ply", columns)).columns) == ["x", "scalar_x", "f_dc_0"]


def test_misdeclared_colors_of_nerfstudio_are_read_as_rgb(tmp_path):
    text = header("format binary_little_endian 1.0", "element vertex 2", "property uchar colors", "property uchar opacity", "end_header")
    (tmp_path / "a.ply").write_bytes(text + bytes([1, 2, 3, 9, 4, 5, 6, 8]))
    columns = read_ply(tmp_path / "a.ply").columns
    assert {name: column.tolist() for name, column in columns.items()} == {"red": [1, 4], "green": [2, 5], "blue": [3, 6], "opacity": [9, 8]}


MALFORMED = {
    "empty": (b"", "is empty"),
    "lfs": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345678\n", r"12,345,678 bytes; run `git lfs pull`"),
    "html": (b"\n<!DOCTYPE html><html>", "web page"),
    "json": (b'{"error": "not found"}', "server's error message"),
    "not ply": (b"plyer\n", "not a PLY"),
    "no end": (header("format ascii 1.0", "element vertex 3"), "no end_header"),
    "endless": (b"ply\n" + b"comment no end\n" * 20_000, "no end_header in its first 128 kB"),
    "no format": (header("element vertex 1", F4, "end_header") + b"1\n", "no `format`"),
    "format": (header("format text 1.0", "end_header"), "line 2 .* cannot be read"),
    "keyword": (header("format ascii 1.0", "elephant", "end_header"), "line 3 .* cannot be read: 'elephant'"),
    "type": (header("format ascii 1.0", "element vertex 1", "property half x", "end_header"), "line 4 .* type half PLY does not have; export"),
    "property first": (header("format ascii 1.0", F4, "end_header"), "line 3 .* cannot be read"),
    "no type": (header("format ascii 1.0", "element vertex 1", "property x", "end_header"), "line 4 .* cannot be read: 'property x'"),
    "two types": (header("format ascii 1.0", "element vertex 1", "property float float x", "end_header"), "line 4 .* cannot be read"),
    "list of one type": (header("format ascii 1.0", "element vertex 1", "property list float x", "end_header"), "type list PLY does not have"),
    "twice": (header("format ascii 1.0", "element vertex 1", F4, F4, "end_header"), "line 5 .* read: .*, the second property of this name; export"),
    "negative": (header("format ascii 1.0", "element vertex -1", F4, "end_header"), "line 3 .* cannot be read"),
    "no count": (header("format ascii 1.0", "element vertex", F4, "end_header"), "line 3 .* cannot be read"),
    "no vertex": (header("format ascii 1.0", "element face 1", F4, "end_header") + b"1\n", "no vertex element"),
    "by degree": (
        header("format ascii 1.0", "element vertex_0 1", F4, "element vertex_1 1", F4, "end_header") + b"1\n2\n",
        r"an element of splats for each SH degree \(vertex_0, ...\), as Reduced-3DGS writes",
    ),
    "two vertex": (
        header("format ascii 1.0", "element vertex 1", F4, "element face 1", F4, "element vertex 2", F4, "end_header") + b"1\n2\n3\n4\n",
        "has 2 vertex elements, and 2 rows would be lost; export the file again with one element",
    ),
    "no property": (header("format ascii 1.0", "element vertex 99999999999999", "end_header"), "no vertex element"),
    "list": (header("format ascii 1.0", "element vertex 1", "property list uchar float x", "end_header") + b"1 1\n", "list properties"),
    "truncated": (header("format binary_little_endian 1.0", "element vertex 1000", F4, "end_header") + bytes(4 * 990 + 3), "10 of them are missing"),
    "hostile": (header("format binary_little_endian 1.0", "element vertex 99999999999999", F4, "end_header") + bytes(8), "99,999,999,999,997"),
    "hostile ascii": (header("format ascii 1.0", "element vertex 99999999999999", F4, "end_header") + b"1\n2\n", "are missing"),
    "short ascii": (header("format ascii 1.0", "element vertex 2", F4, "end_header") + b"1.00\n", "damaged or truncated"),
    "words": (header("format ascii 1.0", "element vertex 1", F4, "end_header") + b"one\n", "damaged or truncated"),
    "too large": (header("format ascii 1.0", "element vertex 1", "property uchar x", "end_header") + b"300\n", "300 is no uchar, which x is decl"),
    "a fraction": (header("format ascii 1.0", "element vertex 1", "property int x", "end_header") + b"1.5\n", "1.5 is no int, which x is declared"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_refuses_malformed_files_in_one_sentence(tmp_path, case):
    content, sentence = MALFORMED[case]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(CheckpointError, match=sentence) as caught:
        read_ply(tmp_path / "a.ply")
    assert str(tmp_path / "a.ply") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refuses_what_is_not_there(tmp_path):
    with pytest.raises(CheckpointError, match="cannot be read: No such file"):
        read_header(tmp_path / "none.ply")


def test_writes_what_it_reads(tmp_path):
    columns = {**splat_columns(9), "segment": np.arange(9, dtype=np.int32)}
    columns["x"][0], columns["y"][0] = np.nan, -np.inf
    file = read_ply(write_ply(tmp_path / "a.ply", columns, ["first", "Brüder\nsecond"]))
    assert file.comments == ("first", "Br\\xfcder second")
    assert {name: column.tobytes() for name, column in file.columns.items()} == {name: column.tobytes() for name, column in columns.items()}


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("coding", ["utf-8", "latin-1"])
def test_names_of_columns_may_have_any_letters(tmp_path, coding, form):
    """As scalar fields of CloudCompare do: plyfile refused to write them, at the end of an adaptation."""
    path = write(tmp_path / "a.ply", {"x": np.zeros(2, np.float32), "hoehe": np.ones(2, np.float32), "laenge": np.ones(2, np.float32)}, form)
    path.write_bytes(path.read_bytes().replace(b"hoehe", "höhe".encode(coding)).replace(b"laenge", "länge".encode(coding)))
    held = read_ply(path).columns
    assert [name.isascii() for name in held] == [True] * 3
    again = read_ply(write_ply(tmp_path / "b.ply", held)).columns
    assert {name: column.tolist() for name, column in again.items()} == {name: column.tolist() for name, column in held.items()}


def test_refuses_comments_that_it_could_not_read_back(tmp_path):
    with pytest.raises(SettingsError, match=re.escape("131,072")):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.float32)}, ["x" * 140_000])
    assert not list(tmp_path.iterdir())


def test_reads_every_real_file_without_a_warning(shared_data):
    files = sorted((shared_data / "checkpoints").rglob("*.ply"))
    assert files
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in files:
            file = read_ply(path)
            assert len(file.columns["x"]) == read_header(path).vertex.count
            assert not file.notes
