"""SOG and SPZ keep as much of splats as these formats have room for."""

import errno
import gzip
import json
import shutil
import struct
import zipfile
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
from exchange_files import tool_request
from sog_files import as_rgba, columns_of, matched, read_sog

from mipmap_plugin.formats.codebooks import codebook, palette
from mipmap_plugin.formats.sog import completed, write_sog
from mipmap_plugin.formats.spz import refine
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_sog_holds_splats_rounded_to_the_nearest(tmp_path, degree):
    columns = columns_of(degree=degree)
    write_sog(tmp_path / "a.sog", columns, antialiased=degree == 1)
    found, meta = read_sog(tmp_path / "a.sog")
    assert meta.get("model") == ("antialiased" if degree == 1 else None) and ("shN" in meta) == (degree > 0)
    found = matched(columns, found)
    alphas, error = 1 / (1 + np.exp(-columns["opacity"])), {name: np.abs(found[name] - columns[name]) for name in columns if name in found}
    assert np.abs(found["alpha"] - alphas).max() < 0.501 / 255  # rounded, and not down
    assert max(error[axis].max() for axis in "xyz") < 5e-5
    quats = np.stack([columns[f"rot_{i}"] for i in range(4)], 1)
    cosines = np.abs((found["quats"] * quats / np.linalg.norm(quats, axis=1, keepdims=True)).sum(1))
    assert (1 - cosines).max() < 2.5e-5
    rest = [error[f"f_rest_{i}"] for i in range(3 * ((degree + 1) ** 2 - 1))]
    assert all(part.max() < 0.02 for part in rest)  # each splat has an entry of its own in the table
    lengths = np.stack([error[f"scale_{i}"] for i in range(3)])
    assert lengths[:, :5].max() < 1e-3 and lengths.max() < 0.1  # those that cover the picture are the most exact
    write_sog(tmp_path / "b.sog", columns, antialiased=degree == 1)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


@pytest.mark.parametrize("count", [1, 2, 17])
def test_few_splats_and_equal_ones_are_kept_as_they_are(tmp_path, count):
    columns = {name: np.full(count, column[0]) for name, column in columns_of(1).items()}
    columns |= {f"rot_{i}": np.zeros(count, np.float32) for i in range(4)}
    write_sog(tmp_path / "a.sog", columns, antialiased=False)
    found, _ = read_sog(tmp_path / "a.sog")
    kept = [name for name in columns if name in found]
    assert all(np.allclose(found[name], columns[name], atol=1e-6) for name in kept) and len(kept) == 3 + 3 + 3 + 45
    assert np.allclose(found["quats"], [[1, 0, 0, 0]], atol=0.01)


@pytest.mark.parametrize("different", [1, 3, 20])
def test_colors_of_which_there_are_few_survive_a_canvas(tmp_path, different):
    """Babylon.js decodes images on one, which keeps a color times its opacity, in 8 bits: of few splats, or of equal ones, colors were wrong."""
    columns = columns_of(60, degree=0)
    columns |= {f"f_dc_{i}": np.resize(columns[f"f_dc_{i}"][:different], 60) for i in range(3)} | {"opacity": np.linspace(-1, 5, 60)}
    write_sog(tmp_path / "a.sog", columns, antialiased=False)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        pixels, codes = as_rgba(archive.read("sh0.webp")).reshape(-1, 4)[:60], np.array(json.loads(archive.read("meta.json"))["sh0"]["codebook"])
    colors, alphas = pixels[:, :3], pixels[:, 3:]
    kept = np.minimum(np.rint(np.rint(colors * alphas / 255) * 255 / alphas), 255).astype(int)
    assert (kept != colors).any() and np.array_equal(codes[kept], codes[colors])


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("told", [{"palette_size": 40}, {}])
def test_a_table_that_does_not_say_how_many_entries_it_has_is_told_of(tmp_path, tool, packed, told):
    """As LichtFeld Studio of 2025 wrote it; splat-transform, which then reads harmonics as 0, gets a copy that says it."""
    write_sog(tmp_path / "whole.sog", columns_of(40, 1), antialiased=False)
    assert completed(tmp_path / "whole.sog", tmp_path) == tmp_path / "whole.sog"
    (tmp_path / "room").mkdir()
    source = tmp_path / ("a.sog" if packed else "room/meta.json")
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive, zipfile.ZipFile(tmp_path / "a.sog", "w") as out:
        meta = json.loads(archive.read("meta.json"))
        del meta["shN"]["count"]
        meta["shN"] |= told
        for name in archive.namelist():
            out.writestr(name, json.dumps(meta) if name == "meta.json" else archive.read(name))
        out.extractall(tmp_path / "room")
    (tmp_path / "copy").mkdir()
    copy = completed(source, tmp_path / "copy")
    found = json.loads(zipfile.ZipFile(copy).read("meta.json") if packed else copy.read_text())
    assert found == {**meta, "shN": {**meta["shN"], "count": told.get("palette_size", 1 << 16)}}
    assert len(zipfile.ZipFile(copy).namelist() if packed else list((tmp_path / "copy").iterdir())) == 8
    model = load_model(source)
    assert model.source == source and tool_request(tool)[1] not in (str(source), str(copy))


