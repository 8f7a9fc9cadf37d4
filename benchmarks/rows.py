"""Rows of measurements: those that a JSON file keeps of earlier runs, so that bases can be measured one at a time, and Markdown pages of all."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.evaluation.report import markdown, records, table
from mipmap_plugin.formats.atomic import new_file, write_json

Measured = TypeVar("Measured")


def earlier(file: Path, kind: Callable[..., Measured]) -> list[Measured]:
    """The rows of a kind that a file holds; none where there is no file."""
    return [kind(**row) for row in json.loads(file.read_text())] if file.exists() else []


def joined(file: Path, kind: Callable[..., Measured], rows: Sequence[Measured], key: Callable[[Measured], Hashable]) -> list[Measured]:
    """The rows of a file that were not measured again, and these."""
    return list({key(row): row for row in (*earlier(file, kind), *rows)}.values())


def write_table(folder: Path, name: str, intro: str, head: Sequence[str], measured: Sequence[Any], order: Callable[[Any], Any]) -> None:
    """Print the table of rows, whose `cells()` are as `head`, and write it as NAME.md beside NAME.json. Rows of earlier runs that were not measured
    again are kept. `order`: the key by which rows are sorted, and by which they are told from one another."""
    rows = sorted(joined(folder / f"{name}.json", type(measured[0]), measured, order), key=order)
    text = f"{intro}\n{markdown(head, [row.cells() for row in rows])}\n"
    print(f"\n{text}")
    with new_file(folder / f"{name}.md", overwrite=True) as file:
        file.write_text(text)
    write_json(folder / f"{name}.json", [asdict(row) for row in rows], overwrite=True)


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write evaluated rows, and print them under the file's name."""
    write_json(file, records(rows), overwrite=True)
    print(f"{file.stem}\n{table(rows)}\n", flush=True)


def write_page(page: Path, intro: str, measured: Iterable[Path]) -> None:
    """A section for each of the files of evaluated rows, by its base's name."""
    parts = [f"## {file.stem}\n\n{table(earlier(file, Row))}\n" for file in sorted(measured)]
    page.write_text("\n".join([intro, *parts]))
