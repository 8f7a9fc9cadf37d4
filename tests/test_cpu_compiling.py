"""What numba is kept from doing to kernels, because it takes seconds at the first run and gains nothing."""

from __future__ import annotations

import pytest

pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")

import numba
from numba.core.codegen import CPUCodeLibrary

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.memory import scratch


@pytest.fixture
def emitted(monkeypatch):
    """The text of all LLVM modules, before LLVM sees them."""
    texts = []
    add = CPUCodeLibrary.add_ir_module
    monkeypatch.setattr(CPUCodeLibrary, "add_ir_module", lambda library, module: (texts.append(str(module)), add(library, module)))
    return texts


def test_scratch_memory_is_not_zeroed_number_by_number(emitted):
    new = scratch(6144, numba.types.float32)

    @numba.njit
    def use():
        memory = new()
        memory[5] = 3
        return memory[5] + memory[6143]

    assert use() == 3
    assert not [line for text in emitted for line in text.splitlines() if "store [6144 x float]" in line]


def called_with_constants():
    """A kernel, and the function that it calls."""

    @inner
    def plus(x, k):
        return x + k

    @numba.njit
    def use(x):
        return plus(x, 1) + plus(x, 2) + plus(x, len((x, x)))

    return use, plus


def test_a_function_is_compiled_once_for_all_constants():
    use, plus = called_with_constants()
    assert use(10) == 35
    assert [str(kind) for kinds in plus.overloads for kind in kinds] == ["int64", "int64"]


def test_no_machine_code_is_made_of_what_is_inlined():
    use, plus = called_with_constants()
    use(10)
    assert not is_defined(*plus.overloads.values())
    assert is_defined(*use.overloads.values())


def is_defined(result) -> bool:
    """Whether the process holds machine code of a function."""
    return result.target_context.codegen()._engine.is_symbol_defined(result.fndesc.mangled_name)