@pytest.mark.parametrize("further", [(), ("other/meta.json",)])
def test_a_folder_that_was_packed_as_such_is_read(tmp_path, further):
    """As the menus of file managers do; splat-transform looks for meta.json at the top. Which one of several is meant nobody knows."""
    write_sog(tmp_path / "whole.sog", columns_of(40, 1), antialiased=False)
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive, zipfile.ZipFile(tmp_path / "a.zip", "w") as out:
        whole = {name: archive.read(name) for name in archive.namelist()}
        for name in ("scene/", "__MACOSX/scene/._meta.json", *further):
            out.writestr(name, b"")
        for name, content in whole.items():
            out.writestr(f"scene/{name}", content)
    (tmp_path / "copy").mkdir()
    copy = completed(tmp_path / "a.zip", tmp_path / "copy")
    if further:
        assert copy == tmp_path / "a.zip"
    else:
        with zipfile.ZipFile(copy) as archive:
            read = {name: archive.read(name) for name in archive.namelist()}
        assert {name: read[name] for name in whole if name != "meta.json"} == {name: whole[name] for name in whole if name != "meta.json"}
        assert json.loads(read["meta.json"]) == json.loads(whole["meta.json"]) and read.keys() == whole.keys()


def test_a_full_disk_is_not_taken_for_damage(tmp_path, monkeypatch):
    """The file was read without its copy then, and lost its view-dependent colors without a word."""
    write_sog(tmp_path / "whole.sog", columns_of(40, 1), antialiased=False)
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive:
        archive.extractall(tmp_path)
    (tmp_path / "meta.json").write_text((tmp_path / "meta.json").read_text().replace('"count": 40, "bands"', '"bands"'))
    (tmp_path / "copy").mkdir()
    assert completed(tmp_path / "meta.json", tmp_path / "copy") == tmp_path / "copy/meta.json"

    monkeypatch.setattr(shutil, "copyfile", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        completed(tmp_path / "meta.json", tmp_path / "copy")


def test_numbers_that_have_room_in_a_code_book_are_exact():
    values = np.random.default_rng(0).normal(size=200)[np.random.default_rng(1).integers(0, 200, (500, 3))]
    codes, labels = codebook(values, np.ones_like(values))
    assert len(codes) == 256 and np.array_equal(codes[labels], values)


@pytest.mark.parametrize("outlier", [1e3, -1e5, 1e12])
def test_a_number_far_from_all_others_takes_no_codes_from_them(outlier):
    values = np.random.default_rng(0).normal(0, 0.5, 6000)
    values[7] = outlier
    codes, labels = codebook(values, np.where(values == outlier, 1e-3, 1.0))
    error = np.abs(codes[labels] - values)
    assert np.delete(error, 7).mean() < 0.008 and error[7] < 0.05 * abs(outlier)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("length", [14, 20, 27])
def test_a_huge_splat_leaves_others_their_size_and_an_opacity_may_be_far_below_0(tmp_path, length):
    columns = columns_of()
    columns["scale_0"][7], columns["opacity"][8] = length, -1000
    write_sog(tmp_path / "a.sog", columns, antialiased=False)
    found = matched(columns, read_sog(tmp_path / "a.sog")[0])
    error = np.stack([np.delete(np.abs(found[name] - columns[name]), 7) for name in ("scale_0", "scale_1", "scale_2")])
    assert error.max() < 0.25 and abs(found["scale_0"][7] - length) < 0.01


def test_a_splat_without_thickness_takes_no_codes_from_others(tmp_path):
    columns = columns_of()
    columns["scale_0"][::3] = -87
    write_sog(tmp_path / "a.sog", columns, antialiased=False)
    found = matched(columns, read_sog(tmp_path / "a.sog")[0])
    assert np.abs(found["scale_1"] - columns["scale_1"]).max() < 0.15 and (found["scale_0"] - found["scale_1"])[::3].max() < -8


def test_a_palette_with_too_little_room_is_closest_where_the_weight_is():
    draw = np.random.default_rng(0)
    vectors, weights = draw.normal(size=(2000, 9)).astype(np.float32), np.ones(2000)
    weights[:100] = 1000
    entries, labels = palette(vectors, weights, 400)
    error = ((entries[labels] - vectors) ** 2).sum(1)
    assert len(entries) <= 400 and error[:100].mean() < 0.5 < error.mean() < 5
    assert np.array_equal(palette(vectors, weights, 400)[1], labels)


def test_a_palette_does_not_depend_on_the_callers_defaults():
    vectors = np.random.default_rng(0).normal(size=(2000, 9)).astype(np.float32)
    expected = palette(vectors, np.ones(2000), 400)
    torch.set_default_dtype(torch.float64)
    try:
        assert all(np.array_equal(*pair) for pair in zip(expected, palette(vectors, np.ones(2000), 400), strict=True))
    finally:
        torch.set_default_dtype(torch.float32)


def spz_of(columns, degree, version=3):
    """As its usual writer makes it, with 12 bits of fractions; but all places and harmonics are 0, and what lies between is not of these splats."""
    count = len(columns["x"])
    header = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 1, 0)
    return gzip.compress(header + bytes(9 * count) + bytes(range(11)) * count + bytes(count * 3 * ((degree + 1) ** 2 - 1)))


