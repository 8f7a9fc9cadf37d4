"""The SOGs of Streamed SOG hold the levels' splats as closely as single ones."""

import json

import numpy as np
import pytest
from sog_files import columns_of, matched, read_sog, read_unpacked

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats import streamed_sog
from mipmap_plugin.formats.ply import write_ply
from mipmap_plugin.formats.sog import write_sog
from mipmap_plugin.formats.streamed_sog import DIGITS, write_streamed_sog


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("count", [2, 60, DIGITS + 1, 3 * DIGITS])
def test_each_file_holds_its_splats_in_the_order_that_splat_transform_chose(tmp_path, tool, count, degree):
    scenes = [columns_of(count, degree, seed) for seed in range(2)]
    levels = [write_ply(tmp_path / f"level_{number}.ply", columns) for number, columns in enumerate(scenes)]
    write_streamed_sog(levels, tmp_path / "lod-meta.json", 1)
    for number, columns in enumerate(scenes):
        for half, rows in enumerate(np.array_split(np.arange(count)[::-1], 2)):
            own = {name: column[rows] for name, column in columns.items()}
            found, meta = read_unpacked(tmp_path / f"{number}_{half}")
            write_sog(single := tmp_path / f"{number}_{half}.sog", own, antialiased=True)
            expected, of_single = read_sog(single)
            expected = matched(own, expected)
            assert all(np.allclose(found[name], expected[name], atol=1e-6) for name in expected) and found.keys() == expected.keys()
            assert (meta["version"], meta["count"], meta["model"], "shN" in meta) == (2, len(rows), of_single["model"], degree > 0)


def test_splat_transform_gets_no_more_than_it_needs_and_runs_once_for_each_digit(tmp_path, tool, monkeypatch):
    given = []

    def written(path, columns, comments):
        given.append({name for name, column in columns.items() if column.any()})
        write_ply(path, columns, comments)

    levels = [write_ply(tmp_path / f"{count}.ply", columns_of(count, 1)) for count in (DIGITS, DIGITS + 1)]
    monkeypatch.setattr("mipmap_plugin.formats.streamed_sog.write_ply", written)
    write_streamed_sog(levels[:1], tmp_path / "one" / "lod-meta.json", 1)
    places = {"x", "y", "z", "opacity", *(f"rot_{i}" for i in range(4))}
    assert given == [places | {"scale_0", "scale_1", "scale_2"}]
    write_streamed_sog(levels[1:], tmp_path / "two" / "lod-meta.json", 1)
    assert given[1:] == [given[0], places]
    words = json.loads((tmp_path / "two" / "lod-meta.json").read_text())["asked"]
    assert words[words.index("--lod-chunk-count") + 1] == "32" and "--sh-iterations" not in words


def test_a_version_that_loses_a_splat_is_told_of(tmp_path, tool):
    level = write_ply(tmp_path / "level_0.ply", columns_of(20, 1), ["twice"])
    with pytest.raises(OutputError, match=r"splat-transform did not write each splat of level_0.ply once; run: npm install -g .*@3.7$"):
        write_streamed_sog([level], tmp_path / "lod-meta.json", 1)


@pytest.mark.parametrize(("key", "other"), [("filenames", "files"), ("tree", "root"), ("sh0", "colors")])
def test_a_version_that_writes_something_unknown_is_told_of(tmp_path, tool, monkeypatch, key, other):
    monkeypatch.setattr(streamed_sog, "read_json", lambda file: json.loads(file.read_text().replace(f'"{key}"', f'"{other}"')))
    level = write_ply(tmp_path / "level_0.ply", columns_of(20, 1))
    with pytest.raises(OutputError, match=r"splat-transform did not write each splat of level_0.ply once; run: npm install -g .*@3.7$"):
        write_streamed_sog([level], tmp_path / "lod-meta.json", 1)
