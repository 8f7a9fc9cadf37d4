"""How numba compiles the kernels: what it does to each of a hundred functions is most of the wait before the first image."""

# numba has no types.
# mypy: ignore-errors

from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

import numba
from numba.core import compiler, typed_passes, types, untyped_passes
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys

from mipmap_plugin.errors import warn
from mipmap_plugin.process.garbage import uncollected

KERNEL = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
INNER = {"error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

# The last minor version of numba whose internals are known to work as used here; a later one compiles as it likes, which takes longer.
KNOWN = (0, 68)
IS_KNOWN = tuple(map(int, numba.__version__.split(".")[:2])) <= KNOWN

# numba's passes without those for what kernels never use, closures, raised exceptions and whole-array expressions among them.
PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.GenericRewrites,
    untyped_passes.DeadBranchPrune,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
    typed_passes.AnnotateTypes,
    typed_passes.NativeLowering,
    typed_passes.NoPythonBackend,
)

# The folders and files whose constants and functions are compiled into kernels.
ROOT = Path(__file__).parents[2]
SOURCES = ("backends/cpu_kernels/*.py", "splatting/*.py", "effects.py", "morton.py", "render_settings.py")


def kernel(function):
    """For functions that Python calls: cached on disk, and without the GIL. Division by zero gives infinity, as in numpy; C calls none of them."""
    if not IS_KNOWN:
        return numba.njit(function, cache=True, **KERNEL)
    dispatcher = _Kernel(function, targetoptions={"nopython": True, **KERNEL}, pipeline_class=_KernelCompiler)
    dispatcher.enable_caching()
    return dispatcher


def inner(function):
    """For functions that only kernels call, always inlined. Without a Python wrapper they compile faster; a call from Python crashes."""
    if not IS_KNOWN:
        return numba.njit(function, **INNER)
    return _Inner(function, targetoptions={"nopython": True, **INNER}, pipeline_class=_InnerCompiler)


class _Kernel(CPUDispatcher):
    def enable_caching(self):
        self._cache = _Cache(self.py_func)

    def compile(self, signature):
        with uncollected(), _remembered():
            return super().compile(signature)


_search = types.Function.get_call_type

# What was found, a signature with its implementation or that there is none, by function, context and types.
_found = {}


@contextmanager
def _remembered():
    """numba searches anew for what `float32 * float32` is each time that a kernel multiplies: 7,000 searches for 500 answers, a fifth of its work."""
    with global_compiler_lock:
        before, types.Function.get_call_type = types.Function.get_call_type, _get_call_type
        try:
            yield
        finally:
            types.Function.get_call_type = before


def _get_call_type(function, context, args, kws):
    """As `numba.types.Function.get_call_type`, of positional arguments once."""
    if kws:
        return _search(function, context, args, kws)
    key = (function, context, *args)
    if key not in _found:
        try:
            signature = _search(function, context, args, kws)
            _found[key] = signature, function.get_impl_key(signature)
        except TypingError as error:
            _found[key] = error.with_traceback(None)
    if isinstance(_found[key], TypingError):
        raise _found[key].with_traceback(None)
    signature, implementation = _found[key]
    function._impl_keys[signature.args] = implementation  # where numba keeps that of whoever searched last, with other options perhaps
    return signature


class _Cache(FunctionCache):
    """Machine code on disk, which goes stale with any source that is compiled into kernels: numba looks at a kernel's own file only."""

    def __init__(self, function):
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(self.cache_path, self._impl.filename_base, sources())

    def load_overload(self, signature, context):
        """As numba's, which first loads all that a compiler needs, scipy too: that takes three times as long as the code itself.

        What cannot be read, or is damaged, as by a power cut, counts as nothing.
        """
        rtsys.initialize(context)
        try:
            return self._load_overload(signature, context)
        except OSError:
            return None
        except Exception:  # of pickle, which raises any
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature, data):
        """As numba's; a full disk, or a file of another user, costs later processes a compilation, and not this one its work."""
        try:
            super().save_overload(signature, data)
        except OSError as error:
            elsewhere = "the variable NUMBA_CACHE_DIR names another folder"
            warn(f"{self.cache_path}: compiled code is not kept there ({error.strerror or error}), so that each command compiles anew; {elsewhere}")


@cache
def sources():
    """A hash of all sources of the kernels: their names and bytes."""
    digest = sha256()
    for pattern in SOURCES:
        for path in sorted(ROOT.glob(pattern)):
            digest.update(str((path.name, path.read_bytes())).encode())
    return digest.hexdigest()


class _Inner(CPUDispatcher):
    """Compiles a function once for `f(x, 1)` and `f(x, 2)`: numba would for each constant apart, and LLVM knows constants after inlining anyway."""

    def get_call_template(self, args, kws):
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)


class _Compiler(compiler.CompilerBase):
    def define_pipelines(self):
        passes = PassManager("kernel")
        for each in PASSES:
            passes.add_pass(each, each.__name__)
        passes.finalize()
        return [passes]


class _KernelCompiler(_Compiler):
    def compile_extra(self, function):
        self.state.library = _KernelLibrary(self.state.targetctx.codegen(), function.__qualname__)
        self.state.library.enable_object_caching()
        return super().compile_extra(function)


class _KernelLibrary(JITCodeLibrary):
    """Optimized as a whole: numba does it function by function before."""

    def _optimize_functions(self, module):
        module.data_layout = self._codegen._data_layout


class _InnerCompiler(_Compiler):
    def compile_extra(self, function):
        self.state.library = _Library(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


class _Library(JITCodeLibrary):
    """LLVM code for callers to inline, which is optimized there. numba would optimize it here too, and make machine code that nobody calls."""

    def _optimize_functions(self, module):
        pass

    def _optimize_final_module(self):
        pass

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def codegen(self):
        return _NoEnvironment


class _NoEnvironment:
    """Stands in for the execution engine, which lacks the function. An environment holds objects of Python, of which kernels use none."""

    @staticmethod
    def set_env(name, environment):
        pass
