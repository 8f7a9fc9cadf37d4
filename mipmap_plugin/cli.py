"""The command line: thin commands over the library. Exit codes: 0 success, 2 an error, printed in one sentence, 130 interrupted, 143 or 129
told to end (SIGTERM, SIGHUP), 141 where whoever read what is printed has stopped."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from importlib.metadata import version
from inspect import getdoc
from typing import Any

import tyro

from mipmap_plugin.commands import common, voice
from mipmap_plugin.commands.adapt import adapt
from mipmap_plugin.commands.backends import backends
from mipmap_plugin.commands.demo import demo
from mipmap_plugin.commands.evaluate import evaluate
from mipmap_plugin.commands.inspect import inspect
from mipmap_plugin.commands.levels import levels
from mipmap_plugin.commands.list import list_
from mipmap_plugin.commands.render import render
from mipmap_plugin.commands.tradeoff import tradeoff
from mipmap_plugin.commands.types import RULES, refuse_repeated, refuse_stray_scales
from mipmap_plugin.commands.view import view
from mipmap_plugin.errors import MipmapPluginError, SettingsError, hide_others_warnings, of_a_file, unknown
from mipmap_plugin.formats.here import told_from_here
from mipmap_plugin.limits import is_out_of_memory
from mipmap_plugin.process.freed_memory import keep_freed_memory
from mipmap_plugin.process.garbage import leave_at_exit
from mipmap_plugin.process.signals import ends_as_by_ctrl_c

DESCRIPTION = (
    "Make a Gaussian-splatting checkpoint look right at another zoom. mipmap-plugin COMMAND --help lists a command's options and shows an example. "
    "With every command go --quiet, to print errors, warnings and JSON only, "
    "and --log FILE, to append all that is said, with further details, to a file. mipmap-plugin --version tells the version."
)

# An option that is not given is None; nobody types that, and help does not offer it.
OPTIONS = (tyro.conf.DisallowNone,)

COMMANDS = {command.__name__.rstrip("_"): command for command in (inspect, adapt, levels, render, view, evaluate, tradeoff, backends, list_, demo)}

# What the help of each command shows, behind its name.
EXAMPLES = {
    "inspect": "output/bicycle",
    "adapt": "output/bicycle --scale 1/4 --viewer supersplat",
    "levels": "output/bicycle --viewer supersplat --output output/bicycle_levels",
    "render": "output/bicycle --scale 1/4 --output pictures",
    "view": "output/bicycle output/bicycle_x0.25_supersplat",
    "evaluate": "output/bicycle --images data/bicycle --scale 1/4 --recipe default",
    "tradeoff": "output/bicycle --images data/bicycle --scale 1/8 --output tradeoff",
    "backends": "--check cpu",
    "list": "viewers",
    "demo": "--viewer spark",
}


# A word with one dash that is neither -h, a number, nor a direction of --up.
DASHED = re.compile(r"-(?!h$|[xyz]$|inf|nan)[^-\d.]")


def _alone(command: Callable[..., None]) -> Callable[..., None]:
    """The command, while which nothing else prints to standard output (`voice.alone`); its help, which tyro prints, comes before."""

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            os.getcwd()
        except FileNotFoundError:
            raise SettingsError("the folder that this command was started in is gone; change to another, or to a new one of that name") from None
        with voice.alone(json=kwargs.get("json", False)):
            command(*args, **kwargs)

    return run


app = tyro.extras.SubcommandApp()
for name, command in COMMANDS.items():
    app.command(name=name)(_alone(command))


def _parse(words: Sequence[str]) -> None:
    """Run the command that the words name, or print help. Each command has a parser of its own, so that what is said of a mistake points to the
    command's own help, and suggests no option of another command."""
    if any(not word or re.fullmatch("--[^=]+=", word) for word in words):  # "" would be a path, to this folder
        raise SettingsError("a word of this command is empty, as where a variable of the shell is not set; fill it in, or leave it out")
    options = words[: words.index("--")] if "--" in words else words  # behind it are names of files
    if dashed := next((word for word in options if DASHED.match(word)), None):
        raise SettingsError(f"{dashed}: options begin with two dashes (but for -h); a path that begins with a dash is given as ./{dashed}")
    if words and (command := COMMANDS.get(words[0])):
        refuse_repeated(command, words)
        refuse_stray_scales(command, words[1:])
        prog, summary = f"mipmap-plugin {words[0]}", (getdoc(command) or "").partition("\n\nArgs:")[0]
        described = f"{summary}\n\nExample: {prog} {EXAMPLES[words[0]]}"
        tyro.cli(_alone(command), prog=prog, description=described, args=words[1:], config=OPTIONS, registry=RULES)
    elif words and not words[0].startswith("-"):
        raise SettingsError(unknown("command", words[0], [*COMMANDS]))
    else:
        app.cli(prog="mipmap-plugin", description=DESCRIPTION, args=words, config=OPTIONS, registry=RULES)


