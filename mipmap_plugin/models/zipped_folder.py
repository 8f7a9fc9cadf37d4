"""A model folder in a zip archive, as clusters and cloud drives hand it out: unpacked once for as long as this process lives."""

from __future__ import annotations

import re
import tempfile
import threading
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from mipmap_plugin.errors import TEMPORARY, CheckpointError, warn
from mipmap_plugin.formats.magic import archive, is_archive
from mipmap_plugin.formats.zipped import copied, only_ply, refuse_large
from mipmap_plugin.models.places import PARTS

# The file by which a model folder is known, after the name of the folder.
SPLATS = re.compile(r"(?:(.*)/)?(?:point_cloud/(?:coarse_)?iteration_\d+/point_cloud\.ply|ckpts/ckpt_\w+\.pt|nerfstudio_models/step-\d+\.ckpt)")

_OPENED: dict[tuple[Path, int, int], tuple[tempfile.TemporaryDirectory[str], Path]] = {}  # the folder is removed with its first part
_LOCK = threading.Lock()


def unzipped(path: Path) -> Path:
    """The unpacked model folder of a zip archive that holds one; `path` itself if it is anything else. Raises CheckpointError."""
    if not (path.is_file() and is_archive(path)) or (root := _root(path)) is None:
        return path
    state = path.stat()
    with _LOCK:
        key = path.absolute(), state.st_mtime_ns, state.st_size
        if key not in _OPENED:
            place = tempfile.TemporaryDirectory(prefix=TEMPORARY)
            _OPENED[key] = place, _unpack(path, root, Path(place.name, path.stem or "model"))
        return _OPENED[key][1]


@contextmanager
def retold(retell: Callable[[object], str]) -> Iterator[None]:
    """Raise the errors (CheckpointError) of this block and repeat its warnings with the words that `retell` makes of them."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        try:
            yield
        except CheckpointError as error:
            raise CheckpointError(retell(error)) from error
    for doubt in doubts:
        warn(retell(doubt.message), doubt.category)


def with_archives_named(words: object) -> str:
    """What is said of files, with the names of archives in place of the folders that these were unpacked to (`retold`)."""
    text = str(words)
    for (path, *_), (_, folder) in list(_OPENED.items()):
        text = text.replace(str(folder), str(path))
    return text


def _root(path: Path) -> str | None:
    """The name of the model folder in an archive, "" if it is the archive itself; None if it holds none, or nothing but one PLY."""
    with archive(path) as inside:
        roots = sorted({found[1] or "" for name in inside.namelist() if (found := SPLATS.fullmatch(name))})
    if len(roots) > 1:
        raise CheckpointError(f"{path} holds {len(roots)} model folders ({', '.join(roots[:3])}); unpack it and give one of them")
    return roots[0] if roots and only_ply(path) is None else None


def _unpack(path: Path, root: str, folder: Path) -> Path:
    """Write what is read of a model folder to `folder`; return it. Raises CheckpointError, also for a name that leads out of the folder."""
    with archive(path) as inside:
        read = _read_of(inside.infolist(), f"{root}/" if root else "")
        if wrong := next((entry.filename for names, entry in read.items() if ".." in names), None):
            raise CheckpointError(f"{path} holds the name {wrong!r}, which leads out of its folder; do not open it")
        refuse_large(path, sum(entry.file_size for entry in read.values()), folder.parent)
        for names, entry in read.items():
            copied(path, inside, entry, folder.joinpath(*names))
    return folder


def _read_of(entries: Iterable[zipfile.ZipInfo], prefix: str) -> dict[tuple[str, ...], zipfile.ZipInfo]:
    """What is read of the model folder with that `prefix`, by the parts of its name in the folder; not its pictures.

    Nor what has a name that Windows takes for a place: a log may be called by its time, but nothing that is read is.
    """
    named = {PurePosixPath(entry.filename.removeprefix(prefix)).parts: entry for entry in entries if entry.filename.startswith(prefix)}
    files = {names: entry for names, entry in named.items() if not entry.is_dir() and not set("\\:") & set("".join(names))}
    return {names: entry for names, entry in files.items() if len(names) == 1 or names[0] in PARTS}
