"""A pretended device: tensors report another device, and are in the memory of the CPU.

Operations on them compute what the CPU does, so that results can be compared bit by bit. One that mixes them with tensors of the CPU fails
as on a GPU, as does one that torch implements for the CPU only. One whose result the host would have to wait for is recorded, with the
line that calls it.
"""

import traceback
import types
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

# Torch knows the device "meta" without anything being installed, and computes nothing there by itself.
DEVICE, HERE = "meta", torch.device("cpu")
if not hasattr(torch, DEVICE):
    torch.meta = types.ModuleType("torch.meta")  # where torch before 2.8 looks for a device's random numbers, to leave them alone

aten = torch.ops.aten
MOVES = {aten._to_copy.default, aten.copy_.default}
TAKES_INDICES = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default}  # from either device
# Their answers, or the sizes of them, follow from the numbers in a tensor.
WAITS = {
    aten._local_scalar_dense.default, aten.nonzero.default, aten.equal.default, aten.masked_select.default, aten._unique2.default,
    aten.unique_consecutive.default, aten.repeat_interleave.Tensor, aten.bincount.default,
}  # fmt: skip
# What has an implementation for CPU in torch's native_functions.yaml (2.13) and none for CUDA or for all devices; sparse and quantized
# tensors aside.
CPU_ONLY = {
    "_upsample_lanczos2d_aa", "_upsample_lanczos2d_aa_backward", "histogram", "_histogramdd_bin_edges", "_histogramdd_from_bin_cts",
    "_histogramdd_from_bin_tensors", "slow_conv3d_forward", "_spdiags", "_add_relu", "_add_relu_",
}  # fmt: skip


class Pretended(torch.Tensor):
    """`inner`, a tensor of the processor, under the name of the other device."""

    @staticmethod
    def __new__(cls, inner: torch.Tensor):
        facts = dict(strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype, requires_grad=inner.requires_grad)
        return torch.Tensor._make_wrapper_subclass(cls, inner.shape, device=torch.device(DEVICE), **facts)

    def __init__(self, inner: torch.Tensor):
        self.inner = inner

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise RuntimeError(f"{func}: a tensor outlived the device that it pretends to be on")


class Device(TorchDispatchMode):
    """What computes, refuses and takes notes."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """No: nothing here is compiled, and torch would import its compiler to leave each operation out of it."""
        return False

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()  # by the line of the package that asks
        self.operations = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        tensors: list[torch.Tensor] = []
        inner_args = _inner(args, tensors)
        inner_kwargs = {name: _inner(value, tensors) for name, value in kwargs.items()} if kwargs else {}
        there = any(isinstance(tensor, Pretended) for tensor in tensors)
        if any(tensor.is_meta and not isinstance(tensor, Pretended) for tensor in tensors):
            raise RuntimeError(f"{func}: a tensor was made where nobody looked, and holds nothing")
        target = inner_kwargs.get("device")
        goes_there = there if target is None else torch.device(target).type == DEVICE
        if not there and not goes_there:
            return func(*args, **inner_kwargs)
        self.operations += 1
        if func.overloadpacket.__name__ in CPU_ONLY:
            raise RuntimeError(f"{func}: torch has it for processors alone")
        mixed = there and any(not isinstance(tensor, Pretended) and tensor.dim() for tensor in tensors)
        if mixed and func not in MOVES | TAKES_INDICES:  # asked last, for operations take long to be looked up in sets
            raise RuntimeError(f"{func}: tensors on two devices")
        goes_there = isinstance(args[0], Pretended) if func is aten.copy_.default else goes_there
        if self._waits(func, args, there and not goes_there):
            self.waits[_asker()] += 1
        if target is not None:
            inner_kwargs["device"] = HERE
        result = func(*inner_args, **inner_kwargs)
        return _outer(result, [tensor for tensor in tensors if isinstance(tensor, Pretended)]) if goes_there else result

    @staticmethod
    def _waits(func, args, comes_back: bool) -> bool:
        masked = func in TAKES_INDICES and any(index is not None and index.dtype == torch.bool for index in args[1])
        return func in WAITS or masked or (func in MOVES and comes_back)


class Factories(TorchFunctionMode):
    """Tensors from numbers, and indices from lists and tuples, which torch makes in one go where no mode looks; and lists from tensors."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.Tensor.tolist:
            args = (args[0].cpu(),)
        if func is torch.Tensor.new_tensor and isinstance(args[0], Pretended):
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(DEVICE)
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[1], tuple):
            index = tuple(torch.tensor(part) if isinstance(part, list | tuple) else part for part in args[1])
            args = (args[0], index, *args[2:])
        return func(*args, **kwargs)


@contextmanager
def pretending() -> Iterator[Device]:
    """Inside, `.to(DEVICE)` takes tensors to the device and `.cpu()` back."""
    with Device() as device, Factories():
        yield device


def _inner(value, tensors):
    """What a function is given, with the tensors of the processor in place of those that pretend, and those in `tensors`.

    Torch's own `tree_map` takes ten times as long, for what no operation is given.
    """
    if isinstance(value, torch.Tensor):
        tensors.append(value)
        return value.inner if isinstance(value, Pretended) else value
    return type(value)([_inner(part, tensors) for part in value]) if isinstance(value, list | tuple) else value


def _outer(result, pretended):
    """What a function returns, as pretending tensors. What was written in place stays the tensor that it was."""
    if isinstance(result, torch.Tensor):
        written = [tensor for tensor in pretended if tensor.inner is result]
        return written[0] if written else Pretended(result)
    return type(result)([_outer(part, pretended) for part in result]) if isinstance(result, list | tuple) else result


def _asker() -> str:
    frames = traceback.walk_stack(None)
    asker = next((frame for frame, _ in frames if "/mipmap_plugin/" in frame.f_code.co_filename), None)
    if asker is None:
        return "a test"
    return f"{asker.f_code.co_filename.split('/mipmap_plugin/')[-1]}: {asker.f_lineno}"
