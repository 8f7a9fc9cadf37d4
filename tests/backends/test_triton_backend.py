"""The Triton backend without a GPU: its kernels compile, and it reports what is missing. Their results: `test_triton_interpreted*.py`."""

import contextlib
import importlib.util
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from types import SimpleNamespace

import pytest
import torch
from samples import camera, gaussians

from mipmap_plugin.backends import BACKENDS, survey
from mipmap_plugin.backends.base import AdamStep, Calls, Needs
from mipmap_plugin.backends.conformance import check_backend
from mipmap_plugin.backends.external import NO_CUDA
from mipmap_plugin.backends.triton import NO_TRITON, TritonBackend, interpreted, unbuilt
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.splatting.viewers import find_viewer

MISSING = importlib.util.find_spec("triton") is None
not_old = pytest.mark.skipif(not MISSING and version("triton") < "3.3", reason="triton is older than 3.3, as that of torch 2.5")
pytestmark = pytest.mark.skipif(interpreted(), reason="under the interpreter nothing is compiled, and the CPU is supported")
USUAL = Needs("cuda", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")

FLOAT, INT32, INT64 = "*fp32", "*i32", "*i64"
TYPES = {"splat_ids": INT32, "owners": INT32, "boxes": INT32, "counts": INT32, "tiles": "*i16"}
TYPES |= dict.fromkeys(("tile_offsets", "places", "starts"), INT64)
TYPES |= dict.fromkeys(("count", "pairs", "views", "further", "most_tiles", "most_pixels", "no_tile", "least_key"), "i32")


def compile_for(capability: int, kernel, warps: int = 4, **constants) -> str:
    """The kernel's assembly for a compute capability, from the same compiler as on a machine with a GPU."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    signature = {name: "constexpr" if name in constants else TYPES.get(name, FLOAT) for name in kernel.arg_names}
    compiled = triton.compile(ASTSource(kernel, signature, constants), target=GPUTarget("cuda", capability, 32), options={"num_warps": warps})
    assert compiled.asm["cubin"]
    return compiled.asm["ptx"]


@not_old
@pytest.mark.skipif(MISSING, reason="triton is not installed")
@pytest.mark.parametrize("capability", [80, pytest.param(75, marks=pytest.mark.slow), pytest.param(90, marks=pytest.mark.slow)])
def test_the_kernels_compile_where_there_is_no_gpu(capability, tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    from mipmap_plugin.backends import triton_kernels as sizes
    from mipmap_plugin.backends.triton_kernels import (
        adam,
        binning,
        colors_back,
        compositing,
        compositing_back,
        projection,
        projection_back,
        rounding,
        weighing,
    )

    bands, splat, tile = {"DEGREE": 1, "BANDS": 4}, {"RAW": True, "BLOCK": sizes.SPLATS}, sizes.LARGE_TILE
    for has_covariances in (False, True):  # and with other settings than the usual ones
        shape = {"HAS_COVARIANCES": has_covariances, "VIEWER": has_covariances}
        compile_for(capability, projection.project_kernel, TILE=tile, **shape, **splat, **bands)
        compile_for(capability, projection_back.project_back_kernel, **shape, **splat)
        compile_for(capability, colors_back.color_back_kernel, VIEWER=has_covariances, BLOCK=sizes.SPLATS, **bands)
    compile_for(capability, binning.emit_kernel, TILE=tile, BLOCK=sizes.PAIRS)
    compile_for(capability, rounding.round_kernel, sizes.WARPS, TILE=tile, BATCH=sizes.BATCH)
    for viewer in (False, True):
        compile_for(capability, compositing.composite_kernel, sizes.WARPS, TILE=tile, BATCH=sizes.BATCH, VIEWER=viewer)
    for in_order, viewer in ((False, False), (True, True), (False, True)):
        back = {"TILE": sizes.SMALL_TILE, "BATCH": sizes.BACK_BATCH[sizes.SMALL_TILE], "DETERMINISTIC": in_order, "VIEWER": viewer}
        ptx = compile_for(capability, compositing_back.composite_back_kernel, sizes.WARPS, **back)
        assert ("atom" in ptx or "red.global" in ptx) != in_order
    compile_for(capability, compositing_back.gather_kernel, 1, ROWS=32)
    for in_order in (False, True):
        ptx = compile_for(capability, weighing.weigh_kernel, sizes.WARPS, TILE=tile, BATCH=sizes.BATCH, DETERMINISTIC=in_order, VIEWER=in_order)
        assert ("atom" in ptx or "red.global" in ptx) != in_order
    compile_for(capability, adam.adam_kernel, BANDS=4, BLOCK=sizes.NUMBERS_MOVED)


KEYS = """
import sys
from mipmap_plugin.backends.triton_kernels import drawing, stepping
kernels = {name: value for module in (drawing, stepping) for name, value in vars(module).items() if name.endswith("_kernel")}
for name in sorted(kernels, reverse=sys.argv[1] == "backward"):
    kernels[name].cache_key
assert not any(kernel.used_global_vals for kernel in kernels.values())
print(len(kernels), sorted(kernel.cache_key for kernel in kernels.values()))
"""


@pytest.mark.skipif(MISSING, reason="triton is not installed")
def test_commands_that_call_kernels_in_another_order_find_what_was_compiled():
    commands = [subprocess.Popen([sys.executable, "-c", KEYS, order], stdout=subprocess.PIPE, text=True) for order in ("forward", "backward")]
    forward, backward = (command.communicate()[0] for command in commands)
    assert forward == backward and forward.startswith("10 ")


@pytest.mark.skipif(MISSING, reason="triton is not installed")
@pytest.mark.parametrize("sizes", [[(3, 4)], [(3, 4), (3, 4)], [(3, 4), (4, 3)], [(2, 2), (3, 4), (1, 5)]], ids=str)
def test_views_of_any_sizes_are_packed_and_found_again(sizes):
    from mipmap_plugin.backends.triton_kernels import drawing

    shots, most = [SimpleNamespace(camera=SimpleNamespace(size=size)) for size in sizes], max(height * width for height, width in sizes)
    images, left = ([torch.rand(*size, *rest) for size in sizes] for rest in ((3,), ()))
    empty = drawing.Drawing(SimpleNamespace(shots=shots, most_pixels=most), torch.empty(0), torch.empty(0))
    drawn = empty._replace(transmittances=empty.packed(left))
    assert empty.packed(images).shape == (len(sizes), most, 3)
    assert all(torch.equal(found, image) for found, image in zip(drawn.views_of(empty.packed(images)), images, strict=True))
    assert all(torch.equal(drawn.alpha_of(view), 1 - rest) for view, rest in enumerate(left))


class PretendedDriver:
    """What Triton asks of a machine before it compiles."""

    get_current_device = staticmethod(lambda: 99)  # none of a machine that has some
    get_current_stream = staticmethod(lambda device: 0)

    @staticmethod
    def get_current_target():
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", 90, 32)


@pytest.fixture
def asked(monkeypatch):
    """What Triton is asked to compile; nothing is compiled, nor run."""
    jit = pytest.importorskip("triton.runtime.jit")
    from triton.runtime.driver import driver

    if not hasattr(jit.JITFunction, "_do_compile"):
        pytest.skip("this version of triton compiles elsewhere")
    found = set()

    def compiled(kernel, key, signature, device, constants, options, attributes, warmup):
        found.add((kernel.__name__, str(signature), str(constants), options.num_warps, str(attributes)))

    monkeypatch.setattr(jit.JITFunction, "_do_compile", compiled)
    monkeypatch.setattr(torch.cuda, "device", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(TritonBackend, "lacking", lambda self, needs: [])
    monkeypatch.setattr(torch, "empty", lambda *size, **kinds: torch.ones(*size, **kinds))  # as if each splat were in one tile
    monkeypatch.setattr(driver, "_active", PretendedDriver())
    return found


@pytest.mark.skipif(MISSING, reason="triton is not installed")
@pytest.mark.parametrize("by_rows", [False, True])
@pytest.mark.parametrize("viewer", [None, "playcanvas"])
def test_what_is_compiled_ahead_is_what_a_run_calls(asked, viewer, by_rows, monkeypatch):
    g, small, large = gaussians(6, dtype=torch.float32), camera(16, 12), camera(600, 600)
    effects = [Effects(1)] if viewer is None else [Effects(1), find_viewer(viewer).effects(Effects(1))]
    backend, sizes = TritonBackend(), (small, large)
    backend.compile_ahead(g, effects, Calls(gradients=True, merging=True, by_rows=by_rows, pixels=(16 * 12, 600 * 600)))
    ahead = set(asked)
    asked.clear()
    raw = {name: getattr(g, name).clone() for name in ("means", "quats", "scales", "opacities", "sh")}
    moments, rates = {name: torch.zeros_like(tensor) for name, tensor in raw.items()}, dict.fromkeys(("means", "quats", "scales", "opacities"), 0.0)
    for view in sizes:
        for each in effects:
            backend.weigh_views(g, [(view, each)])
            leaf = g.means.clone().requires_grad_(not by_rows)
            image = backend.render(replace(g, means=leaf), view, each).image
            if by_rows:
                stepper = backend.stepper(raw)
                stepper.differentiate(0, stepper.render(0, view, each).image)
                stepper.step(AdamStep(raw, moments, moments, rates | {"sh0": 0.0, "shN": 0.0}, (0.9, 0.9), 1.0, 1.0))
            else:
                image.sum().backward()
    assert asked == ahead


@not_old
def test_what_is_missing_is_reported(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert TritonBackend().lacking(USUAL) == [NO_TRITON if MISSING else NO_CUDA]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("mipmap_plugin.backends.triton.unbuilt", lambda: [])
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (6, 1))
    assert TritonBackend().lacking(USUAL) == ["it needs a GPU of compute capability 7.0 or more; this one has 6.1"]
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
    assert TritonBackend().lacking(USUAL) == []
    assert TritonBackend().lacking(replace(USUAL, screen_filter="window")) == ["it has the screen filters antialiased, classic, mip, not window"]
    monkeypatch.setattr("mipmap_plugin.backends.triton.version", lambda name: "3.2.0")
    assert TritonBackend().lacking(USUAL) == ["it needs triton 3.3 or newer, which comes with torch 2.7; 3.2.0 is installed"]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert TritonBackend().lacking(USUAL) == [NO_TRITON]


@not_old
def test_without_a_compiler_for_its_launcher_another_backend_is_taken(monkeypatch):
    class Driver:
        @property
        def active(self):
            raise RuntimeError("Failed to find C compiler.")

    monkeypatch.setitem(sys.modules, "triton.runtime", SimpleNamespace(driver=Driver()))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    unbuilt.cache_clear()
    [reason] = TritonBackend().lacking(USUAL)
    unbuilt.cache_clear()
    assert "cannot build what launches its kernels (Failed to find C compiler.); " in reason and "install gcc and python3-dev" in reason


@not_old
def test_it_is_listed_with_its_reasons_and_refuses(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    reason = NO_TRITON if MISSING else NO_CUDA
    assert "triton" in BACKENDS.names()
    assert survey(replace(USUAL, device="cpu"))["triton"] == [reason, "it runs on cuda, not on cpu"]
    with pytest.raises(BackendUnavailable, match="backend 'triton' cannot do this: it needs"):
        TritonBackend().render(gaussians(2, dtype=torch.float32), camera(), Effects(1))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_on_a_gpu_every_hard_case_equals_the_reference():
    wrong = {outcome.case: outcome.message for outcome in check_backend(TritonBackend(), device="cuda") if not outcome.passed}
    assert not wrong