def test_an_spz_has_its_harmonics_in_8_bits(tmp_path):
    columns = columns_of(20, degree=2)
    columns["f_rest_4"][3], columns["f_rest_5"][4] = 2.0, -2.0  # which are cut off
    (tmp_path / "a.spz").write_bytes(spz_of(columns, 2))
    refine(tmp_path / "a.spz", columns)
    assert (tmp_path / "a.spz").read_bytes()[4:8] == bytes(4)  # no date: the same splats have the same bytes
    written = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert written[16 + 9 * 20 : -20 * 24] == bytes(range(11)) * 20
    rest = (np.frombuffer(written[-20 * 24 :], np.uint8).reshape(20, 8, 3).astype(float) - 128) / 128
    expected = np.stack([columns[f"f_rest_{i}"] for i in range(24)], 1).reshape(20, 3, 8).swapaxes(1, 2)
    assert np.abs(rest - np.clip(expected, -1, 127 / 128)).max() <= 0.5 / 128 + 1e-6


@pytest.mark.parametrize(("farthest", "fraction"), [(1e-3, 24), (0.9, 23), (18.4, 18), (2047.9, 12), (2048, 11), (0.0, 24)])
def test_an_spz_has_its_places_in_as_many_bits_as_fit(tmp_path, farthest, fraction):
    """Steps of 1/4096 unit moved the smallest splats of a capture by more than their size, and cost up to 2 dB."""
    columns = columns_of(20, degree=0)
    for axis in "xyz":
        columns[axis] *= np.float32(farthest) / np.abs(columns[axis]).max()
    (tmp_path / "a.spz").write_bytes(spz_of(columns, 0))
    refine(tmp_path / "a.spz", columns)
    written = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert written[:16] == struct.pack("<4sIIBBBB", b"NGSP", 3, 20, 0, fraction, 1, 0) and written[16 + 9 * 20 :] == bytes(range(11)) * 20
    low, middle, high = np.frombuffer(written[16 : 16 + 9 * 20], np.uint8).reshape(20, 3, 3).astype(int).transpose(2, 0, 1)
    codes = low + 256 * middle + 65536 * np.where(high < 128, high, high - 256)
    assert np.abs(codes / 2**fraction - np.stack([columns[axis] for axis in "xyz"], 1)).max() <= 0.5 / 2**fraction


def test_an_spz_of_another_version_stays_as_it_is(tmp_path):
    columns = columns_of(20, degree=1)
    (tmp_path / "a.spz").write_bytes(before := spz_of(columns, 1, version=2))
    refine(tmp_path / "a.spz", columns)
    assert (tmp_path / "a.spz").read_bytes() == before


def test_saving_writes_so(tmp_path, tool):
    model = tiny.model(trained=TrainedScale("antialiased"))
    model.save(tmp_path / "a.sog", provenance={})
    found, meta = read_sog(tmp_path / "a.sog")
    assert meta["count"] == len(model) and meta["model"] == "antialiased"
    assert np.allclose(np.sort(found["x"]), model.parameters()["means"][:, 0].sort().values, atol=1e-3)
    spz = spz_of({"x": range(len(model))}, model.sh_degree)
    with (tool / "splat-transform").open("a") as script:
        script.write(f"pathlib.Path(target).write_bytes({spz!r})\n")
    model.save(tmp_path / "a.spz", provenance={})
    last = gzip.decompress((tmp_path / "a.spz").read_bytes())[-1]
    assert abs((last - 128) / 128 - float(model.parameters()["shN"][-1, -1, -1])) <= 0.5 / 128 + 1e-6
