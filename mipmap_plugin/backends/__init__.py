"""The registry of backends, and the choice among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from mipmap_plugin.backends.base import API_VERSION, Backend, Needs
from mipmap_plugin.errors import BackendUnavailable, PluginError
from mipmap_plugin.registry import Registry

BACKENDS = Registry(
    "mipmap_plugin.backends",
    {
        "reference": "mipmap_plugin.backends.reference:ReferenceBackend",
        "cpu": "mipmap_plugin.backends.cpu:CpuBackend",
        "gsplat": "mipmap_plugin.backends.gsplat:GsplatBackend",
        "inria": "mipmap_plugin.backends.inria:InriaBackend",
        "triton": "mipmap_plugin.backends.triton:TritonBackend",
    },
)


def register_backend(name: str, target: Any, *, replace: bool = False) -> None:
    """Add a backend under `name`: a class, or `"package.module:Class"` that is imported at first use."""
    BACKENDS.add(name, target, replace=replace)


def get_backend(name: str) -> Backend:
    """The backend `name`. Raises SettingsError when unknown, PluginError when it does not load or is of another API version."""
    maker = BACKENDS.get(name)
    try:
        backend = maker()
    except Exception as error:  # a stranger's constructor may fail in any way; one broken plugin must not break the others
        raise PluginError(f"backend {name!r} cannot be made: {type(error).__name__}: {error}") from error
    if getattr(backend, "api_version", None) != API_VERSION:
        raise PluginError(f"backend {name!r} is written for API version {getattr(backend, 'api_version', 'unknown')}, this package has {API_VERSION}")
    return backend


def survey(*needs: Needs) -> dict[str, list[str]]:
    """Every known backend and why it cannot serve all of `needs`; an empty list where it can."""
    reasons = {}
    for name in BACKENDS.names():
        try:
            reasons[name] = _lacking(get_backend(name), needs)
        except PluginError as error:
            reasons[name] = [str(error)]
    return reasons


def device_for(name: str) -> str:
    """Where a model that comes from a file should lie: on the GPU where there is one and the backend `name`, or for `"auto"` any but the
    reference, serves it there; else on the processor. Raises SettingsError for an unknown name."""
    if not torch.cuda.is_available():
        return "cpu"
    usual = Needs("cuda", torch.float32, gradients=True, sh_degree=0, screen_filter="classic")
    if name == "auto":
        return "cuda" if any(not reasons for other, reasons in survey(usual).items() if other != "reference") else "cpu"
    backend = get_backend(name)
    return "cuda" if backend.lacking(replace(usual, device="cpu")) and not backend.lacking(usual) else "cpu"


def choose_backend(name: str, *needs: Needs) -> tuple[Backend, str]:
    """The backend for all of `needs` and why it was taken. `"auto"`: the fastest that lacks nothing.

    Raises BackendUnavailable with every reason when there is none.
    """
    if name != "auto":
        backend = get_backend(name)
        reasons = _lacking(backend, needs)
        if reasons:
            raise BackendUnavailable(f"backend {name!r} cannot do this: {'; '.join(reasons)}")
        return backend, f"{name}: asked for{_noted(backend)}"
    reasons_of = survey(*needs)
    able = [get_backend(name) for name, reasons in reasons_of.items() if not reasons]
    if not able:
        raise BackendUnavailable("no backend can do this: " + " | ".join(f"{n}: {'; '.join(r)}" for n, r in reasons_of.items()))
    best = max(able, key=lambda backend: backend.speed)
    faster_not = [f"{n} not, because {r[0]}" for n, r in reasons_of.items() if r]
    return best, f"{best.name}: the fastest that lacks nothing{_noted(best)}" + "".join(f"; {reason}" for reason in faster_not)


def _lacking(backend: Backend, needs: Sequence[Needs]) -> list[str]:
    return list(dict.fromkeys(reason for each in needs for reason in backend.lacking(each)))


def note_of(name: str) -> str:
    """What is to be known of a backend; empty where there is nothing, or no backend."""
    try:
        return getattr(get_backend(name), "note", "")
    except PluginError:
        return ""


def _noted(backend: Backend) -> str:
    note = getattr(backend, "note", "")
    return f" ({note})" if note else ""
