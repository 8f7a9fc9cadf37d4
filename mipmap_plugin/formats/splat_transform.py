"""Exchange formats of viewers and phones, read and written through PlayCanvas' splat-transform, in a process of its own.

Where it is not installed, a sentence says the one command that installs it. Files get there by absolute paths with the endings that it
knows formats by, for it does not look at bytes, and takes other endings for programs.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError, OutputError, SettingsError
from mipmap_plugin.formats.atomic import new_file

# By `magic.kind_of`: the format's name, and the ending by which splat-transform knows it.
EXCHANGE = {
    "spz": ("SPZ", ".spz"),
    "sog": ("SOG", ".sog"),
    "ksplat": ("KSPLAT", ".ksplat"),
    "splat": ("SPLAT", ".splat"),
    "compressed": ("compressed PLY", ".compressed.ply"),
}

# What it writes of these.
WRITTEN = (".spz", ".sog", ".compressed.ply")
READ_ONLY = tuple(ending for _, ending in EXCHANGE.values() if ending not in WRITTEN)

TOOL = "splat-transform"
INSTALL = "npm install -g @playcanvas/splat-transform"

# Seconds; ten million splats take one minute.
LONGEST = 1200


def is_written(path: Path) -> bool:
    """Whether a path's ending asks for an exchange format."""
    return path.name.lower().endswith(WRITTEN)


def refuse_exchange(path: Path) -> list[str]:
    """The command of splat-transform, which writes `path`, whose ending asks for an exchange format. Raises SettingsError where it is absent."""
    tool = _tool()
    if tool is None:
        raise SettingsError(f"{path}: this format is written by {TOOL}, which is not installed; run: {INSTALL}; or give a .ply")
    return tool


def refuse_as_folder(path: Path) -> None:
    """Raise SettingsError for the name of a folder that ends as files of an exchange format do."""
    for name, ending in EXCHANGE.values():
        if path.name.lower().endswith(ending):
            raise SettingsError(f"{path}: this model is not written as {name}; give a .ply, or the path of a folder")


@contextmanager
def as_ply(path: Path, kind: str) -> Iterator[Path]:
    """A PLY of the splats in an exchange file of this `kind` (a key of EXCHANGE), for as long as the block runs. Raises CheckpointError."""
    name, ending = EXCHANGE[kind]
    tool = _tool()
    if tool is None:
        raise CheckpointError(f"{path} is {name}, an exchange format, which {TOOL} reads, and that is not installed; run: {INSTALL}")
    with tempfile.TemporaryDirectory(prefix="mipmap-plugin-") as folder:
        source = path.absolute()
        if not (path.suffix == ".json" or path.name.lower().endswith(ending)):  # an unpacked SOG is known by the name of its list
            source = Path(folder, f"source{ending}")
            shutil.copyfile(path, source)
        plain = Path(folder, "plain.ply")
        if reason := _run(tool, source, plain):
            raise CheckpointError(f"{path} is {name}, but {TOOL} does not read it ({reason}); export it again")
        yield plain


def write_exchange(path: Path, write: Callable[[Path], Any], *, overwrite: bool) -> Path:
    """Turn the PLY that `write` writes into the exchange format that the ending of `path` asks for, atomically; return `path`.

    Raises SettingsError (`refuse_exchange`), OutputExists, OutputError.
    """
    tool = refuse_exchange(path)
    with tempfile.TemporaryDirectory(prefix="mipmap-plugin-") as folder, new_file(path, overwrite) as temporary:
        ending = next(each for each in WRITTEN if path.name.lower().endswith(each))
        plain, made = Path(folder, "plain.ply"), Path(folder, f"made{ending}")
        write(plain)
        if reason := _run(tool, plain, made):
            raise OutputError(f"{path}: {TOOL} does not write it ({reason})")
        shutil.copyfile(made, temporary)
    return path


def _tool() -> list[str] | None:
    """The command, or None: that on the path, or one that npx finds without downloading."""
    if found := shutil.which(TOOL):
        return [found]
    npx = shutil.which("npx")
    if npx is None:
        return None
    command = [npx, "--no-install", TOOL]
    try:
        asked = subprocess.run([*command, "--version"], capture_output=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return command if asked.returncode == 0 else None


def _run(tool: list[str], source: Path, target: Path) -> str:
    """Why it failed, in its own words; empty where it did not."""
    # SOG's palette is found on a GPU where there is one; on the processor the same file comes out everywhere.
    command = [*tool, "--quiet", "--overwrite", "--gpu", "cpu", str(source), str(target)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=LONGEST, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)[:160]
    if done.returncode == 0 and target.is_file():
        return ""
    told = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
    return (told[-1] if told else f"exit code {done.returncode}")[:160]
