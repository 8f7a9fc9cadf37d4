"""Plug-ins by name, imported at first use: built-in ones, and third-party ones through `add` or an entry point."""

from __future__ import annotations

import importlib
import operator
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, distributions, entry_points
from typing import Any

from mipmap_plugin.errors import PluginError, SettingsError, brief, unknown, with_type


class Registry:
    """Objects by name, imported only when they are used.

    A target is `"package.module:Name"` or the object itself. Names of the entry-point group are included; a name
    registered here takes precedence over an installed one, so that no package can shadow a built-in.
    """

    def __init__(self, group: str, builtins: Mapping[str, Any]) -> None:
        self.group = group
        self._targets: dict[str, Any] = dict(builtins)
        self.seal()

    def seal(self) -> None:
        """Count what is registered so far as built in."""
        self._built_in = dict(self._targets)

    def add(self, name: str, target: Any, *, replace: bool = False) -> None:
        """Register `target` under `name`. Raises SettingsError if another target has the name already, or it is no name."""
        if not isinstance(name, str) or not name or not name.isprintable() or name != name.strip():
            raise SettingsError(f"{self.group}: a name is a text of a line, got {name!r}")
        if not replace and self._targets.get(name, target) is not target and self._targets[name] != target:
            raise SettingsError(f"{self.group}: the name {name!r} is taken; pass replace=True to override it")
        self._targets[name] = target

    def names(self) -> list[str]:
        """All known names, registered and installed, sorted."""
        return sorted({*self._targets, *self._installed()})

    def get(self, name: str) -> Any:
        """Return the object of that name. Raises SettingsError for an unknown name, PluginError for a broken target."""
        kinds = self.group.rpartition(".")[2]
        kind = kinds.removesuffix("s")
        if not isinstance(name, str):  # most often the plug-in itself
            own = f"register your own first, by register_{kind}(name, ...)"
            raise SettingsError(f"{kinds} are given by their names, got {type(name).__name__}; {own}")
        if name not in self._targets and name not in self._installed():
            raise SettingsError(unknown(kind, name, self.names()))
        target = self._targets[name] if name in self._targets else self._installed()[name]
        return load_target(name, target) if isinstance(target, str) else target

    def packages(self) -> dict[str, list[str]]:
        """What installed packages have under each name, such as "package.module:Name of my-package 1.0"; the first of each is used."""
        found: dict[str, list[str]] = {}
        for point in entry_points(group=self.group):
            found.setdefault(point.name, []).append(f"{point.value} of {_told(point.dist)}" if point.dist else point.value)
        return {name: list(dict.fromkeys(places)) for name, places in found.items()}

    def is_taken(self, name: str) -> bool:
        """Whether a name is registered here, so that what an installed package has under the same name is not used."""
        return name in self._targets

    def is_only_here(self, name: Any) -> bool:
        """Whether what has this name was registered in this process, so that no other knows it."""
        return name in self._targets and self._targets[name] != self._built_in.get(name) and name not in self._installed()

    def _installed(self) -> Mapping[str, str]:
        return _points(entry_points, self.group, tuple((folder, _modified(folder)) for folder in sys.path))


def unreadable_package() -> str:
    """Which installed package has entry points that cannot be read, in a sentence; "" if none: pydantic then fails as it is imported."""
    for package in distributions():
        try:
            package.entry_points  # noqa: B018
        except Exception as error:
            return f"the entry points of the installed package {_told(package)} cannot be read ({brief(error)}); install it anew, or remove it"
    return ""


def _told(package: Distribution) -> str:
    """The name and the version of an installed package; of one without METADATA, as a broken installation leaves, its folder."""
    with suppress(FileNotFoundError):  # which importlib_metadata raises in place of the metadata, where it is imported
        if package.metadata:
            return f"{package.metadata['Name']} {package.version}"
    return str(getattr(package, "_path", package.locate_file("")))


@lru_cache(maxsize=64)
def _points(find: Callable[..., Iterable[EntryPoint]], group: str, _folders: tuple[tuple[str, float], ...]) -> Mapping[str, str]:
    """The targets of an entry-point group by name. Of several with one name the first on the path counts, as for modules.

    Cached, because `find` reads a file of every installed package, and a command asks some twenty times. `_folders`: those of the path, and when each
    was modified, which an installation changes.
    """
    return {point.name: point.value for point in reversed(list(find(group=group)))}


def _modified(folder: str) -> float:
    """When something was last added to or removed from a folder, in seconds; 0 for a folder that does not exist."""
    try:
        return os.stat(folder or os.curdir).st_mtime
    except OSError:
        return 0.0


def _imported(module: str) -> Any:
    """The module. One of another package leaves torch as it was, even if it sets it up for itself; torch is imported for that."""
    if module.partition(".")[0] == __name__.partition(".")[0]:
        return importlib.import_module(module)
    from mipmap_plugin.process.torch_modes import settings_kept

    with settings_kept():
        return importlib.import_module(module)


def load_target(name: str, target: str) -> Any:
    """Import `"package.module:Name"`; as in entry points, a name may have dots, and extras in brackets, which do not count. Raises PluginError."""
    module, colon, attribute = target.partition("[")[0].rstrip().partition(":")
    if not colon:
        raise PluginError(f"{name!r} ({target}) cannot be loaded; a target is written package.module:Name")
    try:
        return operator.attrgetter(attribute)(_imported(module))
    except (Exception, SystemExit) as error:  # a third-party module may fail in any way; one broken plug-in must not break the others
        raise PluginError(f"{name!r} ({target}) cannot be loaded: {with_type(error)}") from error
