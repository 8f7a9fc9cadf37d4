"""The report page in a real browser: what the pointer, a finger and the keyboard do, narrow and dark screens, and the figures that it shows."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mipmap_plugin.demo.run import run_demo

pytestmark = pytest.mark.browser

WIDE, PHONE = {"width": 1200, "height": 900}, {"width": 360, "height": 740}

Open = Callable[..., Any]


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


@pytest.mark.slow
def test_the_page_of_the_demo_works(open_page: Open, tmp_path: Path) -> None:
    run_demo(tmp_path, (0.125, 0.25), report=True)
    page = open_page(tmp_path / "report.html")
    assert page.locator(".card").count() >= 6 and (tmp_path / "report.html").stat().st_size < 10_000_000
