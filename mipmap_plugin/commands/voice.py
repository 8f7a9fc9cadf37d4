"""What a command says: on the terminal unless it is to be quiet, and in a log with every detail."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO, cast

from mipmap_plugin import progress
from mipmap_plugin.commands.log import Log
from mipmap_plugin.errors import OutputError, SettingsError

# The word before a command that the user may run next, and what stands for the command's spaces while the lines around it are wrapped.
NEXT, UNBROKEN = "next: ", "\0"

# What a terminal carries out instead of showing it, but for tabs and line breaks. Names in a file, of columns or views, may hold it, and are told.
CONTROL = re.compile(r"[\0-\x08\x0b-\x1f\x7f-\x9f]")

# The fewest columns that are left for a text after its indentation.
LEAST_WIDTH = 20

# The fewest columns of help. On fewer tyro gives each word a line, and below eight it never ends, and takes all memory.
LEAST_COLUMNS = 40


@dataclass(frozen=True)
class Voice:
    """Where words go."""

    quiet: bool = False
    log: Log | None = None
    stdout: TextIO | None = None  # None: the standard output

    @property
    def out(self) -> TextIO:
        """The stream to print to."""
        return self.stdout or sys.stdout

    def write(self, text: str) -> None:
        """Write lines to the log; nothing without a log."""
        if self.log is not None:
            self.log.write(text)


VOICE: ContextVar[Voice] = ContextVar("VOICE", default=Voice())  # noqa: B039  a voice never changes


def say(text: str, hanging: int | None = None) -> None:
    """Print `text` unless the command is quiet; also write it to the log. `hanging`: on a terminal, wrap it, with further lines indented so far."""
    voice, text = VOICE.get(), harmless(text)
    voice.write(text)
    if not voice.quiet:
        put(text if hanging is None or not voice.out.isatty() else wrapped(text, hanging, shutil.get_terminal_size().columns))


def harmless(text: str) -> str:
    """The text with what a terminal would carry out as Python writes it, such as \\x1b."""
    return CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


def wrapped(text: str, hanging: int, width: int) -> str:
    """Wrap a text to `width` columns, all lines but the first indented by `hanging`. What follows NEXT stays on one line, to be copied."""
    words, found, command = text.partition(NEXT)
    kept = words + found + command.replace(" ", UNBROKEN)
    at_most = max(width, hanging + LEAST_WIDTH)
    lines = textwrap.wrap(kept, at_most, subsequent_indent=" " * hanging, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace(UNBROKEN, " ")


def put(text: str) -> None:
    """Print `text` without buffering, so that a program that reads it through a pipe gets it at once.

    Raises OutputError if it cannot be printed, and BrokenPipeError if nobody reads it any more. After either, everything printed later is discarded.
    """
    out = VOICE.get().out
    try:
        print(text, file=out, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())  # otherwise Python reports the error again when it exits
        if isinstance(error, BrokenPipeError) or error.errno == errno.EINVAL:  # as Windows says it
            raise BrokenPipeError from error
        raise OutputError(f"the standard output cannot be written ({error.strerror}); print to another place") from error


def detail(text: str) -> None:
    """Write what few people need to the log only."""
    VOICE.get().write(harmless(text))


def note(text: str, *, urgent: bool = False) -> None:
    """Print a line about work that goes on to standard error, above its bars, unless the command is quiet and it is not `urgent`; also write it to
    the log."""
    text = harmless(text)
    VOICE.get().write(text)
    if urgent or not VOICE.get().quiet:
        with contextlib.suppress(OSError):  # who reads it may have gone
            progress.note(text)


def complain(text: str) -> None:
    """Print why a command ends on standard error, quiet or not; also write it to the log."""
    text = harmless(text)
    VOICE.get().write(text.strip())
    with contextlib.suppress(OSError):  # the exit code says it too
        print(text, file=sys.stderr)


def take_any_text() -> None:
    """Let any text be printed: characters that the terminal's encoding lacks are escaped, and what is printed to a closed stream is discarded."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8", errors="replace"))  # noqa: SIM115  for as long as the process lives
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def take_any_width() -> None:
    """Let help be shown on a terminal of any width, or what COLUMNS says of it: one of fewer than `LEAST_COLUMNS` wraps the lines itself."""
    if shutil.get_terminal_size().columns < LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)


def options(words: Sequence[str]) -> tuple[list[str], bool, Path | None]:
    """Take --quiet and --log FILE out of a command's words: the other words, whether to be quiet, and the file. Raises SettingsError."""
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
    """Inside the block, be `quiet` or not, and append everything that is said to the file `log`. Raises OutputError."""
    with contextlib.ExitStack() as stack:
        file = None if log is None else stack.enter_context(contextlib.closing(Log(log)))
        if quiet:
            stack.enter_context(contextlib.redirect_stderr(cast(TextIO, _NoTerminal(sys.stderr))))
        token = VOICE.set(Voice(quiet, file))
        try:
            yield
        finally:
            VOICE.reset(token)


@contextlib.contextmanager
def alone(*, json: bool = False) -> Iterator[None]:
    """Inside the block only `put` prints to standard output: what plug-ins and libraries print goes to standard error. `json`: also what they
    print past Python, as processes do that they start."""
    voice = VOICE.get()
    with _on_its_own_descriptor(voice.out) if json else contextlib.nullcontext(voice.out) as out:
        token = VOICE.set(replace(voice, stdout=out))
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield
        finally:
            VOICE.reset(token)


@contextlib.contextmanager
def _on_its_own_descriptor(stream: TextIO) -> Iterator[TextIO]:
    """A stream that prints where `stream` does, whose descriptor leads to standard error inside the block."""
    try:
        number, other = stream.fileno(), sys.stderr.fileno()
    except (OSError, ValueError):  # no file, as where a test reads it
        yield stream
        return
    stream.flush()
    with os.fdopen(os.dup(number), "w", encoding=stream.encoding, errors=stream.errors) as own:
        os.dup2(other, number)
        try:
            yield own
        finally:
            os.dup2(own.fileno(), number)


class _NoTerminal:
    """A stream that is no terminal, so that no progress is shown on it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def isatty(self) -> bool:
        return False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
