"""What numba is kept from doing to kernels, because it takes seconds at the first run and gains nothing."""

import errno
import operator
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")

import numba
import numpy as np
from numba.core.codegen import CPUCodegen, CPUCodeLibrary

from mipmap_plugin.backends.cpu_kernels import binning, compiling
from mipmap_plugin.backends.cpu_kernels.memory import scratch
from mipmap_plugin.errors import MipmapPluginWarning


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """An empty folder for compiled code: what an earlier run of the tests has left would be loaded and not compiled."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))


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

    @compiling.inner
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


def called():
    """The statistics of a kernel that is made anew, as another process would, and called."""
    kernel = compiling.kernel(binning.tile_grid.py_func)
    assert kernel(65, 16) == (2, 1)
    return kernel.stats


def test_a_kernel_is_compiled_once_for_all_processes():
    assert [sum(called().cache_hits.values()) for _ in range(2)] == [0, 1]


def test_a_kernel_is_compiled_anew_when_any_source_has_changed(monkeypatch):
    called()
    monkeypatch.setattr(compiling, "sources", lambda: "others")
    assert [sum(called().cache_hits.values()) for _ in range(2)] == [0, 1]


def test_a_full_disk_costs_a_compilation_and_no_work(monkeypatch, tmp_path):
    """A command ended at its first kernel, where the folder of compiled code was full, or beyond a quota."""

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, pytest.warns(MipmapPluginWarning, match=rf"^{tmp_path}\S*: compiled code is not kept there \(No space"):
        patch.setattr(compiling.IndexDataCacheFile, "_save_data", full)
        called()
    assert [sum(called().cache_hits.values()) for _ in range(2)] == [0, 1]


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_machine_code_is_compiled_anew(tmp_path, ending):
    called()
    for file in tmp_path.rglob(f"*.{ending}"):
        file.write_bytes(b"")
    assert [sum(called().cache_hits.values()) for _ in range(2)] == [0, 1]


def test_the_sources_are_all_that_kernels_are_made_of():
    folder = compiling.ROOT / "backends" / "cpu_kernels"
    texts = [text for text in map(Path.read_text, folder.glob("*.py")) if "@inner" in text or "@kernel" in text]
    used = {name for text in texts for name in re.findall(r"^from mipmap_plugin\.(\S+) import", text, re.M)}
    read = {path.relative_to(compiling.ROOT) for pattern in compiling.SOURCES for path in compiling.ROOT.glob(pattern)}
    for_python = {"backends.cpu_kernels", "camera", "process.pool"}
    assert {name for name in used if Path(*name.split(".")).with_suffix(".py") not in read} == for_python


def test_a_kernel_from_the_cache_loads_no_compiler(tmp_path):
    code = "import sys; from mipmap_plugin.backends.cpu_kernels import binning; binning.tile_grid(65, 16); print('numba.np.arraymath' in sys.modules)"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True).stdout for _ in range(2)]
    assert [run.strip() for run in runs] == ["True", "False"]


@pytest.fixture
def searches(monkeypatch):
    """The kinds of numbers of each multiplication that numba looked for."""
    searched, search = [], compiling._search
    monkeypatch.setattr(compiling, "_found", {})
    monkeypatch.setattr(compiling, "_search", lambda function, *rest: (searched.append((function.typing_key, *rest[1])), search(function, *rest))[1])
    return lambda: [str(kinds[0]) for function, *kinds in searched if function is operator.mul]


def test_an_operator_of_the_same_types_is_looked_for_once(searches):
    kernel = compiling.kernel(lambda x, y: x * x * x * (y * y * y))
    assert kernel(2.0, 3) == 8 * 27
    assert sorted(searches()) == ["float64", "float64", "int64"]


def test_what_has_no_meaning_is_refused_each_time():
    kernel = compiling.kernel(lambda x: x * (x, x))
    for _ in range(2):
        with pytest.raises(numba.TypingError, match="No implementation of function"):
            kernel(2.0)


def test_functions_of_others_are_compiled_as_numba_does(searches):
    compiling.kernel(lambda x: x * x)(2.0)
    assert numba.njit(lambda x: x * x)(np.float32(2)) == 4
    assert searches() == ["float64"]


def test_no_function_of_a_kernel_is_optimized_before_the_whole(monkeypatch):
    monkeypatch.delattr(CPUCodegen, "_function_pass_manager")
    assert compiling.kernel(lambda x: x + 1)(2.0) == 3
    with pytest.raises(AttributeError, match="_function_pass_manager"):
        numba.njit(lambda x: x + 1)(2.0)


def test_a_kernel_has_nothing_of_what_others_compiled_with_other_options_meanwhile():
    """It raised ZeroDivisionError, as theirs does, where a kernel has infinity."""

    def inverse(x):
        raise NotImplementedError

    numba.extending.overload(inverse)(lambda x: lambda x: 1 / x)
    assert compiling.kernel(lambda x: inverse(x))(0.0) == np.inf
    with pytest.raises(ZeroDivisionError):
        numba.njit(lambda x: inverse(x))(0.0)
    assert compiling.kernel(lambda x: inverse(x) + 1)(0.0) == np.inf


def test_with_a_later_numba_kernels_compile_as_it_likes(monkeypatch):
    monkeypatch.setattr(compiling, "IS_KNOWN", False)
    use, plus = called_with_constants()
    assert use(10) == 35
    assert type(plus) is type(numba.njit(lambda: None))
