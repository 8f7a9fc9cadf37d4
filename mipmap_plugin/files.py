"""Outputs appear whole or not at all: written under a temporary sibling name, then renamed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import OutputError, OutputExists


@contextlib.contextmanager
def new_file(path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary path to write to, which becomes `path` if the block ends well. Raises OutputExists, OutputError."""
    refuse_existing(path, overwrite)
    with _temporary(path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextlib.contextmanager
def new_folder(path: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary folder to fill, which becomes `path` if the block ends well; an old folder is taken away only then."""
    refuse_existing(path, overwrite)
    with _temporary(path) as temporary:
        temporary.mkdir()
        yield temporary
        _swap_in(temporary, path)


def write_json(path: Path, facts: Any, overwrite: bool) -> None:
    """Write `facts` as an indented JSON file (`json_text`). Raises OutputExists, OutputError."""
    with new_file(path, overwrite) as temporary:
        temporary.write_text(json_text(facts) + "\n", encoding="utf-8")


def json_text(facts: Any) -> str:
    """`facts` as indented JSON that every parser takes: what JSON has no number for, such as the PSNR of equal images, is null."""
    return json.dumps(_without_infinities(facts), indent=2, allow_nan=False, default=str)


def _without_infinities(facts: Any) -> Any:
    if isinstance(facts, dict):
        return {name: _without_infinities(value) for name, value in facts.items()}
    if isinstance(facts, (list, tuple)):
        return [_without_infinities(value) for value in facts]
    return None if isinstance(facts, float) and not math.isfinite(facts) else facts


def sha256(*paths: Path) -> str:
    """The sha256 of the files' bytes, one after the other, hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
    return digest.hexdigest()


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise OutputExists when something is at `path` and was not to be replaced."""
    if path.exists() and not overwrite:
        raise OutputExists(f"{path} exists already; pass --overwrite (overwrite=True) to replace it, or choose another path")


def refuse_to_lose(target: Path, source: Path | None, holds: str) -> None:
    """Raise OutputExists when the folder `target` is the base checkpoint's, or no model: one has a folder named `holds`.

    Replacing a folder deletes what is in it.
    """
    if source is not None and source.resolve().is_relative_to(target.resolve()):
        raise OutputExists(f"{target} holds the base checkpoint itself, which --overwrite would delete; choose another folder")
    if target.is_dir() and any(target.iterdir()) and not (target / holds).is_dir():
        raise OutputExists(f"{target} is a folder with other things in it, which --overwrite would delete; choose another folder")
    if target.is_file():
        raise OutputExists(f"{target} is a file; choose another folder, or the path of a file")


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        _remove(temporary)


def _swap_in(new: Path, path: Path) -> None:
    """Directories cannot be exchanged portably, so that the old one steps aside for the moment of one rename."""
    if not path.exists():
        new.rename(path)
        return
    aside = new.with_suffix(".old")
    try:
        path.rename(aside)
        new.rename(path)
    except BaseException:  # also Ctrl-C
        if not path.exists():
            aside.rename(path)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
