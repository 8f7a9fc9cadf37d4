"""The report page in a real browser: what the pointer, a finger and the keyboard do, narrow and dark screens, and the figures that it shows."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import tiny
from browser import missing_browser

from mipmap_plugin.cli import main
from mipmap_plugin.demo.run import run_demo

pytestmark = pytest.mark.browser

WIDE, PHONE = {"width": 1200, "height": 900}, {"width": 360, "height": 740}

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    if lacking := missing_browser():
        pytest.skip(lacking)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The JSON of an evaluation at two zooms; its page lies beside it."""
    here = tmp_path_factory.mktemp("evaluation")
    base = tiny.folder(here / "base", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"))
    words = ["--images", tiny.scene(here / "scene"), "--scale", "1/2", "--scale", "1", "--recipe", "instant", "--output", here / "rows.json"]
    assert main([str(word) for word in ("evaluate", base, *words)]) == 0
    return here / "rows.json"


@pytest.fixture(scope="module")
def tradeoff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The JSON of a tradeoff; its page lies beside it."""
    here = tmp_path_factory.mktemp("tradeoff")
    words = ["tradeoff", tiny.folder(here / "base"), "--scale", "1/2", "--output", here / "out", "--recipe", "default", "--steps", "5"]
    assert main([str(word) for word in (*words, "--repeats", "1", "--no-renderers", "--no-picture", "--views", "1", "--report")]) == 0
    return here / "out" / "tradeoff.json"


@pytest.fixture(scope="module")
def ladder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of a ladder; its page lies beside it."""
    here = tmp_path_factory.mktemp("ladder")
    words = ["levels", tiny.folder(here / "base"), "--viewer", "spark", "--coarsest", "1/4", "--ratio", "2", "--steps", "5", "--views", "given"]
    assert main([str(word) for word in (*words, "--output", here / "levels", "--report")]) == 0
    return here / "levels" / "levels.json"


@pytest.fixture(scope="module")
def walked_ladder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of a ladder by distance; its page lies beside it."""
    here = tmp_path_factory.mktemp("walked")
    words = ["levels", tiny.folder(here / "base"), "--viewer", "playcanvas", "--by", "distance", "--coarsest", "1/4", "--ratio", "2"]
    assert main([str(word) for word in (*words, "--recipe", "instant", "--output", here / "levels", "--report")]) == 0
    return here / "levels" / "levels.json"


@pytest.fixture
def open_page(chromium: Any) -> Iterator[Open]:
    """Opens a page; fails at the end if it had an error or asked for anything but itself."""
    complaints, contexts = [], []

    def opened(path: Path, **settings: Any) -> Any:
        context = chromium.new_context(**{"viewport": WIDE, **settings})
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda asked: complaints.append(asked.url) if not asked.url.startswith(("file:", "data:")) else None)
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []


def divider(page: Any) -> int:
    return int(page.get_attribute("#stage", "aria-valuenow"))


def test_the_figures_are_those_of_the_json(open_page: Open, evaluation: Path) -> None:
    page, rows = open_page(evaluation.with_suffix(".html")), json.loads(evaluation.read_text())["rows"]
    shown = page.eval_on_selector_all("#rows tbody tr", "rows => rows.map(row => [...row.cells].map(cell => cell.textContent))")
    zooms = {0.5: "×1/2", 1.0: "×1"}
    assert [line[:4] for line in shown] == [[zooms[row["scale"]], row["name"], f"{row['psnr_db']:.2f}", f"{row['ssim']:.4f}"] for row in rows]
    cards = page.eval_on_selector_all(".card", "cards => cards.map(card => [...card.querySelectorAll('.name, .mean')].map(part => part.textContent))")
    means = {row["name"]: f"{row['psnr_db']:.2f} dB" for row in rows if row["scale"] == 0.5}
    assert {name: mean for name, mean, *_ in (card for card in cards if card[0] != "truth")} == means


def test_the_slider_changes_the_zoom(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    before = page.get_attribute(".canvas img", "src")
    page.focus("#zoom")
    page.keyboard.press("ArrowRight")
    assert page.text_content(".zoom output").endswith("×1") and page.get_attribute(".canvas img", "src") != before
    assert page.text_content("#view").startswith("View view_0 · 32 × 24 px")
    page.keyboard.press("ArrowLeft")
    assert page.text_content(".zoom output").endswith("×1/2") and page.get_attribute(".canvas img", "src") == before


def test_the_divider_follows_the_pointer(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    box = page.locator(".canvas").bounding_box()
    for part in (0.25, 0.9):
        page.mouse.move(box["x"] + part * box["width"], box["y"] + box["height"] / 2)
        assert divider(page) == pytest.approx(100 * part, abs=1)
        assert f"{part * 100:.0f}" in page.evaluate("document.querySelector('.after').style.clipPath")


def test_the_divider_follows_a_finger(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"), viewport=PHONE, has_touch=True, is_mobile=True)
    box = page.locator(".canvas").bounding_box()
    page.touchscreen.tap(box["x"] + 0.8 * box["width"], box["y"] + box["height"] / 2)
    assert divider(page) == pytest.approx(80, abs=1)


def test_the_divider_is_moved_by_keys(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    page.focus("#stage")
    found = []
    for key in ("ArrowRight", "ArrowLeft", "Shift+ArrowLeft", "Home", "ArrowLeft", "End", " "):
        page.keyboard.press(key)
        found.append(divider(page))
    assert found == [52, 50, 40, 0, 0, 100, 0]
    assert page.evaluate("scrollY") == 0


def test_everything_is_reached_by_the_tab_key(open_page: Open, evaluation: Path) -> None:
    page, seen = open_page(evaluation.with_suffix(".html")), []
    for _ in range(8):
        page.keyboard.press("Tab")
        seen.append(page.evaluate("document.activeElement.id || document.activeElement.className"))
    assert seen[:6] == ["skip", "zoom", "before", "after", "pixel", "stage"] and seen[6].startswith("card")


def test_a_card_is_shown_on_the_right(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    page.click(".card.truth")
    assert page.text_content(".names .right").startswith("truth")
    assert page.get_attribute(".card.truth", "aria-pressed") == "true"
    assert page.get_attribute(".canvas .after", "src") == page.get_attribute(".card.truth img", "src")


def test_pixels_stay_whole(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    assert page.eval_on_selector_all("img", "images => [...new Set(images.map(each => getComputedStyle(each).imageRendering))]") == ["pixelated"]
    page.select_option("#pixel", "8")
    box = page.locator(".canvas").bounding_box()
    assert (box["width"], box["height"]) == (16 * 8, 12 * 8)


@pytest.mark.parametrize("viewport", [PHONE, WIDE], ids=["phone", "wide"])
def test_nothing_is_wider_than_the_screen(open_page: Open, evaluation: Path, tradeoff: Path, ladder: Path, viewport: dict[str, int]) -> None:
    for path in (evaluation.with_suffix(".html"), tradeoff.with_name("report.html"), ladder.with_name("report.html")):
        page = open_page(path, viewport=viewport)
        assert page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]


@pytest.mark.parametrize("viewport", [PHONE, WIDE], ids=["phone", "wide"])
def test_plots_can_be_read(open_page: Open, evaluation: Path, tradeoff: Path, ladder: Path, viewport: dict[str, int]) -> None:
    """Text is neither tiny on a phone nor huge on a desk, and lies within the card."""
    script = """all => all.map(svg => [svg.getScreenCTM().a, ...[...svg.querySelectorAll("text")].map(text => {
        const [place, card] = [text.getBoundingClientRect(), svg.closest("figure").getBoundingClientRect()];
        return Math.max(card.left - place.left, place.right - card.right);
    })])"""
    for path in (evaluation.with_suffix(".html"), tradeoff.with_name("report.html"), ladder.with_name("report.html")):
        for scale, *outside in open_page(path, viewport=viewport).eval_on_selector_all(".chart svg", script):
            assert 10 <= 12 * scale <= 17 and max(outside) <= 0


def test_a_command_is_not_broken_within_an_option(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"), viewport=PHONE)
    parts = page.eval_on_selector_all("code .option", "all => all.map(each => [each.textContent, each.getClientRects().length])")
    assert "--images" in [name for name, _ in parts] and {lines for _, lines in parts} == {1}
    assert page.text_content("code").startswith("mipmap-plugin evaluate ")


def test_light_and_dark(open_page: Open, evaluation: Path) -> None:
    script = "['background-color', 'color'].map(name => getComputedStyle(document.body).getPropertyValue(name).match(/\\d+/g).map(Number)[0])"
    light, dark = (open_page(evaluation.with_suffix(".html"), color_scheme=scheme).evaluate(script) for scheme in ("light", "dark"))
    assert light[0] > 200 > 100 > light[1] and dark[0] < 60 < 200 < dark[1]


def test_viewers_show_the_base_and_the_file(open_page: Open, evaluation: Path) -> None:
    page = open_page(evaluation.with_suffix(".html"))
    titles = page.eval_on_selector_all(".viewer figcaption", "all => all.map(each => each.textContent)")
    assert all(any(viewer in title for title in titles) for viewer in ("Spark", "SuperSplat", "INRIA --antialiasing"))
    record = json.loads(page.text_content("#record"))["zooms"][0]["viewers"]
    figures = page.eval_on_selector_all(".viewer strong", "all => all.map(each => each.textContent)")
    assert figures == [f"{each[role]['view']['psnr_db']:.2f} dB" for each in record for role in ("base", "adapted")]


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


@pytest.mark.slow
def test_the_page_of_the_demo_works(open_page: Open, tmp_path: Path) -> None:
    run_demo(tmp_path, (0.125, 0.25), report=True)
    page = open_page(tmp_path / "report.html")
    assert page.locator(".card").count() >= 6 and (tmp_path / "report.html").stat().st_size < 10_000_000
