"""A Markdown page of what was measured on each base, written from the JSON files of all, so that bases can be measured one at a time."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.evaluation.report import table


def write_page(page: Path, intro: str, measured: Iterable[Path]) -> None:
    """`measured`: files of rows, each with its base's name."""
    parts = [f"## {file.stem}\n\n{table([Row(**row) for row in json.loads(file.read_text())])}\n" for file in sorted(measured)]
    page.write_text("\n".join([intro, *parts]))
