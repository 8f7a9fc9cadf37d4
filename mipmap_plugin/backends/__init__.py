"""The registry of backends, and the choice of one for a request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from mipmap_plugin.backends.base import API_VERSION, Backend, Needs
from mipmap_plugin.backends.guarded import Guarded
from mipmap_plugin.errors import BackendUnavailable, PluginError, SettingsError, type_of, warn, with_type
from mipmap_plugin.plugin_errors import is_third_party
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
    """Register a backend under `name`: a class, or `"package.module:Class"`, which is imported at first use. Raises SettingsError."""
    if name == "auto":
        raise SettingsError("a backend cannot be named 'auto', which stands for the fastest one; choose another name")
    BACKENDS.add(name, target, replace=replace)


def get_backend(name: str) -> Backend:
    """The backend `name`. Raises SettingsError if it is unknown, PluginError if it does not load or has another API version."""
    factory = BACKENDS.get(name)
    if not callable(factory):  # most often a backend itself
        raise PluginError(f"backend {name!r} is of type {type(factory).__name__}; register its class, or a function that makes one")
    try:
        backend: Backend = factory()
    except Exception as error:  # a third-party constructor may fail in any way; one broken plug-in must not break the others
        raise PluginError(f"backend {name!r} cannot be created: {with_type(error)}") from error
    if getattr(backend, "api_version", None) != API_VERSION:
        version = getattr(backend, "api_version", "unknown")
        raise PluginError(f"backend {name!r} is written for API version {version}, but this package has API version {API_VERSION}")
    missing = [part for part in ("lacking", "render") if not callable(getattr(backend, part, None))]
    missing += [part for part, kind in (("name", str), ("speed", (int, float))) if not isinstance(getattr(backend, part, None), kind)]
    if missing:
        raise PluginError(f"backend {name!r} lacks {', '.join(missing)}; see mipmap_plugin.backends.base.Backend")
    return Guarded(name, backend) if is_third_party(backend) else backend


def survey(*needs: Needs) -> dict[str, list[str]]:
    """For each registered backend, the reasons why it cannot serve all of `needs`; an empty list if it can."""
    reasons = {}
    for name in BACKENDS.names():
        try:
            reasons[name] = _lacking(name, get_backend(name), needs)
        except PluginError as error:
            reasons[name] = [str(error)]
    return reasons


def device_for(name: str) -> str:
    """The device to load a model to: "cuda" if there is a GPU that the backend `name` can use (for `"auto"`, any backend but the
    reference), else "cpu". Raises SettingsError for an unknown name."""
    if not torch.cuda.is_available():
        return "cpu"
    usual = Needs("cuda", torch.float32, gradients=True, sh_degree=0, screen_filter="classic")
    if name == "auto":
        return "cuda" if any(not reasons for other, reasons in survey(usual).items() if other != "reference") else "cpu"
    backend = get_backend(name)
    return "cuda" if _lacking(name, backend, [replace(usual, device="cpu")]) and not _lacking(name, backend, [usual]) else "cpu"


def choose_backend(name: str, *needs: Needs) -> tuple[Backend, str]:
    """The backend that serves all of `needs`, and why it was chosen. `"auto"`: the fastest that can serve them.

    Raises BackendUnavailable, with every reason, if there is none.
    """
    if name != "auto":
        backend = get_backend(name)
        reasons = _lacking(name, backend, needs)
        if reasons:
            best = _fastest(survey(*needs))
            raise BackendUnavailable(f"backend {name!r} cannot do this{f', but {best.name} can' if best else ''}: {'; '.join(reasons)}")
        return backend, f"{name}: requested{_note_in_brackets(backend)}"
    reasons_of = survey(*needs)
    best = _fastest(reasons_of)
    if best is None:
        raise BackendUnavailable("no backend can do this: " + " | ".join(f"{n}: {'; '.join(r)}" for n, r in reasons_of.items()))
    if isinstance(best, Guarded):
        best.unasked()
    _warn_of_numba(best.name, reasons_of.get("cpu", []))
    others = [f"{n} cannot: {r[0]}" for n, r in reasons_of.items() if r]
    return best, f"{best.name}: the fastest that can serve the request{_note_in_brackets(best)}" + "".join(f"; {reason}" for reason in others)


def _fastest(reasons_of: dict[str, list[str]]) -> Backend | None:
    """The fastest of the backends that lack nothing; None if there is none."""
    able = [get_backend(name) for name, reasons in reasons_of.items() if not reasons]
    return max(able, key=lambda backend: backend.speed, default=None)


def _warn_of_numba(chosen: str, reasons: Sequence[str]) -> None:
    """Say that a working numba would save much time, where the backend cpu lacks nothing else."""
    if chosen == "reference" and len(reasons) == 1 and "numba" in reasons[0]:
        warn(f"backend cpu cannot do this: {reasons[0]}; the backend reference takes its place, many times slower")


def _lacking(name: str, backend: Backend, needs: Sequence[Needs]) -> list[str]:
    """The reasons why a backend cannot serve all of `needs`. Raises PluginError."""
    try:
        answers: list[Any] = [backend.lacking(need) for need in needs]
    except (Exception, SystemExit) as error:  # as in `get_backend`
        raise PluginError(f"backend {name!r} cannot say what it lacks: {with_type(error)}") from error
    if wrong := [answer for answer in answers if not isinstance(answer, (list, tuple))]:
        raise PluginError(f"backend {name!r}: lacking() has to return a list of sentences; it returned {type_of(wrong[0])}")
    return list(dict.fromkeys(str(reason) for answer in answers for reason in answer))


def note_of(name: str) -> str:
    """The backend's own remark on itself; empty if it has none or does not load."""
    try:
        return getattr(get_backend(name), "note", "")
    except PluginError:
        return ""


def _note_in_brackets(backend: Backend) -> str:
    note = getattr(backend, "note", "")
    return f" ({note})" if note else ""
