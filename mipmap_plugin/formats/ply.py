"""PLY files: validated before memory is allocated, read into columns, written atomically."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from mipmap_plugin.errors import CheckpointError, SettingsError, plural
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.magic import read_head

# Bytes. The header of splats of SH degree 3 has 1.5 kB; without a limit, a file without `end_header` would be searched to its end.
MAX_HEADER = 128 * 1024

# Rows that are written at a time, so that a file is never in memory as a whole: 16 MB for splats of SH degree 3.
WRITTEN_TOGETHER = 1 << 16

# What CloudCompare puts before the names of columns that it does not know, 3dgsconverter in files for CloudCompare, and both, one after the other.
PREFIXES = ("scalar_scal_", "scalar_", "scal_")

# Other elements of a PLY that are named in a note.
NAMED = 5

BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Element:
    """One `element` of a header. The type of a list is `list <length type> <value type>`."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]  # (name, type)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.properties)

    @property
    def has_lists(self) -> bool:
        return any(kind.startswith("list") for _, kind in self.properties)

    @property
    def stride(self) -> int:
        """Bytes of a binary row, at least: lists count as empty."""
        return sum(np.dtype(TYPES[kind.removeprefix("list ").split()[0]]).itemsize for _, kind in self.properties)

    def dtype(self, byte_order: str) -> np.dtype:
        return np.dtype([(name, byte_order + TYPES[kind]) for name, kind in self.properties])


@dataclass(frozen=True)
class Header:
    """The declarations of a PLY, checked against the size of the file."""

    format: str  # a key of BYTE_ORDER
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    body: int  # bytes from the start of the file to the first row
    notes: tuple[str, ...] = ()

    @property
    def vertex(self) -> Element:
        return next(element for element in self.elements if element.name == "vertex")

    def before(self, element: Element) -> tuple[Element, ...]:
        return self.elements[: self.elements.index(element)]

    def least_bytes(self, element: Element) -> int:
        """The least number of bytes of a row; in ascii, a digit and a blank per value."""
        return 2 * len(element.properties) if self.format == "ascii" else element.stride


@dataclass(frozen=True, eq=False)
class PlyFile:
    """The `vertex` element of a PLY."""

    columns: dict[str, np.ndarray]  # in file order, each [N], in the type and byte order of the file
    comments: tuple[str, ...]  # texts of `comment` and `obj_info` lines
    notes: tuple[str, ...] = ()  # what was tolerated, and what is left out, in sentences


def read_header(path: str | Path) -> Header:
    """The header of a complete PLY. Raises CheckpointError, saying what is wrong and what to do."""
    path = Path(path)
    head = read_head(path, MAX_HEADER)
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if first is None:
        raise CheckpointError(f"{path} is not a PLY file: it does not start with the line `ply`")
    # The first line's line break counts for the whole header (as in plyfile): the body may begin with a byte that looks like one.
    newline, blank = first[1], rb"[ \t\r]*" if first[1] == b"\n" else rb"[ \t]*"
    end = re.search(newline + rb"end_header" + blank + newline, head)
    if end is None:
        raise CheckpointError(f"{path} has no end_header in its first {MAX_HEADER // 1024} kB: it is cut off or not a PLY; download it again")
    header = _parsed(path, head[first.end() : end.start()].split(newline), end.end())
    return _without_prefix(_sized(path, header, path.stat().st_size - end.end()))


def read_ply(path: str | Path) -> PlyFile:
    """The rows of a PLY in ascii or either byte order, with any extra elements and column order. Raises CheckpointError."""
    path = Path(path)
    header = read_header(path)
    rows = read_element(path, header, header.vertex)
    others = [element.name for element in header.elements if element.count and element.name != "vertex"]
    named = ", ".join([*others[:NAMED], *["..."] * (len(others) > NAMED)])
    notes = (f"beside its splats it holds {named}, which are left out of files that are made of it",) if others else ()
    return PlyFile({name: rows[name] for name in header.vertex.names}, header.comments, (*header.notes, *notes))


def read_element(path: Path, header: Header, element: Element) -> np.ndarray:
    """The rows of an element of a PLY with this header. Raises CheckpointError, also where the file ends before they do."""
    least = sum(each.count * header.least_bytes(each) for each in (*header.before(element), element))
    if header.body + least > path.stat().st_size + (header.format == "ascii"):  # the last value needs no blank behind it
        raise CheckpointError(f"{path} is truncated: it ends before its element {element.name!r} does; download or copy it again")
    if header.format == "ascii" or any(other.has_lists for other in header.before(element)):
        return _read_through_plyfile(path, header, element)
    start = header.body + sum(other.count * other.stride for other in header.before(element))
    return np.fromfile(path, element.dtype(BYTE_ORDER[header.format]), element.count, offset=start)


