"""Torch's modes that a caller may have set: they would change results here, or break operations in place. And its compiler and transforms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

import torch

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.process.threads import of_fork

P = ParamSpec("P")
T = TypeVar("T")

# What torch says of a precision that nobody set: float32.
UNSET = "none"


@contextmanager
def usual_modes() -> Iterator[None]:
    """Inside, there is no autocast and no inference mode, new tensors are of float32 and on the processor by default, and products of matrices
    are exact to float32. In a process that was forked torch has one thread, as it waits forever for those of the parent."""
    with ExitStack() as stack:
        stack.enter_context(of_fork())
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        for setting in _shared:
            setting.enter()
            stack.callback(setting.leave)
        yield


def opaque(function: Callable[P, T], modes: Callable[[], AbstractContextManager[None]] = of_fork) -> Callable[P, T]:
    """The function, which torch.compile runs as it is, and torch.func refuses with a SettingsError: neither can look into compiled kernels.

    `modes`: a context that it runs in; by default only what a process that was forked needs.
    """

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch._C._are_functorch_transforms_active():
            advice = "call it outside of the transform, or use torch.autograd.grad"
            raise SettingsError(f"{function.__name__} cannot be transformed by torch.func (grad, vmap, jvp, ...); {advice}")
        if torch.compiler.is_compiling():  # only then: to ask for it ahead would import the compiler, which takes seconds
            disabled: Callable[P, T] = torch.compiler.disable(called)
            return disabled(*args, **kwargs)
        with modes():
            return function(*args, **kwargs)

    return called


def in_usual_modes(function: Callable[P, T]) -> Callable[P, T]:
    """The function, which runs in `usual_modes` and is `opaque`."""
    return opaque(function, usual_modes)


class _Shared:
    """A setting of all threads: it is `usual` from the first that enters to the last that leaves, and then the caller's again."""

    def __init__(self, read: Callable[[], Any], write: Callable[[Any], object], usual: Any) -> None:
        self._lock, self._inside = Lock(), 0
        self.read, self.write, self._usual = read, write, usual
        self._callers: Any = None

    def enter(self) -> None:
        with self._lock:
            self._inside += 1
            if (now := self.read()) not in (self._usual, UNSET):
                self._callers = now
                self.write(self._usual)

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._callers is not None:
                self.write(self._callers)
                self._callers = None


# How a setting of torch is read, and how it is set.
_Setting = tuple[Callable[[], Any], Callable[[Any], object]]


def _fp32_precision(kind: Any) -> _Setting:
    return partial(getattr, kind, "fp32_precision"), partial(setattr, kind, "fp32_precision")


def _precisions() -> list[_Shared]:
    """How products of float32 matrices are rounded: a GPU may have been asked for TF32, with 3 decimal digits, a processor for bfloat16."""
    if not hasattr(torch.backends, "fp32_precision"):  # before torch 2.9
        return [_Shared(torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, "highest")]
    kinds: tuple[Any, ...] = (torch.backends.cuda.matmul, torch.backends.mkldnn.matmul)  # type: ignore[attr-defined]  # torch's
    return [_Shared(*_fp32_precision(kind), "ieee") for kind in kinds]


_shared = [_Shared(torch.get_default_dtype, torch.set_default_dtype, torch.float32), *_precisions()]


def _set_default_device(device: torch.device) -> None:
    torch.set_default_device(None if device.type == "cpu" else device)  # None: without a look at each call of torch


def _older_precision() -> str:
    """How products of matrices are rounded, by torch's older functions, which refuse to tell it where newer ones have set it."""
    try:
        return torch.get_float32_matmul_precision()
    except RuntimeError:
        return UNSET


def _set_older_precision(precision: str) -> None:
    if precision != UNSET:
        torch.set_float32_matmul_precision(precision)


# The older functions set the newer precisions too, and refuse to tell what these were set to by themselves.
_newer: list[_Setting] = [_fp32_precision(torch.backends)] if hasattr(torch.backends, "fp32_precision") else []
_newer += [(setting.read, setting.write) for setting in _precisions()]

# What a module may set for all of torch, most often at its top.
_settings: list[_Setting] = [
    (torch.get_default_dtype, torch.set_default_dtype),
    *_newer,
    (_older_precision, _set_older_precision),
    *_newer,
    (torch.get_default_device, _set_default_device),
    (torch.get_num_threads, torch.set_num_threads),
    (torch.is_grad_enabled, torch.set_grad_enabled),
]


@contextmanager
def settings_kept() -> Iterator[None]:
    """Undo what the block sets for all of torch, the state of its random numbers included: a plug-in that is only imported changes nothing else."""
    before = [read() for read, _ in _settings]
    try:
        with torch.random.fork_rng(devices=()):
            yield
    finally:
        for (read, write), value in zip(_settings, before, strict=True):
            if read() != value:
                write(value)
