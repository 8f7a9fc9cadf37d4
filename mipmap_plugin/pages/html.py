"""Writes a report page: the files beside this one and the record in one HTML file, which asks the network for nothing."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from mipmap_plugin.formats.atomic import json_text, new_file
from mipmap_plugin.pages.record import Page

# Bytes: what every browser opens at once and every mail carries.
LARGEST = 9_500_000

# px: how much of each picture is shown, around its middle; the largest that keeps the page small.
SIDES = (800, 640, 480, 360, 240, 160, 96, 48, 16)

SCRIPTS = ("dom.js", "compare.js", "charts.js", "ladder.js", "sections.js")


def write_page(path: Path, page: Page, overwrite: bool) -> Path:
    """Write the page, atomically; return its path. Raises OutputExists and OutputError."""
    text = next((text for side in SIDES if len(text := html(page.facts(side))) <= LARGEST), None) or html(page.facts(SIDES[-1]))
    with new_file(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return path


def html(record: dict[str, Any]) -> str:
    """The page of a record. Nothing in the record can end the element that holds it, so that no name becomes markup."""
    parts = {
        "style": _asset("report.css"),
        "script": "\n".join(_asset(name) for name in SCRIPTS),
        "record": json_text(record).replace("<", "\\u003c"),
    }
    text = _asset("report.html")
    for name, part in parts.items():
        before, after = text.split(f"@@{name}@@", 1)
        text = before + part + after
    return text


def _asset(name: str) -> str:
    return files("mipmap_plugin.pages").joinpath(name).read_text(encoding="utf-8")