def write_ply(path: str | Path, columns: Mapping[str, np.ndarray], comments: Iterable[str] = (), *, overwrite: bool = False) -> Path:
    """Write columns [N] as the `vertex` element, binary little endian, each in its own type. Atomic.

    Raises OutputExists; OutputError if the file cannot be written; SettingsError if the comments do not fit a header.
    """
    path = Path(path)
    dtype = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    count = len(next(iter(columns.values())))
    header = header_of_rows(path, dtype, count, comments)
    with new_file(path, overwrite) as temporary, temporary.open("xb") as file:
        file.write(header)
        for start in range(0, count, WRITTEN_TOGETHER):
            rows = np.empty(min(WRITTEN_TOGETHER, count - start), dtype)
            for name, column in columns.items():
                rows[name] = column[start : start + WRITTEN_TOGETHER]
            file.write(rows.tobytes())
    return path


def header_of_rows(path: Path, dtype: np.dtype, count: int, comments: Iterable[str]) -> bytes:
    """The header of a binary PLY, little endian, of `count` rows of this type. Raises SettingsError, naming `path`, for comments that do not fit."""
    declared = PlyElement.describe(np.broadcast_to(np.zeros((), dtype), (count,)), "vertex")
    lines = [" ".join(text.splitlines()).encode("ascii", "backslashreplace").decode() for text in comments]
    header: str = PlyData([declared], byte_order="<", comments=lines).header + "\n"
    if len(header) >= MAX_HEADER:
        raise SettingsError(f"{path}: comments and provenance take {len(header):,} bytes, but a PLY header holds {MAX_HEADER:,}; shorten them")
    return header.encode("ascii")


class _Fault(ValueError):
    """What is wrong with a line of a header, as part of a sentence."""


def _parsed(path: Path, lines: list[bytes], body: int) -> Header:
    form, elements, comments = "", [], []
    for number, line in enumerate(lines, start=2):
        try:
            keyword, rest = [*line.decode("utf-8", "replace").strip().split(maxsplit=1), "", ""][:2]
            words = line.decode("ascii", "backslashreplace").split()[1:]  # plyfile writes no other names, such as scalar fields may have
            if keyword == "format":
                form = rest.split()[0]
                if form not in BYTE_ORDER:
                    raise ValueError(form)
            elif keyword == "element":
                name, count = words[:2]
                elements.append(Element(name, int(count), ()))
                if elements[-1].count < 0:
                    raise ValueError(count)
            elif keyword == "property":
                elements[-1] = _with_property(elements[-1], words)
            elif keyword in ("comment", "obj_info"):
                comments.append(rest)
            elif keyword:
                raise ValueError(keyword)
        except (ValueError, IndexError) as error:
            why = f", {error}" if isinstance(error, _Fault) else ""
            wrong = f"line {number} of the PLY header cannot be read: {line[:80].decode('ascii', 'replace')!r}{why}"
            raise CheckpointError(f"{path}: {wrong}; export the file again") from error
    if not form:
        raise CheckpointError(f"{path}: the PLY header has no `format` line; export the file again")
    # An element without properties may declare any number of rows, and plyfile would iterate over them.
    return Header(form, tuple(element for element in elements if element.properties), tuple(comments), body)


def _with_property(element: Element, words: list[str]) -> Element:
    *kind, name = words
    types = kind[1:] if kind[0] == "list" and len(kind) == 3 else kind
    if unknown := [word for word in types if word not in TYPES]:
        raise _Fault(f"whose type {unknown[0]} PLY does not have")
    if not types or (len(types) > 1 and kind[0] != "list"):
        raise ValueError(name)
    if name in element.names:
        raise _Fault("the second property of this name")
    return replace(element, properties=(*element.properties, (name, " ".join(kind))))


