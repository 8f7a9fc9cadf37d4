"""Damage to files, all from a seed: to bytes, to text, and to the objects that JSON and torch files hold."""

import json
import pickle
import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

# What stands where another number or word should be. Counts that no memory holds, ends of every range, other types, deep nesting.
TOKENS = [
    *("0", "-1", "1", "255", "1e999", "-1e999", "1e-320", "nan", "1000000000000", "-2147483648", "18446744073709551616", "9" * 400, "9" * 5000),
    *("true", "null", "''", '""', "[]", "{}", "None", "()", "x", "é", "\x00", "\x1b[2J", "../../..", "/dev/zero", "a" * 5000),
    *("list", "list uchar int", "element vertex 1000000000000", "element x 1000000000000", "property float x", "end_header", "binary_big_endian"),
    *("ascii", "(" * 2000, "[" * 20000, "-" * 3000 + "1", "a" + " " * 60000 + "b", "__import__('os')"),
]

PLAIN = (None, True, 0, -1, 10**30, 1e308, float("nan"), float("inf"), "", "x", "../x", "a" * 5000, [], {}, [[1, 2], 3])
SHAPES = ((), (0,), (1,), (3, 0), (5, 3), (2, 3, 4), (1, 1, 1, 1))
DTYPES = (torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.bool, torch.complex64)
LITERALS = ("0", "-1", "1", "True", "None", "''", "[1]", "{}", "1e999", "-1e999", "1e-300", "1e30", "9" * 400, f"'images_{'9' * 4999}'", "'x'")

VALUES: list[Callable[[], Any]] = [
    *(lambda value=value: value for value in PLAIN),
    lambda: {"x": {"y": [1]}},
    lambda: nested(50_000),
]

TENSORS: list[Callable[[], Any]] = [
    *(lambda shape=shape: torch.ones(shape) for shape in SHAPES),
    *(lambda dtype=dtype: torch.ones(5, 3, dtype=dtype) for dtype in DTYPES),
    *(lambda value=value: torch.full((5, 3), value) for value in (float("nan"), float("inf"), 1e38, -1e38)),
    lambda: torch.ones(1).expand(10**12),
    lambda: torch.ones(1, 1).expand(10**9, 3),
    lambda: torch.ones(5, 3, device="meta"),
    lambda: torch.eye(3).to_sparse(),
    lambda: torch.eye(3).to_sparse_csr(),
    lambda: torch.quantize_per_tensor(torch.ones(5, 3), 0.1, 0, torch.quint8),
]


class Bomb:
    """Pickled, it is a program that makes a file when it is loaded."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.canary,)


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def of_bytes(content: bytes, rng: random.Random) -> bytes:
    """Truncated, flipped, overwritten, cut out, repeated or padded."""
    if not content:
        return rng.randbytes(20)
    start, length = rng.randrange(len(content)), rng.choice([1, 2, 4, 8, 64, 4096])
    head = rng.randrange(min(len(content), 2000))  # where headers are, and small numbers matter most
    here = rng.choice([start, head])
    kind = rng.randrange(7)
    if kind == 0:
        return content[:here]
    if kind == 1:
        flipped = bytearray(content)
        for _ in range(rng.choice([1, 1, 4, 64])):
            at = rng.choice([rng.randrange(len(content)), rng.randrange(min(len(content), 2000))])
            flipped[at] ^= 1 << rng.randrange(8)
        return bytes(flipped)
    if kind == 2:
        filler = rng.choice([b"\x00", b"\xff", b"\x7f", b"\x80", rng.randbytes(1)])
        return content[:here] + filler * length + content[here + length :]
    if kind == 3:
        return content[:here] + content[here + length :]
    if kind == 4:
        return content[:here] + content[here : here + length] * rng.choice([2, 3]) + content[here:]
    if kind == 5:
        return content[:here] + rng.randbytes(length) + content[here:]
    return content + rng.randbytes(length)


def of_text(content: bytes, rng: random.Random) -> bytes:
    """Numbers and words exchanged for others, lines dropped, doubled or moved. Of a PLY only the header counts as text."""
    end = content.find(b"end_header")
    text, rest = (content[: end + 11], content[end + 11 :]) if end >= 0 else (content, b"")
    if rng.random() < 0.6:
        places = list(re.finditer(rb"[\w.+-]+", text)) or [re.match(b"", text)]
        place = rng.choice(places)
        return text[: place.start()] + rng.choice(TOKENS).encode() + text[place.end() :] + rest
    lines = text.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        lines.pop(at)
    elif kind == 1:
        lines.insert(other, lines[at])
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines) + rest


def of_options(content: bytes, rng: random.Random) -> bytes:
    """One option of a cfg_args, or one line of a YAML file, has another value, which is well-formed."""
    places = list(re.finditer(rb"(?m)(?<==)[^,)]+|(?<=: )[^\n{]+", content))
    place = rng.choice(places)
    return content[: place.start()] + rng.choice(LITERALS).encode() + content[place.end() :]


def of_json(content: bytes, rng: random.Random) -> bytes:
    value = exchanged(json.loads(content), rng, VALUES)
    try:
        return json.dumps(value).encode()
    except RecursionError:
        return b"[" * 50_000


def of_png(content: bytes, rng: random.Random) -> bytes:
    """A part of a chunk is changed, and its sum made right again, so that what reads the chunk sees it."""
    chunks, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    which = rng.randrange(len(chunks))
    name, part = chunks[which]
    if name == b"IHDR" and rng.random() < 0.6:
        width, height = (rng.choice([0, 1, 16, 9000, 2**31 - 1, 2**32 - 1]) for _ in range(2))
        chunks[which] = name, struct.pack(">II", width, height) + part[8:]
    elif rng.random() < 0.3:
        chunks.insert(which, chunks[rng.randrange(len(chunks))])
    else:
        chunks[which] = name, of_bytes(part, rng)
    parts = (struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part)) for name, part in chunks)
    return content[:8] + b"".join(parts)


def of_torch(path: Path, rng: random.Random, canary: Path) -> None:
    """A part of a torch file's content is exchanged for a value, a tensor, or a program. Now and then the file is of the older format."""
    content = torch.load(path, weights_only=False)  # what the tests themselves wrote
    hostile = [lambda: Bomb(canary)]
    content = exchanged(content, rng, [*VALUES[:-1], *TENSORS, *hostile * 3])
    if rng.random() < 0.05:
        path.write_bytes(pickle.dumps(Bomb(canary)))
        return
    torch.save(content, path, _use_new_zipfile_serialization=rng.random() < 0.8)


def exchanged(value: Any, rng: random.Random, choices: list[Callable[[], Any]]) -> Any:
    """`value` with one part, at any depth, exchanged, dropped or added."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        kind, key = rng.random(), rng.choice(list(value))
        if kind < 0.1:
            return {name: each for name, each in value.items() if name != key}
        if kind < 0.2:
            return {**value, rng.choice([0, None, "x", "shN"]): rng.choice(choices)()}
        return {**value, key: exchanged(value[key], rng, choices)}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = rng.randrange(len(value))
        return [*value[:at], exchanged(value[at], rng, choices), *value[at + 1 :]]
    return rng.choice(choices)()
