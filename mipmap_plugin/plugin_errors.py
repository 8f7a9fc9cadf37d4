"""Errors of third-party code, in a sentence that names the plug-in. Errors of this package's own stay what they are: bugs, with a traceback."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from mipmap_plugin.errors import MipmapPluginError, PluginError, ShapeError, with_type
from mipmap_plugin.limits import is_out_of_memory

if TYPE_CHECKING:
    from torch import Tensor


def is_third_party(thing: Any) -> bool:
    """Whether an object's class, or a function, is not of this package."""
    return _module(thing).partition(".")[0] != __name__.partition(".")[0]


def _module(thing: Any) -> str:
    return str(getattr(thing, "__module__", None) or type(thing).__module__)


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Turn errors of the block, which runs third-party code only, and its attempts to exit into a PluginError. `what`: such as "backend 'mine'"."""
    try:
        yield
    except (Exception, SystemExit) as error:
        if isinstance(error, MipmapPluginError) or is_out_of_memory(error):
            raise
        raise PluginError(f"{what} failed: {with_type(error)}") from error


@contextmanager
def naming_any(plugins: Mapping[str, Any]) -> Iterator[None]:
    """Turn errors that pass through the code of a third-party plug-in into a PluginError. `plugins`: objects by what messages call them.

    Those of this package stay as they are, but for a ShapeError, which does not say whose tensors do not fit together.
    """
    try:
        yield
    except (Exception, SystemExit) as error:
        if (isinstance(error, MipmapPluginError) and not isinstance(error, ShapeError)) or is_out_of_memory(error):
            raise
        for what, thing in plugins.items():
            if is_third_party(thing) and any(_is_of(frame, thing) for frame, _ in traceback.walk_tb(error.__traceback__)):
                raise PluginError(f"{what} failed: {with_type(error)}") from error
        raise


def _is_of(frame: FrameType, thing: Any) -> bool:
    """Whether a frame runs a method of an object of the same type, or code of its module, unless that is a script, which may hold an observer too."""
    module = frame.f_globals.get("__name__")
    return type(frame.f_locals.get("self")) is type(thing) or (module == _module(thing) and module != "__main__")


@contextmanager
def unchanged(what: str, tensors: Mapping[str, Tensor]) -> Iterator[None]:
    """Raise PluginError if third-party code changes one of the tensors, by name, in place: they may be the base's own.

    Tensors that were made in torch's inference mode have no versions, and are not watched.
    """
    before = {name: tensor._version for name, tensor in tensors.items() if not tensor.is_inference()}
    yield
    if changed := [name for name in before if tensors[name]._version != before[name]]:
        raise PluginError(f"{what} changed its input in place ({', '.join(changed)}), which may be the base itself; let it work on a copy")