def _at_home(word: str) -> str:
    """Replace "~" at the beginning of a word, or of an option's value. Shells do not after "=" and within quotes, and that of Windows never does.

    Raises SettingsError for a word with a zero byte, which no shell passes on, but `main` may be called with.
    """
    if "\0" in word:
        raise SettingsError(f"{word!r} holds a zero byte, which no path and no option does; leave it out")
    option, equals, value = word.rpartition("=") if word.startswith("--") else ("", "", word)
    return option + equals + os.path.expanduser(value)


def main(arguments: Sequence[str] | None = None) -> int:
    """The entry point; returns the exit code."""
    given = [*(sys.argv[1:] if arguments is None else arguments)]
    voice.take_any_text()
    voice.take_any_width()
    if given == ["--version"]:
        print(f"mipmap-plugin {version('mipmap-plugin')}")
        return 0
    keep_freed_memory()
    leave_at_exit()
    try:
        words, quiet, log = voice.options([_at_home(word) for word in given])
        common.WORDS.set(tuple(words))
        with voice.speaking(quiet, log):
            voice.detail(common.this_command())
            return _run(words)
    except MipmapPluginError as error:  # of these two options, or of a word that can be none
        voice.complain(f"mipmap-plugin: {error}")
        return 2


def _run(words: Sequence[str]) -> int:
    """Run a command; return the exit code."""
    with ends_as_by_ctrl_c() as ending:
        try:
            with _our_warnings_only():
                _parse(words)
        except KeyboardInterrupt as interrupt:
            voice.complain(f"\nmipmap-plugin: {str(interrupt) or 'interrupted'}")
            return ending.code
        except BrokenPipeError:  # by `| head`, for example, which has read enough
            return 141
        except MipmapPluginError as error:
            voice.complain(f"mipmap-plugin: {_told(error)}")
            return 2
        except OSError as error:
            voice.complain(f"mipmap-plugin: {_told(of_a_file(error))}")
            return 2
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            voice.complain("mipmap-plugin: out of memory; use a smaller scale, fewer views or smaller cameras")
            return 2
    return 0


@contextlib.contextmanager
def _our_warnings_only() -> Iterator[None]:
    """Show this package's warnings in a line each, and hide those of others."""
    with warnings.catch_warnings():
        hide_others_warnings()
        said: set[str] = set()
        warnings.showwarning = lambda message, *_: _show(str(message), said)
        yield


def _show(text: str, said: set[str]) -> None:
    """Show a warning without its place in the source, and once: all levels of a ladder, and all scales of a checkpoint, warn of the same."""
    if text not in said:
        said.add(text)
        voice.note(f"mipmap-plugin: {_told(text)}", urgent=True)


def _told(words: object) -> str:
    """A message with paths from the current folder, and archives in place of the temporary folders they were unpacked to, which are gone by then."""
    from mipmap_plugin.models.zipped_folder import with_archives_named

    return told_from_here(with_archives_named(words))
