"""`cfg_args`: the training options in an INRIA model folder, read as data. The original `eval`s them; this never does."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models.magic import read_head

# Bytes; real files have 200 to 2,000. Parsing time and depth grow with the text.
MAX_SIZE = 64 * 1024


def read_cfg_args(path: str | Path) -> dict[str, Any]:
    """The options of `Namespace(key=literal, ...)`. Raises CheckpointError for anything but literals."""
    path = Path(path)
    text = read_head(path, MAX_SIZE + 1)
    if len(text) > MAX_SIZE:
        raise CheckpointError(f"{path} has more than {MAX_SIZE // 1024} kB, which no cfg_args has; it is not read")
    try:
        call = ast.parse(text.decode("utf-8").strip(), mode="eval").body
        return _keywords(call)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError) as error:
        raise CheckpointError(f"{path} is not a plain `Namespace(name=literal, ...)`, and is not executed: {_brief(error)}") from error


def format_cfg_args(options: dict[str, Any]) -> str:
    """The text that 3DGS writes for these options."""
    return f"Namespace({', '.join(f'{key}={value!r}' for key, value in options.items())})"


def _keywords(call: ast.expr) -> dict[str, Any]:
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        raise ValueError("it is no call of Namespace")
    if call.args or any(keyword.arg is None for keyword in call.keywords):
        raise ValueError("it has arguments without a name")
    options = {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}
    if len(options) < len(call.keywords):
        raise ValueError("it names an argument twice")
    return options


def _brief(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
