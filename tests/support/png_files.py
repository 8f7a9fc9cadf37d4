"""PNGs written by hand, so that the reader's library does not test itself, and of sizes that no library writes."""

import struct
import zlib
from pathlib import Path

# (bits of a channel, color type, bytes of a pixel)
GRAY_16, RGB, RGBA = (16, 0, 2), (8, 2, 3), (8, 6, 4)


def write_png(path: Path, size: tuple[int, int], kind: tuple[int, int, int], pixels: bytes) -> Path:
    """`size`: width and height, px; `pixels`: row by row, numbers of 16 bits with the higher byte first."""
    width, height = size
    bits, color, stride = kind[0], kind[1], width * kind[2]
    rows = b"".join(b"\0" + pixels[row * stride : (row + 1) * stride] for row in range(height))
    head = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    parts = {b"IHDR": head, b"IDAT": zlib.compress(rows, 1), b"IEND": b""}
    chunks = (struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part)) for name, part in parts.items())
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path
