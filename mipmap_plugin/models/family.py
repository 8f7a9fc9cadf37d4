"""The contract of a family: what tells its checkpoints from those of others, and what loads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.magic import kind_of, pickle_of
from mipmap_plugin.formats.ply import Header, read_header
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models.places import around

# Raised by one when a family that was written for the old contract no longer works.
API_VERSION = 1

# How sure a family can be: by what no other's files have; by files that lie beside the splats; by what many have.
CERTAIN, BY_COMPANIONS, PLAIN = 1.0, 0.8, 0.5

# The columns without which a PLY holds no splats.
OF_SPLATS = frozenset({"opacity", "scale_0", "rot_0"})


@dataclass(frozen=True)
class Match:
    """A family's answer to whether a file is its own."""

    sure: float  # 0..1
    why: str  # what tells it
    trouble: str = ""  # a sentence: why it cannot be loaded all the same
    lacks: tuple[str, ...] = ()  # files that should lie beside it; of a model folder an older iteration that has them is taken


class Files:
    """The file that holds the splats and what lies around it; each part is read once, when a family first looks at it.

    Raises CheckpointError for what cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder, self.iteration = around(path)  # the model folder; None: there is none

    @cached_property
    def kind(self) -> str:
        """What the file is by its first bytes (`magic.kind_of`): "ply", "torch", "zip", ..., "unknown"."""
        return kind_of(self.path)

    @cached_property
    def header(self) -> Header | None:
        """Of a PLY."""
        return read_header(self.path) if self.kind == "ply" else None

    @cached_property
    def columns(self) -> frozenset[str]:
        """The names of a PLY's columns of vertices; none for another file."""
        return frozenset(self.header.vertex.names) if self.header and not self.compressed else frozenset()

    @property
    def comments(self) -> tuple[str, ...]:
        """Of a PLY's header."""
        return self.header.comments if self.header else ()

    @property
    def provenance(self) -> dict[str, Any]:
        """What this package wrote into the header of an adapted PLY."""
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
        """The cfg_args of the model folder; none where there is no such file."""
        return read_cfg_args(self.folder / "cfg_args") if self.folder and (self.folder / "cfg_args").is_file() else {}

    def words(self, *wanted: str) -> set[str]:
        """Which of these words stand in a torch file's pickle, which is searched as bytes and never unpickled."""
        return {word for word in wanted if word.encode() in self._pickle}

    @cached_property
    def _pickle(self) -> bytes:
        return pickle_of(self.path) if self.kind == "torch" else b""


@dataclass(frozen=True)
class Family:
    """One kind of checkpoint. Built-in ones are such records (`families`), and a stranger's is no other."""

    name: str  # short, as reports name it
    title: str  # as its authors write it
    recognize: Callable[[Files], Match | None]  # None: the file is not its own
    api_version: int
    # (path, *, iteration) -> SplatModel, or "package.module:function"; the path is what a user gave, a file or a folder, in which `detect`
    # finds the file. None: it is not read.
    load: str | Callable[..., Any] | None = None
    before: tuple[str, ...] = ()  # families whose claim to the same file counts for nothing
    place: tuple[str, str] | None = None  # below a folder of results: a folder, and the pattern of a file's name, perhaps with a group `step`
    not_loaded: str = ""  # what more is to be said of a family that is not read
