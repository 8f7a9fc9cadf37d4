"""`cfg_args`: the training options in an INRIA model folder, read as data. The original `eval`s them; this never does."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError, brief
from mipmap_plugin.formats.magic import read_head

# Bytes; real files have 200 to 2,000. Parsing time and depth grow with the text.
MAX_SIZE = 64 * 1024

# Of a copy: bytes that are not UTF-8 are kept as they are.
ENCODING = {"encoding": "utf-8", "errors": "surrogateescape"}


def read_cfg_args(path: str | Path) -> dict[str, Any]:
    """The options of `Namespace(key=literal, ...)`, without those whose values are not literals. Raises CheckpointError for other text."""
    return read_cfg_args_and_rest(path)[0]


def read_cfg_args_and_rest(path: str | Path) -> tuple[dict[str, Any], list[str]]:
    """The options, and the names of those that are left out because their values are not literals. Raises CheckpointError."""
    path = Path(path)
    text = read_head(path, MAX_SIZE + 1)
    if len(text) > MAX_SIZE:
        raise CheckpointError(f"{path} has more than {MAX_SIZE // 1024} kB, which no cfg_args has; it is not read")
    try:
        # Windows may write paths in another encoding, of which only the letters are lost here, and its editors begin with a byte-order mark.
        call = ast.parse(text.decode("utf-8-sig", "replace").strip(), mode="eval").body
        return _keywords(call)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError) as error:
        raise CheckpointError(f"{path} is not a plain `Namespace(name=literal, ...)`, and is not executed: {brief(error)}") from error


def cfg_args_text(path: Path) -> str:
    """The whole text of a file, to be written again with the same encoding, `ENCODING`: every byte is kept."""
    return path.read_bytes().decode(**ENCODING)


def format_cfg_args(options: dict[str, Any]) -> str:
    """The text that 3DGS writes for these options."""
    return f"Namespace({', '.join(f'{key}={value!r}' for key, value in options.items())})"


def _keywords(call: ast.expr) -> tuple[dict[str, Any], list[str]]:
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        raise ValueError("it is not a call of Namespace")
    if call.args or any(keyword.arg is None for keyword in call.keywords):
        raise ValueError("it has arguments without a name")
    options: dict[str, Any] = {}
    rest: list[str] = []
    for keyword in call.keywords:
        name = str(keyword.arg)
        if name in options or name in rest:
            raise ValueError("it names an argument twice")
        try:
            options[name] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
            rest.append(name)
    return options, rest
