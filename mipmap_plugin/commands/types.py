"""The types of the command line's options, which of them may be given once only, and values that are none of theirs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from inspect import signature
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro

from mipmap_plugin.commands.common import starting
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.limits import MAX_SCALE, MIN_SCALE
from mipmap_plugin.screen_filters import TrainedName

# What a size may end with, in bytes.
UNITS = {"": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
SIZE = re.compile(r"([0-9.]+)\s*([a-z]*)", re.IGNORECASE)


def read_scale(text: str) -> float:
    """Parse a scale, such as 0.25, 1/4 or 4, or as pages and names of files write it, ×1/4 or x0.25. Raises ValueError."""
    try:
        scale = float(Fraction(re.sub(r"\s*/\s*", "/", text.strip(" x×X"))))
    except (ValueError, ZeroDivisionError, OverflowError):
        scale = 0.0
    if not MIN_SCALE <= scale <= MAX_SCALE:
        raise ValueError(f"scale must be a number or a fraction from {MIN_SCALE:g} to {MAX_SCALE:g}, such as 1/4, 0.25 or 4, got {text}")
    return scale


def read_size(text: str) -> int:
    """The bytes of a size such as 20MB, 1.5 GB or 4000000. Raises SettingsError."""
    found = SIZE.fullmatch(text.strip())
    try:
        size = int(float(found[1]) * UNITS[found[2].lower()]) if found else 0
    except (ValueError, KeyError, OverflowError):
        size = 0
    if size < 1:
        raise SettingsError(f"bytes: must be a size such as 20MB, got {text}")
    return size


def unique_scales(scales: Sequence[float]) -> list[float]:
    """The scales in their order, without repetitions. Raises SettingsError if there are none."""
    if not scales:
        raise SettingsError("--scale is required; give --scale 1/4 or --scale 4, for example, or --scale 1 for no zoom")
    return list(dict.fromkeys(scales))


def read_viewer(text: str) -> str:
    """The name of a viewer, which people write as its makers do, such as SuperSplat; a name that is not known is left as it is."""
    with starting():
        from mipmap_plugin.splatting.viewers import NO_RECORD, VIEWERS

    names = {*VIEWERS.names(), *NO_RECORD}
    return text if text in names or text.lower() not in names else text.lower()


# What options are read by, beside tyro's own rules.
RULES = tyro.constructors.ConstructorRegistry()


@RULES.primitive_rule
def _one_of(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """One of several names, or none: tyro tells those of a union in another order each time, and None, which nobody types, among them."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if not kinds or any(get_origin(kind) is not Literal for kind in kinds):
        return None
    names = tuple(name for kind in kinds for name in get_args(kind))
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: value is None or value in names,
        str_from_instance=lambda value: [str(value)],
        choices=names,
    )


_SCALE = tyro.constructors.PrimitiveConstructorSpec[Any](
    nargs=1,
    metavar="1/4|4",
    instance_from_str=lambda words: read_scale(words[0]),
    is_instance=lambda value: value is None or isinstance(value, float),
    str_from_instance=lambda value: [f"{value:g}" if value else "its own"],
)
_VIEWER = tyro.constructors.PrimitiveConstructorSpec[str](
    nargs=1,
    metavar="NAME",
    instance_from_str=lambda words: read_viewer(words[0]),
    is_instance=lambda value: isinstance(value, str),
    str_from_instance=lambda value: [value],
)
Viewer = Annotated[str, _VIEWER]
Scale = Annotated[float, _SCALE]
OwnScale = Annotated[float | None, _SCALE]  # None: that of the file
Scales = tyro.conf.UseAppendAction[list[Scale]]
Way = Literal["auto", "zoom", "distance"]  # of levels (`levels.request.WAYS`)
Checkpoint = tyro.conf.Positional[Path]
Checkpoints = tyro.conf.Positional[tuple[Path, ...]]

# Options that several commands have, with what their help says.
Cameras = Annotated[
    Path | None,
    tyro.conf.arg(help="A cameras.json, a transforms file or a COLMAP scene, in place of the checkpoint's own cameras; a lone file has none."),
]
Background = Annotated[Literal["white", "black"] | None, tyro.conf.arg(help="Of the scene; by default that of the checkpoint, or else black.")]
ScreenFilter = Annotated[
    TrainedName | None,
    tyro.conf.arg(
        help="The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example."
    ),
]
Up = Annotated[
    Literal["x", "y", "z", "-x", "-y", "-z"] | None,
    tyro.conf.arg(help="What is up, if the checkpoint has no cameras: views of it are then generated above the horizon, not from all around."),
]
BackendName = Annotated[str, tyro.conf.arg(help="Name of a backend; auto chooses the fastest one that can serve the request.")]
Threads = Annotated[
    int | None,
    tyro.conf.arg(
        help="Maximum number of processor threads; by default as many as torch finds. With the backend cpu the result does not depend on it."
    ),
]
Seed = Annotated[int, tyro.conf.arg(help="Seed of everything random.")]


def refuse_repeated(command: Callable[..., Any], words: Sequence[str]) -> None:
    """Raise SettingsError for an option of `command` that is given twice and may not be: the parser takes the last one and says nothing."""
    words = words[: words.index("--")] if "--" in words else words  # behind it are names of files
    options = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--") and word != "--help"]
    if len(set(options)) == len(options):
        return
    hints = get_type_hints(command, include_extras=True)
    for option in options:
        name = option.removeprefix("--").replace("-", "_")
        hint, is_switch = hints.get(name), bool in (hints.get(name), hints.get(name.removeprefix("no_")))
        if options.count(option) > 1 and not is_switch and not _is_appended(hint):
            how = ", with all its values behind it" if get_origin(hint) is tuple else ""
            raise SettingsError(f"{option} is given {options.count(option)} times, of which only the last would count; give it once{how}")


def refuse_stray_scales(command: Callable[..., Any], words: Sequence[str]) -> None:
    """Raise SettingsError for a scale that would be taken for a path, or for nothing: the second one behind --scale, or one without --scale."""
    option, values = "", 0
    for word in words[: words.index("--")] if "--" in words else words:
        if word.startswith("--"):
            option, equals, _ = word.partition("=")
            values = len(equals)
            continue
        values += 1
        stray = values > 1 if option == "--scale" else "/" in word and (values > 1 or not option)
        if stray and _is_scale(word) and not Path(word).exists() and "scale" in signature(command).parameters:
            several = _is_appended(get_type_hints(command, include_extras=True)["scale"])
            how = "each scale is given by an option of its own, as in --scale 1/2 --scale 1/4" if several else "give one scale, as in --scale 1/4"
            raise SettingsError(f"{word}: {how}")


def _is_appended(hint: Any) -> bool:
    """Whether an option with this type may be given several times."""
    return tyro.conf.UseAppendAction in getattr(hint, "__metadata__", ())


def _is_scale(word: str) -> bool:
    """Whether a word is a scale."""
    try:
        return read_scale(word) > 0
    except ValueError:
        return False
