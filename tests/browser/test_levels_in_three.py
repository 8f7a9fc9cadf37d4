"""The module of a ladder in a bare page of three.js: what cameras, canvases and groups do to its zoom, and files that are not there."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from browser import Browser

from mipmap_plugin.levels import manifest
from mipmap_plugin.levels.manifest import MANIFEST, THREE_JS

pytestmark = pytest.mark.browser

MIDDLE, BASE_PIXEL = [1.0, 2.0, 3.0], 0.1

# x, y, z and the size of a pixel: at the middle, behind it, before it, and beside all pictures. From 10 units away, and from 30, and without
# perspective, the median of the zooms of those in the picture is that of the middle.
LOOKED_AT = [[*MIDDLE, BASE_PIXEL], [1.0, 2.0, -7.0, 4 * BASE_PIXEL], [1.0, 2.0, 8.0, BASE_PIXEL / 4], [41.0, 2.0, 3.0, 100 * BASE_PIXEL]]

# The zoom from 10 units away, on a canvas 100 px high with a field of view of 60 degrees.
PLAIN = BASE_PIXEL * 100 / (2 * 10 * math.tan(math.radians(30)))


# Of each case, as a multiple of that zoom. Where a camera looks at nothing the distance of the middle counts, with `view_pixel`, half as large here.
ZOOMS = [
    ("plain", 1), ("resized", 3), ("finer_pixels", 6), ("orthographic", 1), ("in_a_group", 1), ("camera_in_a_rig", 1), ("render_target", 1 / 2),
    ("turned_away", 1 / 2),
]  # fmt: skip


@pytest.fixture(scope="module")
def told(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of a ladder whose middle level has no file."""
    folder = tmp_path_factory.mktemp("ladder")
    shutil.copyfile(Path(manifest.__file__).with_name(THREE_JS), folder / THREE_JS)
    levels, switches = [{"file": f"level_{number}.ply"} for number in range(3)], [{"zoom": 0.5}, {"zoom": 0.2}]
    made = {"middle": MIDDLE, "view_pixel": BASE_PIXEL / 2, "looked_at": LOOKED_AT, "levels": levels, "switches": switches}
    (folder / MANIFEST).write_text(json.dumps(made))
    (folder / "distance").mkdir()
    (folder / "distance" / MANIFEST).write_text(json.dumps({"by": "distance", "levels": levels}))
    (folder / "page").mkdir()
    (folder / "page" / MANIFEST).write_text("<!doctype html>")
    for number in (0, 2):
        (folder / f"level_{number}.ply").touch()
    told: dict[str, Any] = browser.alone("levels-alone", folder)
    return told


@pytest.mark.parametrize(("case", "times"), ZOOMS)
def test_the_zoom_follows_the_canvas_the_camera_and_the_group(told: dict[str, Any], case: str, times: float) -> None:
    assert told["zooms"][case] == pytest.approx(times * PLAIN, rel=1e-6)


@pytest.mark.parametrize(
    ("case", "wanted", "shown", "drawn"),
    [
        ("at_first", 2, 2, [None, None, False]),
        ("missing", 1, 2, [None, None, True]),
        ("behind_it", 0, 0, [True, None, False]),
        ("early", 0, 0, [True, None, None]),
        ("inside", 0, 0, [True, None, None]),
        ("at_once", 0, 0, [True, None, False]),
    ],
)  # fmt: skip
def test_the_nearest_level_that_is_there_is_shown(told: dict[str, Any], case: str, wanted: int, shown: int, drawn: list[bool | None]) -> None:
    """`at_once`: of what draws a level without a promise."""
    assert told[case] == [wanted, shown, drawn]


def test_a_folder_without_a_ladder_is_told_with_its_address(told: dict[str, Any]) -> None:
    assert told["no_folder"].endswith("/pages/levels.json: 404 File not found")


def test_what_a_server_answers_in_place_of_a_ladder_is_told(told: dict[str, Any]) -> None:
    """Servers of single-page applications answer what they do not have with their page."""
    assert told["no_manifest"].endswith("/page/levels.json is no levels.json: give the folder of the ladder, as the server knows it")


def test_a_level_that_failed_is_tried_again_after_a_while(told: dict[str, Any]) -> None:
    nothing, there = [None, None, None], [True, None, None]
    found = {when: (drawn, asked) for when, ((_, _, drawn), asked) in told["again"].items()}
    assert found == {"first": (nothing, 1), "next": (nothing, 1), "later": (there, 2)}


def test_a_ladder_that_is_disposed_of_frees_its_levels(told: dict[str, Any]) -> None:
    """One that is still on its way, too."""
    freed, in_the_scene, drawing = told["disposed"]
    assert freed == ["level_2.ply", "level_0.ply"] and in_the_scene == 0 and drawing == 1


def test_a_ladder_by_distance_is_refused(told: dict[str, Any]) -> None:
    assert "is of a ladder by distance" in told["by_distance"]
