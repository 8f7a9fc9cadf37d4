"""Libraries that import torchvision and hardly use it, loaded where torchvision is absent or broken.

The torchvision of another index than torch's imports only to "operator torchvision::nms does not exist", which is what pip brings
beside a processor build of torch. spandrel and lpips name torchvision at their top, for face restoration, inpainting and the
definitions of two backbones.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

# Whatever libraries import by name: each part of torchvision that spandrel and lpips ask for.
PARTS = ("torchvision", "torchvision.models", "torchvision.transforms", "torchvision.transforms.functional")


@contextlib.contextmanager
def torchvision_optional(models: dict[str, Callable[..., Any]] | None = None) -> Iterator[None]:
    """Inside, torchvision can be imported: itself where it works, else empty modules, which are gone again afterwards.

    `models`: what stands in for functions of `torchvision.models`; any other name raises ImportError when it is called.
    """
    if _works():
        yield
        return
    modules = {name: _Empty(name) for name in PARTS}
    for name in PARTS[1:]:
        parent, _, child = name.rpartition(".")
        setattr(modules[parent], child, modules[name])
    vars(modules["torchvision.models"]).update(models or {})
    sys.modules.update(modules)
    try:
        yield
    finally:
        _forget()


def _works() -> bool:
    try:
        importlib.import_module("torchvision")
    except Exception:  # absent, or broken in whichever way two builds that do not belong together break
        _forget()
        return False
    return True


def _forget() -> None:
    """Remove torchvision from the imported modules: a half-imported one, or the stand-in, would mislead later imports."""
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        del sys.modules[name]


class _Empty(ModuleType):
    """Any name can be imported from it, and none can be used."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def absent(*_: Any, **__: Any) -> Any:
            raise ImportError(f"{self.__name__}.{name} needs a torchvision that works beside this torch; install both from one index")

        return absent
