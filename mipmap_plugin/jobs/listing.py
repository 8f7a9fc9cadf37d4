"""The checkpoints that a command is given: names, patterns, and files with a list of these; and the part of the list that is this shard's."""

from __future__ import annotations

import codecs
import glob
from collections.abc import Iterable, Sequence
from os.path import realpath  # of a link to itself too, at which `Path.resolve` fails
from pathlib import Path
from typing import TypeVar

from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.formats.atomic import absolute
from mipmap_plugin.formats.nodes import refuse_named_pipe

Item = TypeVar("Item")

# What a text begins with that PowerShell has written.
UTF_16 = codecs.BOM_UTF16_LE


def read_list(path: Path) -> list[Path]:
    """The checkpoints or patterns in a text file, one a line; what follows a # is a comment. Raises SettingsError."""
    try:
        refuse_named_pipe(path)
        content = path.read_bytes()
        text = content.decode("utf-16" if content.startswith(UTF_16) else "utf-8-sig")
        if "\0" in text:  # which no name has: it is UTF-16 that does not begin so
            raise UnicodeError
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise SettingsError(f"{path}: {reason}; --list takes a text file with a checkpoint on each line") from None
    found = [Path(name) for line in text.splitlines() if (name := line.partition("#")[0].strip())]
    if not found:
        raise SettingsError(f"{path} lists no checkpoint; write one on each line")
    return found


def find_checkpoints(given: Iterable[Path]) -> list[Path]:
    """The checkpoints that are given by name or as patterns (*, ?, **), in their order, each once. Raises SettingsError if a pattern fits none."""
    found: dict[Path, Path] = {}
    for path in given:
        for each in _matches(path) if is_pattern(path) else [path]:
            found.setdefault(absolute(each), each)
    return list(found.values())


def is_pattern(path: Path) -> bool:
    """Whether a path stands for others by *, ? or [...]; a file may have these in its name."""
    return glob.has_magic(str(path)) and not path.exists()


def _matches(pattern: Path) -> list[Path]:
    paths = [Path(each) for each in sorted(glob.glob(str(pattern.expanduser()), recursive=True))]
    if not paths:
        raise SettingsError(f"{pattern}: no file or folder fits this pattern; check it")
    return paths


def without_outputs(checkpoints: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Separate checkpoints from outputs of adaptations, which a pattern such as output/* also finds: both lists."""
    kept: list[Path] = []
    left_out: list[Path] = []
    for path in checkpoints:
        linked = path.is_symlink() and _is_output(Path(realpath(path)))  # a link has no report beside it
        (left_out if linked or _is_output(path) else kept).append(path)
    return kept, left_out


def _is_output(path: Path) -> bool:
    """Whether an adaptation has made a file, or a folder or what is in it."""
    from mipmap_plugin.models import detect
    from mipmap_plugin.models.outputs import is_adapted
    from mipmap_plugin.models.places import MANIFEST, PAGE_ENDING, PLAN, TILES

    if is_adapted(path) or path.name.endswith(PAGE_ENDING) or (path / MANIFEST).is_file() or (path.name.endswith(TILES) and (path / PLAN).is_file()):
        return True
    try:
        return path.is_dir() and is_adapted(detect(path).path)
    except (CheckpointError, OSError):  # a job of its own says what is wrong with it
        return False


def shard(items: Sequence[Item], part: int, parts: int) -> list[Item]:
    """Every `parts`-th item from the `part`-th on, counted from 1: all parts together are all items, each once. Raises SettingsError."""
    if not 1 <= part <= parts:
        raise SettingsError(f"--shard {part}/{parts}: there is no such part; give 1/{max(parts, 1)} to {max(parts, 1)}/{max(parts, 1)}")
    return list(items[part - 1 :: parts])
