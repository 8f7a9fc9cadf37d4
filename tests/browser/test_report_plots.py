"""The plots of the report page in a real browser: fronts, ladders and curves, with the figures that they show."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import tiny

from mipmap_plugin.cli import main

pytestmark = pytest.mark.browser

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def walked_ladder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of a ladder by distance; its page lies beside it."""
    here = tmp_path_factory.mktemp("walked")
    words = ["levels", tiny.folder(here / "base"), "--viewer", "playcanvas", "--by", "distance", "--coarsest", "1/4", "--ratio", "2"]
    assert main([str(word) for word in (*words, "--recipe", "instant", "--output", here / "levels", "--report")]) == 0
    return here / "levels" / "levels.json"


def test_a_point_of_the_front_tells_its_figures(open_page: Open, tradeoff: Path) -> None:
    page, points = open_page(tradeoff.with_name("report.html")), json.loads(tradeoff.read_text())["scales"][0]["points"]
    [best] = [point for point in points if point["name"] == "default, 5 steps at most" and point["step"] is None]
    assert page.locator(".chart .front").count() >= 1
    mark = page.locator(f".chart .mark[aria-label^='{best['name']}, {best['backend']}']").first
    for reach in (mark.hover, mark.focus):
        page.locator(".chart .mark").first.focus()
        reach()
        assert page.text_content(".readout >> nth=0").startswith(f"{best['name']}, {best['backend']}: {best['psnr_db']['median']:.2f} dB")


def test_the_mark_that_the_keyboard_is_on_looks_unlike_all_others(open_page: Open, tradeoff: Path) -> None:
    """Also one of the front, which is filled without the keyboard."""
    page = open_page(tradeoff.with_name("report.html"))
    look = "marks => marks.map(each => { const { fill, stroke } = getComputedStyle(each); return fill + stroke })"
    page.locator(".skip").focus()
    page.keyboard.press("Tab")
    first, *others = page.eval_on_selector_all(".mark", look)
    assert page.evaluate("document.activeElement.classList.contains('on-front')") and first not in others


def test_a_ladder_is_a_curve_over_zoom_with_its_switches_and_levels(open_page: Open, ladder: Path) -> None:
    page, manifest = open_page(ladder.with_name("report.html")), json.loads(ladder.read_text())
    assert page.locator("#levels .switch").count() == len(manifest["switches"]) > 0
    assert page.locator("#levels .mark").count() == len(manifest["curve"])
    places = page.eval_on_selector_all("#levels .mark", "marks => marks.map(each => Number(each.getAttribute('cx')))")
    assert places == sorted(places)
    last = manifest["curve"][-1]
    page.locator("#levels .mark").last.focus()
    assert f"{last['psnr_db']:.2f} dB with level_{last['level']}.ply" in page.text_content("#levels .readout")
    shown = page.eval_on_selector_all("#levels tbody tr", "rows => rows.map(row => [row.cells[0], row.cells[4]].map(cell => cell.textContent))")
    assert shown == [[level["file"], str(level["splats"])] for level in manifest["levels"]]


def test_a_ladder_by_distance_is_a_curve_over_distances(open_page: Open, walked_ladder: Path) -> None:
    page, manifest = open_page(walked_ladder.with_name("report.html")), json.loads(walked_ladder.read_text())
    assert page.locator("#levels .mark").count() == len(manifest["curve"])
    places = page.eval_on_selector_all("#levels .mark", "marks => marks.map(each => Number(each.getAttribute('cx')))")
    assert places == sorted(places) and places[-1] > places[0]
    last = manifest["curve"][-1]
    page.locator("#levels .mark").last.focus()
    assert f"{last['psnr_db']:.2f} dB with the levels ({round(last['splats']):,} splats)" in page.text_content("#levels .readout")
    shown = page.eval_on_selector_all("#levels tbody tr", "rows => rows.map(row => row.cells[1].textContent)")
    ends = [f"{level['distance_from']:.3g}" for level in manifest["levels"][1:]]
    assert shown == [f"to {ends[0]}", *(f"from {low} to {high}" for low, high in pairwise(ends)), f"from {ends[-1]}"]


def test_the_slider_shows_the_level_of_each_zoom(open_page: Open, ladder: Path) -> None:
    page, manifest = open_page(ladder.with_name("report.html")), json.loads(ladder.read_text())
    page.focus("#zoom")
    for zoom in json.loads(page.text_content("#record"))["zooms"]:
        number = sum(zoom["scale"] < switch["zoom"] for switch in manifest["switches"])
        assert page.text_content(".card.adapted small >> nth=-1") == f"level_{number}.ply"
        page.keyboard.press("ArrowRight")
    assert page.text_content(".zoom output") == "×1" and number == 0
    assert page.text_content(".names .right").startswith("level shown")


def test_all_that_was_done_before_the_first_step_is_told(open_page: Open, tmp_path: Path) -> None:
    """A zoom-in for another filter is converted first."""
    words = ["adapt", tiny.folder(tmp_path / "base"), "--scale", "2", "--viewer", "antialiased", "--steps", "4", "--output", tmp_path / "out.ply"]
    assert main([str(word) for word in (*words, "--report")]) == 0
    seconds = json.loads((tmp_path / "out.ply.adaptation.json").read_text())["seconds"]
    told = open_page(tmp_path / "out.ply.report.html").inner_text("#curve .note")
    assert f"Shaded, before the first step: conversion {seconds['conversion']:.2f} s, " in told


def test_the_curve_has_a_mark_for_every_check_and_the_start(open_page: Open, tmp_path: Path) -> None:
    base = tiny.folder(tmp_path / "base")
    assert main(["adapt", str(base), "--scale", "1/2", "--steps", "20", "--output", str(tmp_path / "a.ply"), "--report"]) == 0
    report = json.loads((tmp_path / "a.ply.adaptation.json").read_text())
    page = open_page(tmp_path / "a.ply.report.html")
    assert page.locator("#curve .mark").count() == len(report["curve"])
    page.locator("#curve .mark.start").focus()
    assert "closed form" in page.text_content("#curve .readout")
    assert f"{report['curve'][0]['validation_db']:.2f} dB" in page.text_content("#curve .readout")
    assert report["curve"][0]["validation_db"] not in report["validation"].values()  # the same state, but other views
    assert page.evaluate("[1, 2000].map(splats)") == ["1 splat", "2,000 splats"]
    assert "of the validation views that steer the run; the base's line and the dB above are of the others" in page.text_content("#curve .note")


def test_the_page_of_a_base_that_is_returned_as_it_is_has_no_curve(open_page: Open, tmp_path: Path) -> None:
    base = tiny.folder(tmp_path / "base")
    assert main(["adapt", str(base), "--scale", "1", "--output", str(tmp_path / "a.ply"), "--report"]) == 0
    page = open_page(tmp_path / "a.ply.report.html")
    assert page.locator("#provenance").count() == 1 and page.locator("#curve").count() == 0


def test_a_page_of_files_for_several_viewers_says_whose_effects_it_tells(open_page: Open, tmp_path: Path) -> None:
    words = ["adapt", tiny.folder(tmp_path / "base"), "--scale", "1/2", "--recipe", "instant", "--output", tmp_path / "out", "--report"]
    assert main([str(word) for word in (*words, "--viewer", "spark", "--viewer", "playcanvas")]) == 0
    page = open_page(next((tmp_path / "out").glob("*.html")))
    spark, playcanvas = (report["effects"] for report in json.loads(page.text_content("#record"))["adaptations"])
    assert spark != playcanvas and page.text_content("#effects .note").startswith("Of ×1/2 for spark.")
