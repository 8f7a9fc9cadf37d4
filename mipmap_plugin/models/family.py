"""The contract of a family: how its checkpoints are recognized and loaded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.magic import kind_of, pickle_of
from mipmap_plugin.formats.ply import Header, read_header
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models.places import around

# Incremented when families that were written for the old contract no longer work.
API_VERSION = 1

# Degrees of certainty: by features that only this family's files have; by files beside the splats; by features that many families share.
CERTAIN, BY_COMPANIONS, PLAIN = 1.0, 0.8, 0.5

# The columns without which a PLY holds no splats.
OF_SPLATS = frozenset({"opacity", "scale_0", "rot_0"})


@dataclass(frozen=True)
class Match:
    """A family's claim that a file is its own.

    Attributes:
        sure: Certainty, 0..1.
        why: The feature by which it was recognized.
        trouble: A sentence: why it cannot be loaded nevertheless.
        lacks: Files missing beside it; of a model folder, an older iteration that has them is loaded instead.
    """

    sure: float
    why: str
    trouble: str = ""
    lacks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.sure, (int, float)) or not 0 <= self.sure <= 1:
            raise SettingsError(f"sure must be a number from 0 to 1, got {self.sure!r}")


class Files:
    """The file that holds the splats, and the files around it. Each part is read once, on first access.

    Raises CheckpointError for files that cannot be read.

    Attributes:
        path: The file that holds the splats.
        folder: The model folder around it; None: there is none.
        iteration: That of the file in a model folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder, self.iteration = around(path)

    @cached_property
    def kind(self) -> str:
        """The file's type by its first bytes (`magic.kind_of`): "ply", "torch", "zip", ..., "unknown"."""
        return kind_of(self.path)

    @cached_property
    def header(self) -> Header | None:
        """The header of a PLY; None for other files."""
        return read_header(self.path) if self.kind == "ply" else None

    @cached_property
    def columns(self) -> frozenset[str]:
        """The names of a PLY's vertex columns; empty for other files."""
        return frozenset(self.header.vertex.names) if self.header and not self.compressed else frozenset()

    @property
    def comments(self) -> tuple[str, ...]:
        """The comments in a PLY's header."""
        return self.header.comments if self.header else ()

    @property
    def provenance(self) -> dict[str, Any]:
        """The provenance that this package wrote into the header of an adapted PLY."""
        return provenance_of(self.comments) or {}

    @property
    def compressed(self) -> bool:
        """Whether a PLY holds packed splats (SuperSplat's compressed PLY)."""
        return self.header is not None and any("packed_position" in element.names for element in self.header.elements)

    @property
    def holds_splats(self) -> bool:
        """Whether a PLY has the columns of 3DGS."""
        return self.columns >= OF_SPLATS

    @cached_property
    def options(self) -> dict[str, Any]:
        """The cfg_args of the model folder; {} if there is no such file."""
        return read_cfg_args(self.folder / "cfg_args") if self.folder and (self.folder / "cfg_args").is_file() else {}

    def words(self, *wanted: str) -> set[str]:
        """Which of these words occur in a torch file's pickle, which is searched as bytes and never unpickled."""
        return {word for word in wanted if word.encode() in self._pickle}

    def strings(self, *wanted: str) -> set[str]:
        """Which of these are strings of a torch file's pickle, each as a whole: a key of a dictionary, for example."""
        return {text for text in wanted if any(code + text.encode() in self._pickle for code in _beginnings(text))}

    @cached_property
    def _pickle(self) -> bytes:
        return pickle_of(self.path) if self.kind == "torch" else b""


def _beginnings(text: str) -> tuple[bytes, bytes, bytes]:
    """How a string of this length begins in a pickle: BINUNICODE, SHORT_BINUNICODE, and Python 2's SHORT_BINSTRING."""
    length = len(text.encode())
    return b"X" + length.to_bytes(4, "little"), b"\x8c" + length.to_bytes(1, "little"), b"U" + length.to_bytes(1, "little")


@dataclass(frozen=True)
class Family:
    """One kind of checkpoint. Built-in (`families`) and third-party families are such records.

    Attributes:
        name: Short name, used in reports.
        title: The name its authors use.
        recognize: A file -> the claim that it is of this family; None: it is not.
        load: `(path, *, iteration) -> SplatModel`, or "package.module:function". The path is the user's, a file or a folder, in which `detect`
            finds the file. None: recognized, but not loaded.
        before: Families over which this one takes precedence when both claim a file.
        place: In a result folder: the subfolder and the pattern of file names, which may have a group `step`.
        api_version: `API_VERSION` of the contract that it was written for.
        not_loaded: Addition to the message for a family that is not loaded.
        saves: Suffix of the files that its models save, such as ".ply"; None: that of the file that was read. It ends the names that the
            command line gives.
    """

    name: str
    title: str
    recognize: Callable[[Files], Match | None]
    api_version: int
    load: str | Callable[..., Any] | None = None
    before: tuple[str, ...] = ()
    place: tuple[str, str] | None = None
    not_loaded: str = ""
    saves: str | None = None
