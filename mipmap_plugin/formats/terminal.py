"""Pictures in a terminal: Kitty's graphics protocol and DEC's sixels, and which of them a terminal has.

Sources: "Terminal graphics protocol" of kitty; "VT330/VT340 Programmer Reference Manual", chapter 14 (sixels) and 4 (device attributes).
"""

from __future__ import annotations

import base64
import contextlib
import os
import re
import select
import time
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from torch import Tensor

from mipmap_plugin.formats.images import paletted, png

Protocol = Literal["kitty", "sixel"]

# Bytes of a chunk at most.
CHUNK = 4096

# Terminals with Kitty's protocol, by what they set: variable -> values, of which one is enough; no values: any.
KITTY: dict[str, tuple[str, ...]] = {
    "KITTY_WINDOW_ID": (), "TERM": ("xterm-kitty", "xterm-ghostty"), "TERM_PROGRAM": ("ghostty", "WezTerm"), "KONSOLE_VERSION": ()
}  # fmt: skip

# Programs between us and the terminal that do not hand it on, though they inherit what the terminal set.
BETWEEN = ("TMUX", "STY")

# The question which features a terminal has, and the answer, in which the number 4 stands for sixels.
QUESTION, ANSWER = b"\x1b[c", re.compile(rb"\x1b\[\?([\d;]*)c")

# Seconds to wait for it. Every terminal answers at once; over a slow line no picture is shown.
PATIENCE_S = 0.5


def protocol_by_name(environment: Mapping[str, str]) -> Protocol | None:
    """What a terminal has by what it says of itself in the environment."""
    if any(environment.get(name) for name in BETWEEN):
        return None
    named = any(name in environment and (not values or environment[name] in values) for name, values in KITTY.items())
    return "kitty" if named else None


def has_sixels(terminal: int) -> bool:
    """Ask the terminal behind a file descriptor whether it has sixels; False where nobody answers, or another program is in the foreground."""
    try:
        import termios
        import tty
    except ImportError:  # Windows
        return False
    try:
        if os.tcgetpgrp(terminal) != os.getpgrp():
            return False
        before = termios.tcgetattr(terminal)
    except (OSError, termios.error):
        return False
    try:
        tty.setcbreak(terminal, termios.TCSANOW)  # the answer is neither shown nor waits for the Enter key
        os.write(terminal, QUESTION)
        found = ANSWER.search(_answer(terminal))
    finally:
        termios.tcsetattr(terminal, termios.TCSANOW, before)
    return found is not None and b"4" in found[1].split(b";")[1:]


def _answer(terminal: int) -> bytes:
    """What a terminal answers within `PATIENCE_S`."""
    end, answer = time.monotonic() + PATIENCE_S, b""
    while not ANSWER.search(answer) and select.select([terminal], [], [], max(0.0, end - time.monotonic()))[0]:
        with contextlib.suppress(BlockingIOError):
            answer += os.read(terminal, 256)
    return answer


def encoded(image: Tensor, protocol: Protocol) -> str:
    """What to write to a terminal so that it shows an image [H, W, 3] at the cursor."""
    return _kitty(image) if protocol == "kitty" else _sixel(image)


def _kitty(image: Tensor) -> str:
    """A PNG (f=100) that is transmitted and displayed (a=T) without an answer (q=2), in chunks, of which all but the last have m=1."""
    text = base64.b64encode(png(image)).decode("ascii")
    chunks = [text[start : start + CHUNK] for start in range(0, len(text), CHUNK)]
    last = len(chunks) - 1
    return "".join(f"\x1b_G{'' if number else 'a=T,f=100,q=2,'}m={int(number < last)};{chunk}\x1b\\" for number, chunk in enumerate(chunks))


def _sixel(image: Tensor) -> str:
    """The palette in hundredths, then bands of six rows, each color of a band over the others."""
    indices, palette = paletted(image)
    height, width = indices.shape
    colors = "".join(f"#{number};2;" + ";".join(str(round(100 * part / 255)) for part in color) for number, color in enumerate(palette))
    bands = "-".join("$".join(_rows(indices[top : top + 6])) for top in range(0, height, 6))
    return f'\x1bP0;1q"1;1;{width};{height}{colors}{bands}\x1b\\'


def _rows(band: np.ndarray) -> Iterator[str]:
    """A band [up to 6, W] of color numbers as sixels: for each color one character per column, whose bits are the rows of that color."""
    bits = 1 << np.arange(len(band))[:, None]
    for color in np.unique(band):
        columns = ((band == color) * bits).sum(axis=0) + 63
        yield f"#{color}" + re.sub(r"(.)\1{3,}", lambda run: f"!{len(run[0])}{run[1]}", "".join(map(chr, columns)))
