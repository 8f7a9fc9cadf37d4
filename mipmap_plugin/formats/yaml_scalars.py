"""Plain settings of a YAML file that was dumped with tags of Python objects: read line by line; no object is constructed."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from mipmap_plugin.formats.magic import read_head

# Bytes; real files have 1 to 20 kB.
MAX_SIZE = 1024 * 1024

_LINE = re.compile(r"^( *)(?:- )?([A-Za-z_]\w*): +([^\s!&*\[{|>].*)$", re.MULTILINE)
_WORDS = {"true": True, "false": False, "null": None, "~": None}


def read_scalars(path: Path) -> dict[str, Any]:
    """Every `key: scalar` of a YAML file. Of equal keys, the least nested counts, then the first.

    Keys whose value is a list, a mapping, an object or a multi-line text are left out. Raises CheckpointError.
    """
    text = read_head(path, MAX_SIZE).decode("utf-8", errors="replace")
    depths: dict[str, int] = {}
    scalars: dict[str, Any] = {}
    for indent, key, value in _LINE.findall(text):
        if len(indent) < depths.get(key, len(indent) + 1):
            depths[key], scalars[key] = len(indent), _scalar(value.strip())
    return scalars


def with_scalar(text: str, key: str, value: str) -> str:
    """The YAML `text` with the values of all lines `key: ...` replaced."""
    return re.sub(rf"(?m)^( *{key}: +)\S.*$", lambda line: line[1] + value, text)


def _scalar(text: str) -> Any:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):  # the last two: too deeply nested brackets
        return text
