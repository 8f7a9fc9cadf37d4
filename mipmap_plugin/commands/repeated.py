"""Options that are given more than once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, get_origin, get_type_hints

import tyro

from mipmap_plugin.errors import SettingsError


def refuse_repeated(command: Callable[..., Any], words: Sequence[str]) -> None:
    """Raise SettingsError for an option of `command` that is given twice and may not be: the parser takes the last one and says nothing."""
    words = words[: words.index("--")] if "--" in words else words  # behind it are names of files
    options = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--") and word != "--help"]
    if len(set(options)) == len(options):
        return
    hints = get_type_hints(command, include_extras=True)
    for option in options:
        name = option.removeprefix("--").replace("-", "_")
        hint, is_switch = hints.get(name), bool in (hints.get(name), hints.get(name.removeprefix("no_")))
        if options.count(option) > 1 and not is_switch and tyro.conf.UseAppendAction not in getattr(hint, "__metadata__", ()):
            how = ", with all its values behind it" if get_origin(hint) is tuple else ""
            raise SettingsError(f"{option} is given {options.count(option)} times, of which only the last would count; give it once{how}")
