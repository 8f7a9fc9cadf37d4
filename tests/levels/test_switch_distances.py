"""At which distances, and with which boxes, viewers are told to switch levels."""

import math

import pytest
import tiny
import torch
from two_levels import CHUNKS, LADDER

from mipmap_plugin.formats.streamed_sog import Chunk
from mipmap_plugin.levels.distance.chunks import box_distances
from mipmap_plugin.levels.streamed import DIRECTIONS, Approach, distances, progression, viewer_settings
from mipmap_plugin.levels.tiles import SCREEN_ERROR, bounding_box, bounds, errors, spheres, tileset

# The focal length of Cesium's own camera, of 60 degrees along the longer side, on a canvas of 16 x 9 whose shorter side has 1000 px.
CESIUMS = 1000 * 16 / 9 / 2 / math.tan(math.radians(30))

APPROACH = Approach.to([2.0, 0.5, 0.5], CHUNKS)


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


def test_distances_too_close_for_playcanvas_are_spread_around_their_middle():
    assert progression([5, 5.1], 9.0) == pytest.approx((math.sqrt(5 * 5.1 / 1.2), 1.2))
    assert progression([0.01], 2.0) == pytest.approx((0.1, 2))


def test_of_a_chunk_that_one_splat_far_away_makes_long_the_nearer_end_counts():
    """Its middle is 500 units away, but hardly any direction brings that nearer to a camera than its splats."""
    boxes = [Chunk((-1, -1, -1), (0, 1, 1), (20, 0, 0)), Chunk((0, -1, -1), (1, 1, 1), (10, 0, 0)), Chunk((0, -1, -1), (1000, 1, 1), (20, 0, 0))]
    usual, long = (Approach.to([0.0, 0.0, 0.0], some) for some in (boxes[:2], boxes))
    assert usual.chunk_distance(10) == pytest.approx(10 - 1.25, abs=0.25)
    assert 10 - 1.5 < long.chunk_distance(10) < 10
    assert long.camera_distance(long.chunk_distance(10)) == pytest.approx(10, rel=1e-3)


def test_a_page_is_told_to_keep_the_distances():
    settings, wanted = viewer_settings(LADDER, APPROACH, 1000), distances(LADDER, 1000)
    near = [APPROACH.chunk_distance(distance) for distance in wanted]
    assert settings["lodBaseDistance"] == pytest.approx(near[0]) and settings["zooms"] == pytest.approx([0.7, 0.35], rel=1e-3)
    assert wanted[0] - 2 < near[0] < wanted[0] - 0.5 and settings["lodMultiplier"] == pytest.approx(near[1] / near[0])
    assert settings["splatBudgetMode"] == "limit" and settings["splatBudget"] == 1_000_000
    assert settings["lodUpdateDistance"] < 0.05 * settings["lodBaseDistance"]


def test_levels_by_distance_are_shown_at_the_distances_that_they_were_made_for():
    made = LADDER | {"by": "distance", "lodBaseDistance": 3.0, "lodMultiplier": 1.7, "canvas": 500, "chunk_extent": 4}
    settings = viewer_settings(made, None, 1000)
    assert (settings["lodBaseDistance"], settings["lodMultiplier"]) == (6.0, 1.7)


def test_what_playcanvas_takes_for_levels_by_distance_of_a_scene_in_small_units_is_what_is_written():
    made = LADDER | {"by": "distance", "lodBaseDistance": 0.05, "lodMultiplier": 1.19, "canvas": 1000}
    settings = viewer_settings(made | {"base_pixel": 0.01 * 0.05 / distances(LADDER, 1000)[0]}, None, 1000)
    assert (settings["lodBaseDistance"], settings["lodMultiplier"]) == (0.1, 1.2)
    assert settings["zooms"][0] < 0.7  # and not where they were made for


def test_a_tile_is_replaced_at_its_switch():
    """Where a base pixel of 0.01 units at the scene's middle is seen with 0.7 px, the error of the tile that is replaced there has 16 at its box."""
    box = (torch.tensor([-3.0, -4.0, -5.0]), torch.tensor([3.0, 4.0, 5.0]))
    approach = Approach.to_box([0.0, 0.0, 0.0], *box)
    finest, *coarser = errors(LADDER, approach, 1000)
    assert finest == 0 and spheres(LADDER, approach, 1000) == []
    for error, zoom in zip(coarser, (0.7, 0.35), strict=True):
        eyes = CESIUMS * 0.01 / zoom * DIRECTIONS
        away = box_distances(box[0].double()[None], box[1].double()[None], eyes)
        assert float((CESIUMS * error / away).median()) == pytest.approx(SCREEN_ERROR, rel=0.02)


def test_in_a_tile_that_reaches_around_the_camera_a_level_is_shown_up_to_its_switch():
    """A camera inside the box is at no distance from it, at which Cesium would never show a coarser level."""
    middle = [1.0, 2.0, 3.0]
    approach = Approach.to_box(middle, torch.full((3,), -1e3), torch.full((3,), 1e3))
    made = LADDER | {"middle": middle}
    assert errors(made, approach, 1000)[1:] == pytest.approx([SCREEN_ERROR * 0.01 / zoom for zoom in (0.7, 0.35)])
    for sphere, zoom in zip(spheres(made, approach, 1000), (0.7, 0.35), strict=True):
        assert sphere == pytest.approx([-1, -3, -2, CESIUMS * 0.01 / zoom])


def test_a_tile_that_is_shown_within_a_sphere_is_no_box_in_a_box():
    """Of boxes within boxes Cesium hides the parent, too, where no child is asked for."""
    made = tileset([1.0, 2.0, 3.0, 2.0, 0, 0, 0, 3.0, 0, 0, 0, 6.0], [0.0, 1.0, 2.0], [[5.0] * 4, [6.0] * 4])
    coarsest = made["root"]
    middle = coarsest["children"][0]
    finest = middle["children"][0]
    assert all(tile["boundingVolume"] == {"sphere": [1.0, 2.0, 3.0, 7.0]} for tile in (coarsest, middle, finest))
    assert [tile.get("viewerRequestVolume") for tile in (coarsest, middle, finest)] == [None, {"sphere": [6.0] * 4}, {"sphere": [5.0] * 4}]


def test_tiles_of_levels_by_distance_are_replaced_at_the_distance_of_their_box():
    assert errors(LADDER, None, 1000) == pytest.approx([0, *(SCREEN_ERROR * 0.01 / zoom for zoom in (0.7, 0.35))])


def test_tiles_go_from_the_coarsest_to_the_finest():
    made = tileset([0.0] * 12, [0.0, 1.0, 2.0])
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
    """In the axes of a tile, where (x, y, z) of a PLY lies at (-x, -z, -y)."""
    box, splats = bounding_box(*bounds([tiny.model()])), tiny.gaussians()
    for axis, of_ply in enumerate((0, 2, 1)):
        center, half = box[axis], box[3 + 4 * axis]
        assert float(-splats.means[:, of_ply].max()) > center - half and float(-splats.means[:, of_ply].min()) < center + half
    assert sum(box[3:]) == pytest.approx(box[3] + box[7] + box[11])
