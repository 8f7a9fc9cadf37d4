"""Checks of a pickle's instructions before any of them is executed."""

from __future__ import annotations

import pickletools
import re
import zipfile
from pathlib import Path
from typing import IO

# Bytes of instructions. The pickles of checkpoints have a few kB, the state dict of a large network some hundred. This many take at most
# 15 seconds to check.
MAX_PICKLE = 8 * 1024 * 1024

# Limit of the unpacked size of a compressed file's numbers, relative to its size on disk: trained weights compress by a tenth.
MOST_PACKED = 2

# Globals in the pickles of checkpoints: tensors, dictionaries, numbers. Some globals that torch considers safe are not: they allocate as
# much memory as a number in the pickle says, or change existing objects.
KNOWN = re.compile(
    r"collections (OrderedDict|Counter)|builtins (set|complex)|_codecs encode"
    r"|torch (\w+Storage|Size|device|float\d+|bfloat16|u?int\d+|bool|complex\d+|per_\w+|q\w+)"
    r"|torch\.storage (UntypedStorage|TypedStorage|_LegacyStorage)"
    r"|torch\._utils (_rebuild_tensor(_v2)?|_rebuild_parameter|_rebuild_qtensor|_rebuild_sparse_tensor|_rebuild_meta_tensor_no_storage)"
    r"|torch\.serialization _get_layout|torch\.nn\.parameter Parameter"
    r"|numpy\.(_core|core)\.multiarray scalar|numpy dtype|numpy\.dtypes \w+DType"
)

# Instructions that no file of torch.save and no TorchScript contains: other ways to create objects, and mutable buffers.
REFUSED = {"INST", "OBJ", "NEWOBJ_EX", "STACK_GLOBAL", "EXT1", "EXT2", "EXT4", "BYTEARRAY8", "NEXT_BUFFER", "READONLY_BUFFER"}

# Length beyond which a text with characters outside Latin-1 may take long to encode.
LONG_TEXT = 1000


def refuse_hostile(path: Path) -> None:
    """Raise ValueError for a torch file whose pickle needs more than data, or that unpacks to far more bytes than it has on disk."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            refuse_packed(archive, path)
            for name in archive.namelist():
                if name.endswith("/data.pkl"):
                    with archive.open(name) as file:
                        scan(file, KNOWN)
        return
    with path.open("rb") as file:  # the older format: a magic number, a version, system information, the content, and the keys of storages
        for _ in range(5):
            scan(file, KNOWN)


def refuse_packed(archive: zipfile.ZipFile, path: Path) -> None:
    """Raise ValueError for an archive whose numbers unpack to far more bytes than it has; torch compresses code and pickles only."""
    if sum(member.file_size for member in archive.infolist() if "/data/" in member.filename) > MOST_PACKED * path.stat().st_size:
        raise ValueError("its numbers unpack to more than it is on disk, which those of no torch file do; save it again")


def scan(file: IO[bytes], known: re.Pattern[str] | None) -> None:
    """Read one pickle up to its end. Raises ValueError for refused instructions, and for globals that do not match `known`."""
    encodes, long_text, began = False, False, file.tell()
    for operation, argument, at in pickletools.genops(file):
        if operation.name in REFUSED:
            raise ValueError(f"its pickle has the instruction {operation.name}, which no checkpoint has")
        if operation.name == "GLOBAL" and known is not None and not known.fullmatch(str(argument)):
            raise ValueError(f"it asks for {str(argument).replace(' ', '.')[:80]}")
        done = (at or began) - began
        if operation.name in ("PUT", "LONG_BINPUT") and not 0 <= int(argument or 0) <= done:
            raise ValueError("its pickle numbers more objects than it has room for")
        if done > MAX_PICKLE:
            raise ValueError(f"its pickle has more than {MAX_PICKLE >> 20} MB")
        encodes |= argument == "_codecs encode"
        long_text |= isinstance(argument, str) and len(argument) > LONG_TEXT and max(argument) > "\xff"
    if encodes and long_text:
        raise ValueError("it has bytes in place of text")
