"""How numba compiles the kernels: what it does to each of a hundred functions is most of the wait before the first image."""

# numba has no types.
# mypy: ignore-errors

import numba
from numba.core import compiler, types
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher

# For functions that Python calls: cached on disk, and without the GIL. Division by zero gives infinity, as in numpy. C calls none of them.
kernel = numba.njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)

INNER = {"nopython": True, "error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def inner(function):
    """For functions that only kernels call, always inlined. Without a Python wrapper they compile faster; a call from Python crashes."""
    return _Inner(function, targetoptions=INNER, pipeline_class=_Compiler)


class _Inner(CPUDispatcher):
    """Compiles a function once for `f(x, 1)` and `f(x, 2)`: numba would for each constant apart, and LLVM knows constants after inlining anyway."""

    def get_call_template(self, args, kws):
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)


class _Compiler(compiler.Compiler):
    def compile_extra(self, function):
        self.state.library = _Library(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


class _Library(JITCodeLibrary):
    """LLVM code for callers to inline, which is optimized there. numba would optimize it here too, and make machine code that nobody calls."""

    def _optimize_final_module(self):
        pass

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def codegen(self):
        return _NoEnvironment


class _NoEnvironment:
    """Stands in for the execution engine, which lacks the function. Environments hold Python's objects, and kernels from the cache have none."""

    @staticmethod
    def set_env(name, environment):
        pass
