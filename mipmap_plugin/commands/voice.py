"""What a command says: on the terminal unless it is to be quiet, and in a log with every detail."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, cast

from mipmap_plugin.commands.log import Log
from mipmap_plugin.errors import OutputError, SettingsError

# What a command is announced by that is to be run next; what stands for its spaces while lines are broken; the columns that a text needs at least.
NEXT, UNBROKEN, LEAST_WIDTH = "next: ", "\0", 20


@dataclass(frozen=True)
class Voice:
    """Where words go."""

    quiet: bool = False
    log: Log | None = None

    def write(self, text: str) -> None:
        """Write lines to the log; nothing without a log."""
        if self.log is not None:
            self.log.write(text)


VOICE: ContextVar[Voice] = ContextVar("VOICE", default=Voice())  # noqa: B039  a voice never changes


def say(text: str, hanging: int | None = None) -> None:
    """Print `text` unless the command is quiet; also write it to the log. `hanging`: in a terminal, wrap it and indent further lines so."""
    voice = VOICE.get()
    voice.write(text)
    if not voice.quiet:
        put(text if hanging is None or not sys.stdout.isatty() else wrapped(text, hanging, shutil.get_terminal_size().columns))


def wrapped(text: str, hanging: int, width: int) -> str:
    """A text in lines of `width` columns, of which all but the first are indented. What follows NEXT stays on one line, to be copied."""
    words, found, command = text.partition(NEXT)
    kept = words + found + command.replace(" ", UNBROKEN)
    lines = textwrap.wrap(
        kept, max(width, hanging + LEAST_WIDTH), subsequent_indent=" " * hanging, break_long_words=False, break_on_hyphens=False
    )  # fmt: skip
    return "\n".join(lines).replace(UNBROKEN, " ")


def put(text: str) -> None:
    """Print `text` at once, for whoever reads it from a pipe, as the address of a live view.

    Raises OutputError where it cannot be printed, and BrokenPipeError where nobody reads it any more; then what is printed later is lost.
    """
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains again at its end
        if isinstance(error, BrokenPipeError):
            raise
        raise OutputError(f"the standard output cannot be written ({error.strerror}); print to another place") from error


def detail(text: str) -> None:
    """Write what few people read to the log alone."""
    VOICE.get().write(text)


def complain(text: str) -> None:
    """Print what went wrong on standard error, quiet or not; also write it to the log."""
    VOICE.get().write(text.strip())
    with contextlib.suppress(OSError):  # the exit code says it too
        print(text, file=sys.stderr)


def take_any_text() -> None:
    """Print also what the terminal's encoding lacks, such as names of files that are no text; and nothing where a stream is closed."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8", errors="replace"))  # noqa: SIM115  for as long as the process lives
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def options(words: Sequence[str]) -> tuple[list[str], bool, Path | None]:
    """The words of a command without --quiet and --log FILE, which go with every command, and both. Raises SettingsError."""
    rest, quiet, log = list[str](), False, None
    remaining = iter(words)
    for word in remaining:
        if word == "--quiet":
            quiet = True
        elif word == "--log" or word.startswith("--log="):
            name = word.removeprefix("--log=") if "=" in word else next(remaining, "")
            if not name or name.startswith("--"):
                raise SettingsError("--log needs a file; give --log FILE")
            log = Path(name)
        else:
            rest.append(word)
    return rest, quiet, log


@contextlib.contextmanager
def speaking(quiet: bool, log: Path | None) -> Iterator[None]:
    """Speak like this inside the block. A log is appended to, line by line. Raises OutputError."""
    with contextlib.ExitStack() as stack:
        file = None if log is None else stack.enter_context(contextlib.closing(Log(log)))
        if quiet:
            stack.enter_context(contextlib.redirect_stderr(cast(TextIO, _NoTerminal(sys.stderr))))
        token = VOICE.set(Voice(quiet, file))
        try:
            yield
        finally:
            VOICE.reset(token)


class _NoTerminal:
    """A stream that is no terminal, so that no progress is shown on it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def isatty(self) -> bool:
        return False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
