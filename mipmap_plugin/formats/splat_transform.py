"""Exchange formats of viewers and phones, converted by PlayCanvas' splat-transform in a separate process.

If it is not installed, the error message gives the command that installs it. Files are passed by absolute paths with the suffix of their
format, because splat-transform recognizes formats by suffix only, and executes files with some other suffixes.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import TEMPORARY, CheckpointError, OutputError, SettingsError
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.tags import mark_antialiased, mode_in_exchange, render_mode

# `magic.kind_of` -> name of the format, and the suffix by which splat-transform recognizes it.
EXCHANGE = {
    "spz": ("SPZ", ".spz"),
    "sog": ("SOG", ".sog"),
    "ksplat": ("KSPLAT", ".ksplat"),
    "splat": ("SPLAT", ".splat"),
    "compressed": ("compressed PLY", ".compressed.ply"),
}

# Suffixes of the formats that are written. splat-transform writes them, except GLB (`formats.glb`) and SOG (`formats.sog`), which it only reads back.
WRITTEN = (".spz", ".sog", ".compressed.ply", ".glb")
READ_ONLY = tuple(ending for _, ending in EXCHANGE.values() if ending not in WRITTEN)

# The oldest version of splat-transform that is needed to write a file, by its suffix: of a lod-meta.json, one that has the options of `streamed_sog`;
# of a SOG, the oldest that was seen to read back what `formats.sog` writes.
OLDEST: dict[str, tuple[int, ...]] = {".sog": (2, 7), ".json": (3, 0), ".spz": (2, 1)}

# The file of a ladder of SOGs, which viewers stream, and the oldest version of splat-transform that reads its finest level.
LOD_META, OLDEST_FOR_STREAMED = "lod-meta.json", (3, 2)

# The last version of SPZ that Spark 2.2 reads, and the first that splat-transform can write; its own choice is 4.
SPZ_VERSION = "3"

# The highest SH degree that its versions from 3.0 on read and write, though SPZ itself has room for 4.
MOST_BANDS = 3

# From 2.1 until 3.0, splat-transform turned splats by half a turn about x when it read SPZ and when it wrote it; before and since, it leaves them
# in the frame in which they are stored.
TURNS_SPZ = ((2, 1), (3, 0))

# Suffixes of other kinds of files. A model is not written to a folder with such a name: whoever gives it expects a file.
OF_FILES = (".pt", ".pth", ".ckpt", ".npz", ".npy", ".glb", ".gltf", ".obj", ".usd", ".usdz", ".html", ".json", ".csv", ".txt", ".zip", ".png")

TOOL = "splat-transform"
INSTALL = "npm install -g @playcanvas/splat-transform"

# Seconds; ten million splats take one minute.
LONGEST = 1200


def written_ending(path: Path) -> str:
    """The suffix of the exchange format that is written to a path; "" for a path of anything else."""
    return next((ending for ending in WRITTEN if path.name.lower().endswith(ending)), "")


def is_written(path: Path) -> bool:
    """Whether a path has the suffix of an exchange format that can be written."""
    return bool(written_ending(path))


def refuse_exchange(path: Path) -> list[str]:
    """The command of splat-transform. Raises SettingsError, naming the output `path`, if it is not installed, or too old for this format."""
    tool = find_tool()
    if tool is None:
        instead = "; or give a .ply" if is_written(path) else ""  # of a file; the name of a folder may have a dot
        raise SettingsError(f"{path}: this format takes {TOOL}, which is not installed; run: {INSTALL}{instead}")
    oldest = OLDEST.get(path.suffix.lower(), ())
    if reason := _too_old(tool, oldest):
        raise SettingsError(f"{path}: {reason}; or {'leave Streamed SOG out' if path.name == LOD_META else 'give a .ply'}")
    return tool


def _too_old(tool: Sequence[str], oldest: Sequence[int]) -> str:
    """Why a newer version of splat-transform is needed than is installed; "" if none is, or it does not say what it is."""
    version = _version(tool) if oldest else ()
    if not version or version >= tuple(oldest):
        return ""
    node = ", which needs Node.js 22" if tuple(oldest) >= (3, 0) else ""
    return f"{TOOL} {_dotted(version)} is too old for it, and {_dotted(oldest)} or newer is needed{node}; run: {INSTALL}@latest"


def _version(tool: Sequence[str]) -> tuple[int, ...]:
    """The version of splat-transform, such as (3, 7, 0); empty if it does not say."""
    found = re.search(r"\d+(\.\d+)+", answer([*tool, "--version"]) or "")
    return tuple(map(int, found[0].split("."))) if found else ()


def _dotted(version: Sequence[int]) -> str:
    return ".".join(map(str, version))


def refuse_ending(path: Path) -> None:
    """Raise SettingsError for an output whose name has the suffix of an exchange format, or of another kind of file."""
    names = {ending: name for name, ending in EXCHANGE.values()}
    for ending in (*names, *OF_FILES):
        if path.name.lower().endswith(ending):
            raise SettingsError(f"{path}: this model is not written as {names.get(ending, ending)}; give a .ply, or the path of a folder")


@contextmanager
def as_ply(path: Path, kind: str) -> Iterator[Path]:
    """A temporary PLY, for the duration of the block, of the splats in an exchange file of this `kind` (a key of EXCHANGE).

    Raises CheckpointError.
    """
    from mipmap_plugin.formats.damage import damage_of  # and NumPy, without which options are read
    from mipmap_plugin.formats.sog import WHOLE_FOLDER, completed, environment_of

    name, ending = EXCHANGE[kind]
    tool = find_tool()
    if tool is None:
        raise CheckpointError(f"{path} is {name}, an exchange format, which {TOOL} reads, but {TOOL} is not installed; run: {INSTALL}")
    if reason := _too_old(tool, OLDEST_FOR_STREAMED if path.name == LOD_META else ()):
        raise CheckpointError(f"{path} is Streamed SOG: {reason}")
    if reason := damage_of(path):
        raise CheckpointError(f"{path} is damaged ({reason}); download or export it again")
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        source = path.absolute()
        if not (path.suffix == ".json" or path.name.lower().endswith(ending)):  # an unpacked SOG is recognized by the name of its meta.json
            source = Path(folder, f"source{ending}")
            shutil.copyfile(path, source)
        plain = Path(folder, "plain.ply")
        inputs = [completed(source, Path(folder)) if kind == "sog" else source]
        if path.name == LOD_META:
            inputs += environment_of(source)
        if reason := run_tool(tool, inputs, plain):
            if answer([*tool, "--version"]) is None:  # as where packages that it needs are missing, or with an old Node.js
                raise CheckpointError(f"{path} is {name}, which {TOOL} reads, but {TOOL} does not start ({reason}); run: {INSTALL}")
            advice = WHOLE_FOLDER if path.suffix == ".json" and "ENOENT" in reason else "export it again"  # Node.js' word for a missing file
            raise CheckpointError(f"{path} is {name}, but {TOOL} does not read it ({reason}); {advice}")
        try:
            _settle_frame(tool, source, plain)
            _settle_mode(_mode(source, kind), plain)
            yield plain
        except CheckpointError as error:
            raise CheckpointError(str(error).replace(str(plain), f"{path}, as {TOOL} reads it")) from error


def write_exchange(path: Path, write: Callable[[Path], Any], *, overwrite: bool) -> Path:
    """Convert the PLY that `write` writes to the exchange format given by the suffix of `path`, atomically; return `path`.

    Raises SettingsError (`refuse_exchange`), OutputExists, OutputError.
    """
    from mipmap_plugin.formats.ply import read_ply  # and NumPy, as above
    from mipmap_plugin.formats.sog import write_sog

    tool = refuse_exchange(path)
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder, new_file(path, overwrite) as temporary:
        plain, converted = Path(folder, "plain.ply"), Path(folder, f"made{written_ending(path)}")
        write(plain)
        if converted.suffix == ".sog":
            write_sog(converted, read_ply(plain).columns, antialiased=_mode(plain) == "antialiased")
        else:
            _convert(tool, plain, converted, path)
        shutil.copyfile(converted, temporary)
    return path


def _convert(tool: Sequence[str], plain: Path, converted: Path, path: Path) -> None:
    """Convert a PLY by splat-transform. Raises OutputError, naming the output `path`."""
    from mipmap_plugin.formats.ply import read_ply  # as above
    from mipmap_plugin.formats.spz import refine

    kind = next(kind for kind, (_, suffix) in EXCHANGE.items() if converted.name.endswith(suffix))
    columns = read_ply(plain).columns if kind == "spz" else {}  # in the frame of the file
    _settle_frame(tool, converted, plain)
    if reason := run_tool(tool, [plain], converted):
        raise OutputError(f"{path}: {TOOL} does not write it ({reason})")
    if columns:
        refine(converted, columns)
    if _mode(plain) == "antialiased" and not _mode(converted, kind):
        mark_antialiased(converted)


def find_tool() -> list[str] | None:
    """The command on the PATH, or the one that npx finds without downloading; None if there is neither."""
    if found := shutil.which(TOOL):
        return [found]
    npx = shutil.which("npx")
    if npx is None:
        return None
    command = [npx, "--no-install", TOOL]
    return None if answer([*command, "--version"]) is None else command


def answer(command: Sequence[str]) -> str | None:
    """What a program prints within a minute; None if it cannot be started, or fails."""
    try:
        told = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return told.stdout + told.stderr if told.returncode == 0 else None


def run_tool(tool: Sequence[str], inputs: Sequence[str | Path], target: Path) -> str:
    """Run splat-transform on inputs and their options. Returns its error message, empty on success."""
    options = ["--gpu", "cpu", *(["--spz-version", SPZ_VERSION] if is_spz(target) else [])]
    command = [*tool, "--quiet", "--overwrite", *options, *map(str, inputs), str(target)]
    try:
        done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return f"not ready after {LONGEST // 60} minutes"
    except OSError as error:
        return str(error)[:160]
    if done.returncode == 0 and target.is_file():
        return ""
    return reason_in(done.stderr + done.stdout) or f"exit code {done.returncode}"


def _settle_frame(tool: Sequence[str], file: Path, ply: Path) -> None:
    """Turn the splats of a PLY that were, or will be, turned on their way from or to `file`."""
    if is_spz(file) and TURNS_SPZ[0] <= _version(tool) < TURNS_SPZ[1]:
        from mipmap_plugin.formats.spz import half_turned  # and NumPy, without which options are read

        half_turned(ply)


def _settle_mode(mode: str | None, ply: Path) -> None:
    """Say in a converted PLY how the file that it was made of is to be drawn, which splat-transform does itself since 3.0."""
    if mode not in ("antialiased", "2dgs") or _mode(ply):
        return
    from mipmap_plugin.formats.ply import read_ply, write_ply  # as above

    plain = read_ply(ply)
    write_ply(ply, plain.columns, [*plain.comments, f"SplatRenderMode: {'mip' if mode == 'antialiased' else mode}"], overwrite=True)


def _mode(file: Path, kind: str = "ply") -> str | None:
    """How a file says that it is to be drawn (`render_mode`)."""
    if kind not in ("ply", "compressed"):
        return mode_in_exchange(file, kind)
    from mipmap_plugin.formats.ply import read_header

    return render_mode(read_header(file).comments)


def is_spz(path: Path) -> bool:
    """Whether a path is that of an SPZ."""
    return written_ending(path) == ".spz"


def reason_in(said: str) -> str:
    """What splat-transform says went wrong: its line with the error, before a trace and a summary, or else its last one."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    errors = [found[1] for line in lines if (found := re.search(r"Error(?: \[\w+\])?: (.*)", line))]
    others = [line.removeprefix("✗ ") for line in lines if not re.match("at |✗ failed in ", line)]  # an error may have no text but its type
    return (errors or others[-1:] or lines[-1:] or [""])[0][:160]
