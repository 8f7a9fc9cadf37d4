"""What viewers of levels read: distances of PlayCanvas's rule, geometric errors of 3D Tiles, and files through splat-transform."""

import json
import math
import sys

import pytest
import tiny

from mipmap_plugin import cli
from mipmap_plugin.errors import OutputError, OutputExists, SettingsError
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.levels.manifest import MANIFEST
from mipmap_plugin.levels.streamed import distances, progression, viewer_settings, write_streamed
from mipmap_plugin.levels.tiles import SCREEN_ERROR, bounding_box, errors, tileset, write_tiles

# A stand-in for splat-transform: it writes its arguments to the output, and fails for a file of no bytes.
STAND_IN = """#!{python}
import json, pathlib, sys
*words, target = sys.argv[1:]
if any(word.endswith(".ply") and not pathlib.Path(word).stat().st_size for word in words):
    sys.exit("Invalid header")
pathlib.Path(target).write_text(json.dumps(words))
"""

LADDER = {
    "base_pixel": 0.01,
    "levels": [{"file": f"level_{number}.ply", "scale": 0.5**number} for number in range(3)],
    "switches": [{"zoom": 0.7}, {"zoom": 0.35}],
}


@pytest.fixture
def tool(tmp_path, monkeypatch):
    """The only program on the path."""
    place = tmp_path / "bin"
    place.mkdir()
    (place / "splat-transform").write_text(STAND_IN.format(python=sys.executable))
    (place / "splat-transform").chmod(0o755)
    monkeypatch.setenv("PATH", str(place))


@pytest.fixture
def ladder(tmp_path):
    """A ladder's folder."""
    for level in LADDER["levels"]:
        tiny.ply(tmp_path / "ladder" / level["file"])
    write_json(tmp_path / "ladder" / MANIFEST, LADDER, overwrite=False)
    return tmp_path / "ladder"


def test_a_switch_lies_at_the_distance_where_a_base_pixel_has_its_zoom():
    """A canvas of 1000 px and a field of view of 45 degrees: at that distance a length of one base pixel covers 0.7 px."""
    focal = 500 / math.tan(math.radians(22.5))
    near, far = distances(LADDER, 1000)
    assert focal / near * 0.01 == pytest.approx(0.7) and focal / far * 0.01 == pytest.approx(0.35)


def test_distances_become_a_geometric_progression():
    assert progression([5, 15, 45], 9.0) == pytest.approx((5, 3))
    assert progression([5], 2.0) == pytest.approx((5, 2))
    base, multiplier = progression([1, 2, 5], 9.0)
    assert multiplier == pytest.approx(5**0.5) and base * multiplier == pytest.approx(10 ** (1 / 3))


def test_a_page_is_told_to_keep_the_distances():
    settings = viewer_settings(LADDER, 1000)
    assert settings["lodMultiplier"] == pytest.approx(2) and settings["lodBaseDistance"] == pytest.approx(distances(LADDER, 1000)[0])
    assert settings["splatBudgetMode"] == "limit"
    with pytest.raises(SettingsError, match="a single level"):
        viewer_settings(LADDER | {"switches": []})


def test_a_tile_is_replaced_at_its_switch():
    """Seen at the zoom 0.7, a base pixel of 0.01 units has 0.7 px, so that the error of the tile that is replaced there has 16."""
    assert errors(LADDER)[0] == 0
    assert [error / 0.01 * zoom for error, zoom in zip(errors(LADDER)[1:], (0.7, 0.35), strict=True)] == pytest.approx([SCREEN_ERROR] * 2)


def test_tiles_go_from_the_coarsest_to_the_finest():
    made = tileset(LADDER, [0.0] * 12)
    tile, uris = made["root"], []
    while True:
        uris.append(tile["content"]["uri"])
        assert tile["refine"] == "REPLACE" and len(tile["boundingVolume"]["box"]) == 12
        if "children" not in tile:
            break
        assert tile["children"][0]["geometricError"] < tile["geometricError"] < made["geometricError"]
        tile = tile["children"][0]
    assert uris == ["level_2.glb", "level_1.glb", "level_0.glb"] and made["asset"]["version"] == "1.1"


def test_the_box_holds_every_splat():
    box, splats = bounding_box(tiny.model()), tiny.gaussians()
    for axis in range(3):
        center, half = box[axis], box[3 + 4 * axis]
        assert float(splats.means[:, axis].min()) > center - half and float(splats.means[:, axis].max()) < center + half
    assert sum(box[3:]) == pytest.approx(box[3] + box[7] + box[11])


def test_streamed_sog_is_written_with_its_levels_and_settings(ladder, tool):
    made = write_streamed(ladder, 1000)
    words = json.loads(made.read_text())
    assert words[-9:] == [word for number in range(3) for word in (str(ladder / f"level_{number}.ply"), "--lod", str(number))]
    assert json.loads((made.parent / "playcanvas.json").read_text()) == viewer_settings(LADDER, 1000)
    with pytest.raises(OutputExists):
        write_streamed(ladder)


def test_tiles_are_written_with_their_files(ladder, tool):
    made = write_tiles(ladder)
    assert sorted(file.name for file in made.parent.iterdir()) == ["level_0.glb", "level_1.glb", "level_2.glb", "tileset.json"]
    assert json.loads((made.parent / "level_1.glb").read_text())[-1] == str(ladder / "level_1.ply")


def test_a_failed_conversion_leaves_nothing(ladder, tool):
    (ladder / "level_2.ply").write_bytes(b"")
    with pytest.raises(OutputError, match="splat-transform does not write it"):
        write_streamed(ladder)
    assert not (ladder / "streamed").exists()


def test_without_splat_transform_the_command_says_so_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    base = tiny.folder(tmp_path / "base")
    for option in ("--streamed-sog", "--tiles"):
        assert cli.main(["levels", str(base), "--viewer", "spark", "--output", str(tmp_path / "ladder"), option]) == 2
        assert "npm install -g @playcanvas/splat-transform" in capsys.readouterr().err
    assert not (tmp_path / "ladder").exists() and not (tmp_path / "ladder.resume").exists()
