"""Types of files by their first bytes, whatever their names are. Nothing is executed."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mipmap_plugin.errors import CheckpointError, brief
from mipmap_plugin.formats.nodes import no_file

# Beginning of a placeholder for a file that Git LFS has not fetched.
LFS_POINTER = b"version https://git-lfs"

# Beginning of a gzip stream, as SPZ is in its versions up to 3.
GZIP = b"\x1f\x8b"

# Bytes that are read to recognize a format; a .splat file has no magic number and is recognized by its first records.
HEAD = 64 * 1024

# Bytes of a pickle that are searched for names; that of a gsplat or splatfacto checkpoint has a few kB.
MAX_PICKLE = 16 * 1024 * 1024

# A splat in a .splat file (antimatter15/splat); its quaternion is wxyz around 128.
SPLAT_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def read_head(path: Path, size: int = HEAD) -> bytes:
    """The first `size` bytes of a file. Raises CheckpointError if it is empty, or a placeholder for the data."""
    try:
        if trouble := no_file(path):
            raise CheckpointError(f"{path} {trouble}; give a file or a model folder")
        with path.open("rb") as file:
            head = file.read(size)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}; check the path, and who may read it") from error
    _refuse_placeholder(path, head)
    return head


def _refuse_placeholder(path: Path, head: bytes) -> None:
    start = head[:512].lstrip().lower()
    if not head:
        raise CheckpointError(f"{path} is empty; download or export it again")
    if start.startswith(LFS_POINTER):
        size = re.search(rb"size (\d{1,20})\b", head)
        target = f" of a file of {int(size[1]):,} bytes" if size else ""
        raise CheckpointError(f"{path} is only the Git-LFS pointer{target}; run `git lfs pull` in its repository")
    if start.startswith((b"<!doctype", b"<html", b"<?xml")):
        if path.suffix.lower() in (".html", ".htm"):
            raise CheckpointError(f"{path} is a web page; if it shows a scene, as SuperSplat exports them, export the scene as a PLY")
        raise CheckpointError(f"{path} is a web page, so the download went wrong; download it again")
    if start.startswith((b'{"error', b'{"message', b'{"status')):
        raise CheckpointError(f"{path} is a server's error message, so the download went wrong; download it again")


def kind_of(path: Path) -> str:
    """One of: ply, spz, sog, gsplat-png, zip, gzip, torch, torchscript, glb, 3d-tiles, ksplat, splat, unknown.

    Raises CheckpointError (`read_head`).
    """
    head = read_head(path)
    if re.match(rb"ply\s", head):
        return "ply"
    if head.startswith(GZIP):
        return "spz" if _inflated(head) == b"NGSP" else "gzip"
    for magic, kind in {b"NGSP": "spz", b"glTF": "glb", b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19": "torch"}.items():
        if head.startswith(magic):
            return kind
    if head.startswith(b"PK\x03\x04"):
        return _kind_of_zip(path)
    if head.lstrip().startswith(b"{"):
        return _kind_of_json(head)
    size = path.stat().st_size
    if head.startswith(b"\x00\x01\x00\x00") and size >= 5120 and int.from_bytes(head[20:22], "little") <= 2:
        return "ksplat"
    return "splat" if _plausible_splat(head, size, path.suffix.lower() == ".splat") else "unknown"


def pickle_of(path: Path) -> bytes:
    """The first bytes of a torch file's pickle, for searching only; empty if it has none. Raises CheckpointError."""
    if not is_archive(path):
        return read_head(path, MAX_PICKLE)
    with archive(path) as opened:
        pickles = [name for name in opened.namelist() if name.endswith("data.pkl")]
        if not pickles:
            return b""
        with opened.open(pickles[0]) as file:
            return file.read(MAX_PICKLE)


def texts_in(pickle: bytes, begins: str) -> tuple[str, ...]:
    """The texts in a pickle that begin so and a blank, by the lengths before them (BINUNICODE); nothing is unpickled."""
    places = [found.end() for found in re.finditer(rb"X....(?=" + re.escape(begins.encode()) + b" )", pickle, re.DOTALL)]
    return tuple(pickle[at : at + int.from_bytes(pickle[at - 4 : at], "little")].decode(errors="replace") for at in places)


def _inflated(head: bytes) -> bytes:
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 4)
    except zlib.error:
        return b""


def _kind_of_json(head: bytes) -> str:
    """The type of a JSON file: an unpacked SOG lists images or parts, gsplat's PngCompression lists shapes, glTF names an extension."""
    if b'"geometricError"' in head:
        return "3d-tiles"
    if b"KHR_gaussian_splatting" in head:
        return "glb"
    if b".webp" in head or b"meta.json" in head:
        return "sog"
    if b'"asset"' in head and any(name in head for name in (b'"bufferViews"', b'"accessors"', b'"nodes"')):
        return "glb"
    return "gsplat-png" if all(name in head for name in (b'"means"', b'"shape"', b'"mins"', b'"quats"')) else "unknown"


def is_archive(path: Path) -> bool:
    """Whether a file is a zip archive, which may be damaged (`archive`)."""
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # its last bytes say that it is one of several parts
        return True


@contextmanager
def archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """An open zip archive. Raises CheckpointError for any error of a damaged archive, also inside the block."""
    try:
        with zipfile.ZipFile(path) as opened:
            yield opened
    except CheckpointError:
        raise
    except Exception as error:  # bad offsets, names, versions, checksums and streams raise different exceptions
        raise CheckpointError(f"{path} is a damaged zip archive ({brief(error)}); download or copy it again") from error


def _kind_of_zip(path: Path) -> str:
    with archive(path) as opened:
        names = opened.namelist()
    leaves = {name.rpartition("/")[2] for name in names}
    if "data.pkl" in leaves:
        compiled = any("/code/" in name for name in names) or "constants.pkl" in leaves
        return "torchscript" if compiled else "torch"
    return "sog" if "meta.json" in leaves and any(leaf.endswith(".webp") for leaf in leaves) else "zip"


def _plausible_splat(head: bytes, size: int, named: bool) -> bool:
    """Whether the file consists of complete records with values that are plausible for splats, and is no text, such as a mesh in an .obj.

    `named`: it is called .splat. Then quaternions may be of any length, as converters of point clouds write them, whose round splats look
    alike however they are turned, sizes may be 0, and less than half of the records may hold no numbers (`without_invalid` leaves these out).
    """
    if size % SPLAT_RECORD.itemsize or head.isascii():
        return False
    rows = np.frombuffer(head[: len(head) // SPLAT_RECORD.itemsize * SPLAT_RECORD.itemsize], SPLAT_RECORD)
    if named:
        finite = np.isfinite(rows["position"]).all(axis=1) & np.isfinite(rows["scale"]).all(axis=1)
        rows = rows[finite] if finite.mean() > 0.5 else rows
    scale = rows["scale"]
    if not (np.isfinite(rows["position"]).all() and (scale >= 0).all() and (scale < 1e6).all()):
        return False
    length = np.linalg.norm(rows["quat"].astype(np.float32) / 128 - 1, axis=1)
    return named or bool((scale > 0).all() and ((length > 0.5) & (length < 1.8)).all())