def _sized(path: Path, header: Header, size: int) -> Header:
    """Compare the `size` bytes after the header with what it declares."""
    vertices = [element for element in header.elements if element.name == "vertex"]
    if not vertices and header.elements and header.elements[0].name == "vertex_0":
        by_degree = "has an element of splats for each SH degree (vertex_0, ...), as Reduced-3DGS writes them, which is not read here"
        raise CheckpointError(f"{path} {by_degree}; give the PLY of another training of 3DGS")
    if not vertices and (objects := [element.name for element in header.elements if "opacity" in element.names]):
        by_object = f"has an element of splats for each object ({', '.join(objects[:2])}, ...), as Street Gaussians writes them, which move"
        raise CheckpointError(f"{path} {by_object}; that is not read here; give the PLY of a training of 3DGS")
    if not vertices:
        raise CheckpointError(f"{path} has no vertex element, so it holds no splats; its elements are {[e.name for e in header.elements]}")
    vertex = vertices[0]
    if further := sum(element.count for element in vertices[1:]):
        lost = f"{path} has {len(vertices)} vertex elements, and {further:,} rows would be lost"
        raise CheckpointError(f"{lost}; export the file again with one element")
    if vertex.has_lists:
        raise CheckpointError(f"{path} has list properties in its vertex element, so it is a mesh or another format; give a trained model")
    available = size + (header.format == "ascii")  # the last value needs no blank behind it
    taken = sum(element.count * header.least_bytes(element) for element in header.before(header.vertex))
    held = max(0, available - taken) // header.least_bytes(vertex)
    if held < vertex.count:
        raise CheckpointError(
            f"{path} is truncated: its header declares {plural(vertex.count, 'splat')}, but at least {vertex.count - held:,} of them are missing;"
            " download or copy it again"
        )
    if header.format == "ascii" or any(element.has_lists for element in header.elements):
        return header
    surplus = size - sum(element.count * element.stride for element in header.elements)
    return _with_surplus(path, header, surplus) if surplus > 0 else header


def _without_prefix(header: Header) -> Header:
    """The header with the names that columns of splats had before CloudCompare put a prefix before them."""
    vertex = header.vertex
    prefix = next((each for each in PREFIXES if f"{each}f_dc_0" in vertex.names and "f_dc_0" not in vertex.names), None)
    if prefix is None:
        return header
    shorter = ((name.removeprefix(prefix), name, kind) for name, kind in vertex.properties)
    fixed = replace(vertex, properties=tuple((name if short in vertex.names else short, kind) for short, name, kind in shorter))
    note = f"its columns have names that CloudCompare gives them ({prefix}f_dc_0 and others); they are read as those of 3DGS"
    return replace(header, elements=tuple(fixed if element is vertex else element for element in header.elements), notes=(*header.notes, note))


def _with_surplus(path: Path, header: Header, surplus: int) -> Header:
    vertex = header.vertex
    if surplus == 2 * vertex.count and ("colors", "uchar") in vertex.properties:
        # nerfstudio 1.0.3 to 1.1.x declares one byte of `colors` and writes three (nerfstudio #3377).
        at = vertex.names.index("colors")
        rgb = tuple((name, "uchar") for name in ("red", "green", "blue"))
        fixed = replace(vertex, properties=vertex.properties[:at] + rgb + vertex.properties[at + 1 :])
        elements = tuple(fixed if element is vertex else element for element in header.elements)
        return replace(header, elements=elements, notes=(f"{path.name} declares one byte of `colors` but holds three; they are read as RGB",))
    return replace(header, notes=(f"{path.name} has {surplus:,} bytes more than its header declares; they are ignored",))


def _read_through_plyfile(path: Path, header: Header, wanted: Element) -> np.ndarray:
    """Rows of varying length, parsed by plyfile with a normalized header."""
    in_text = header.format == "ascii"
    declared = [f"ply\nformat {header.format} 1.0\n"]
    for element in header.elements:
        kinds = ((name, "double" if in_text and _is_integer(kind) else kind) for name, kind in element.properties)  # `_in_declared_types`
        declared += [f"element {element.name} {element.count}\n", *(f"property {kind} {name}\n" for name, kind in kinds)]
        if element is wanted:
            break
    with path.open("rb") as file:
        file.seek(header.body)
        content = "".join([*declared, "end_header\n"]).encode() + file.read()
    try:
        rows: np.ndarray = PlyData.read(io.BytesIO(content))[wanted.name].data
        return _in_declared_types(rows, wanted) if in_text else rows
    except (PlyParseError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{path} is damaged or truncated ({error}); download or export it again") from error


def _is_integer(kind: str) -> bool:
    """Whether a type is one of whole numbers, which doubles hold exactly; a list is none."""
    return TYPES.get(kind, "f")[0] in "iu"


def _in_declared_types(rows: np.ndarray, element: Element) -> np.ndarray:
    """Rows whose integers were parsed as doubles, in the types of the header. Raises ValueError for numbers that these do not hold.

    NumPy 1 would take such numbers, parsed as integers, modulo the size of the type, without a word.
    """
    with np.errstate(invalid="ignore"):
        typed = rows.astype(element.dtype("="))
    for name, kind in element.properties:
        if _is_integer(kind) and (wrong := typed[name] != rows[name]).any():
            raise ValueError(f"{rows[name][wrong][0]:.17g} is no {kind}, which {name} is declared to be")
    return typed
