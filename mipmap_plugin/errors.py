"""The exceptions. Every error that a user can cause is a `MipmapPluginError`, whose message says what is wrong, where, and what to do."""

import difflib
import errno
import os
import re
import sys
import traceback
import warnings
from collections.abc import Sequence

# The name of this package.
PACKAGE = __name__.partition(".")[0]

# Maximum characters of a message. A damaged file that it quotes may have megabytes in place of a name or a number.
MAX_LENGTH = 1500


# Verbs whose third person is not their plural with an s.
IRREGULAR = {"are": "is", "were": "was", "have": "has"}


def install(extra: str) -> str:
    """How to install an extra, in words for whoever has a clone of the repository and for whoever has none."""
    return f'run pip install ".[{extra}]" in a clone of the repository, or pip install "mipmap-plugin[{extra}]" elsewhere'


class MipmapPluginError(Exception):
    """Base of all errors that the command line prints in one sentence, with exit code 2. Long messages are cut in the middle."""

    def __str__(self) -> str:
        text = super().__str__()
        return text if len(text) <= MAX_LENGTH else f"{text[: 2 * MAX_LENGTH // 3]} ... {text[-MAX_LENGTH // 4 :]}"


class CheckpointError(MipmapPluginError, ValueError):
    """A checkpoint that cannot be read, or not in the requested way."""


class SceneError(MipmapPluginError, ValueError):
    """Cameras or images that cannot be read."""


class ShapeError(MipmapPluginError, ValueError):
    """Tensors whose shapes do not match."""


class SettingsError(MipmapPluginError, ValueError):
    """A request with invalid or conflicting settings."""


class BackendUnavailable(MipmapPluginError, ImportError):
    """No backend can serve a request; the message holds each backend's reasons."""


class PluginError(MipmapPluginError, ImportError):
    """A registered plug-in that cannot be imported or does not follow its contract."""


class OutputError(MipmapPluginError, OSError):
    """An output that cannot be written: a full disk, a missing permission."""


class OutputExists(MipmapPluginError, FileExistsError):
    """An output that exists already and must not be overwritten."""


class JobsFailed(MipmapPluginError):
    """Some of many jobs failed; the others are done."""


class MipmapPluginWarning(UserWarning):
    """All that this package warns of."""


def warn(text: str, category: type[Warning] = MipmapPluginWarning) -> None:
    """Warn at the line that called this package, however deep in it the reason was found."""
    frames = list(traceback.walk_stack(sys._getframe(1)))
    ours = [number for number, (frame, _) in enumerate(frames) if frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE]
    warnings.warn(text, category, stacklevel=max(ours, default=0) + 3)


def hide_others_warnings() -> None:
    """Inside `warnings.catch_warnings`, hide other libraries' warnings, which are meant for programmers; `python -W` still shows all."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("default", module=rf"{PACKAGE}(\.|$)")
        warnings.filterwarnings("default", category=MipmapPluginWarning)


# What the names of temporary folders begin with.
TEMPORARY = "mipmap-plugin-"

# What to do about an error of the system, by its number.
REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some, or choose another disk"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "choose a place that you may write to (--output)"),
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "let this process open more files (ulimit -n)",
}


def of_system(error: OSError) -> str:
    """What the system says of an error, and what to do about it."""
    close = "close it where it is open, or " if isinstance(error, PermissionError) and os.name == "nt" else ""
    return f"{error.strerror or error}; {close}{REMEDIES.get(error.errno or 0, 'choose another path')}"


def of_a_file(error: OSError) -> str:
    """An error of the system that nobody foresaw, in a sentence: which file, what, and what to do."""
    where = f"{error.filename}: " if error.filename else ""
    temporary = "; the variable TMPDIR names another place for temporary files" if is_temporary(error.filename) else ""
    return f"{where}{error.strerror or error}; check that path, who may read and write there, and that its disk is not full{temporary}"


def is_temporary(path: object) -> bool:
    """Whether a path leads into a temporary folder of this package, to whose name Python adds eight characters."""
    return re.search(rf"\b{TEMPORARY}[a-z0-9_]{{8}}\b", str(path)) is not None


def with_article(noun: str) -> str:
    """A noun behind its article: "an int", "a list"."""
    return f"{'an' if noun[:1].lower() in 'aeio' else 'a'} {noun}"


def plural(count: int, noun: str) -> str:
    """A number of things: "1 view", "1,200 views"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def some_of(count: int, total: int, noun: str, does: str = "") -> str:
    """Some of a number of things, and what they do, in words that agree: "2 of 300 splats have no size", "1 of 300 splats has no size"."""
    verb, _, rest = does.partition(" ")
    said = IRREGULAR.get(verb, f"{verb}s") if count < 2 and verb else verb
    return " ".join(filter(None, (f"{count:,} of" if count else "none of", plural(total, noun), said, rest)))


def type_of(value: object) -> str:
    """The type of what was given in place of something else, behind its article."""
    return with_article(type(value).__name__)


def unknown(kind: str, name: str, names: Sequence[str]) -> str:
    """That there is no such thing of a kind, which ones there are, and which was probably meant, in a sentence."""
    meant = difflib.get_close_matches(name.lower(), names, 1)
    guess = f"; did you mean {meant[0]}?" if meant else ""
    return f"there is no {kind} {name!r}; choose from {', '.join(names)}{guess}"


def brief(error: BaseException) -> str:
    """The first line of another library's error."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def with_type(error: BaseException) -> str:
    """Another library's error behind its type, in one line, as tables need it: "KeyError: 'level'"."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
