"""Exchange formats of viewers: quantized, so that they are not adapted but turned into a PLY first, by splat-transform."""

from __future__ import annotations

import shlex
from pathlib import Path

# By `magic.kind_of`: the format's name, and the ending by which splat-transform knows it, for it does not look at the bytes.
EXCHANGE = {
    "spz": ("SPZ", ".spz"),
    "sog": ("SOG", ".sog"),
    "ksplat": ("KSPLAT", ".ksplat"),
    "splat": ("SPLAT", ".splat"),
    "compressed": ("compressed PLY", ".ply"),
}


def conversion(path: Path, kind: str) -> str:
    """The sentence that tells what a file is, and the one command that turns it into a PLY beside it."""
    name, ending = EXCHANGE[kind]
    stem = path.name.removesuffix(".compressed.ply") if path.name.endswith(".compressed.ply") else path.stem
    if path.suffix == ".json":  # a SOG that is a folder
        stem = path.absolute().parent.name
    known = path.suffix.lower() in (ending, ".json")
    source = path if known else path.with_name(stem + ending)
    plain = path.with_name(f"{stem}.ply")
    if plain in (path, source):
        plain = path.with_name(f"{stem}-plain.ply")
    rename = "" if known else f"cp {_quoted(path)} {_quoted(source)} && "
    return f"{path} is {name}, an exchange format; convert it first: {rename}splat-transform {_quoted(source)} {_quoted(plain)}"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
