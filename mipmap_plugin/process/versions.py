"""The versions that results depend on."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

import torch


def versions() -> dict[str, str]:
    """Those of this package and of torch, by name."""
    try:
        own = version("mipmap-plugin")
    except PackageNotFoundError:  # run from a source tree that was not installed
        own = "source"
    return {"mipmap_plugin": own, "torch": str(torch.__version__)}  # plain text, which a state is read with
