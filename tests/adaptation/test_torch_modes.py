"""Modes of torch that a caller has set change nothing."""

import runpy
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import tiny
import torch
from torch_checkpoints import gsplat_folder

import mipmap_plugin.camera
import mipmap_plugin.models.surfels
from mipmap_plugin import Effects, load_model, load_scene
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.surfels import FLAT
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.process.torch_modes import usual_modes
from mipmap_plugin.wrap import wrap_model


@contextmanager
def default_dtype() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


MODES = {
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "inference mode": torch.inference_mode,
    "no gradients": torch.no_grad,
    "default dtype": default_dtype,
    "default device": lambda: torch.device("meta"),  # stands for a GPU
}


def adapted() -> dict[str, torch.Tensor]:
    """The parameters of an adapted model, and a picture of it."""
    raw = {name: tensor.clone() for name, tensor in BALL.items()}
    made = wrap_model(raw, cameras=CAMERAS).adapt(0.5, steps=3, extra_views=2)
    return {**made.model.parameters(), "image": made.render(made.views()[0], outputs=("depth",)).image}


BALL, CAMERAS = tiny.model().parameters(), tiny.cameras(3)


@pytest.mark.parametrize("mode", MODES)
def test_an_adaptation_is_the_same_in_any_mode(mode: str) -> None:
    plain = adapted()
    asked: AbstractContextManager[object] = MODES[mode]()
    with asked:
        other = adapted()
    assert all(torch.equal(tensor.detach(), other[name].detach()) for name, tensor in plain.items())
    assert torch.get_default_dtype() == torch.float32 and not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize("mode", MODES)
def test_files_are_read_and_written_the_same_in_any_mode(mode: str, tmp_path: Path) -> None:
    base = tiny.folder(tmp_path / "base", CAMERAS)
    checkpoint = gsplat_folder(tmp_path / "gsplat", BALL)

    def files(name: str) -> list[bytes]:
        made = wrap_model(load_model(base), cameras=load_scene(base)).adapt(0.5, recipe="instant")
        own = load_model(checkpoint)
        wrap_model(own, cameras=CAMERAS).render(CAMERAS[0])  # which looks at the versions of its tensors
        saved = [made.save(tmp_path / f"{name}.ply"), load_model(base).save(tmp_path / f"{name}_base.ply", provenance={})]
        return [file.read_bytes() for file in saved]

    plain = files("plain")
    with MODES[mode]():
        other = files("other")
    assert other == plain


def test_a_model_of_inference_tensors_is_taken() -> None:
    with torch.inference_mode():
        model = VanillaModel({name: tensor.clone() for name, tensor in BALL.items()})
    base, plain = wrap_model(model, cameras=CAMERAS), wrap_model(tiny.model(), cameras=CAMERAS)
    assert torch.equal(base.render(CAMERAS[0]).image, plain.render(CAMERAS[0]).image)
    assert base.adapt(0.5, steps=1, extra_views=2).report.validation


@pytest.mark.parametrize("mode", MODES)
def test_modules_are_imported_the_same_in_any_mode(mode: str) -> None:
    with MODES[mode]():
        camera, surfels = (runpy.run_path(module.__file__) for module in (mipmap_plugin.camera, mipmap_plugin.models.surfels))
        moved = CAMERAS[0].moved(torch.eye(4, device="cpu"))
    assert torch.equal(moved.viewmat, CAMERAS[0].moved(torch.eye(4)).viewmat)
    assert torch.equal(camera["ONE_PIXEL"].viewmat, torch.eye(4, dtype=torch.float64)) and surfels["FLAT"] == FLAT


def test_a_thread_that_ends_leaves_the_default_dtype_to_those_that_go_on() -> None:
    first, second = usual_modes(), usual_modes()
    with default_dtype():
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float32
        second.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float64


def precisions() -> list[str]:
    if hasattr(torch.backends, "fp32_precision"):
        return [torch.backends.cuda.matmul.fp32_precision, torch.backends.mkldnn.matmul.fp32_precision]
    return [torch.get_float32_matmul_precision()]


@pytest.mark.parametrize("precision", ["high", "medium"])
def test_products_of_matrices_are_exact_whatever_the_caller_has_set(precision: str) -> None:
    before = precisions()
    try:
        torch.set_float32_matmul_precision(precision)
        asked = precisions()
        with usual_modes():
            assert all(inside in ("ieee", "highest") for inside in precisions())
        assert precisions() == asked != before
    finally:
        torch.set_float32_matmul_precision("highest")


def test_the_compiler_passes_over_what_it_cannot_trace() -> None:
    model, camera = wrap_model(tiny.model(10), cameras=CAMERAS, backend="cpu"), CAMERAS[0]
    compiled = torch.compile(lambda factor: factor * model.render(camera).image, backend="eager")
    assert torch.equal(compiled(torch.tensor(2.0)), 2 * model.render(camera).image)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap, torch.func.jacrev])
def test_transforms_of_functions_are_refused_in_a_sentence(transform: Callable[..., Callable[..., torch.Tensor]]) -> None:
    model, splats, camera = wrap_model(tiny.model(10), cameras=CAMERAS), tiny.gaussians(10), CAMERAS[0]
    calls: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "adapt": lambda factor: factor * model.adapt(0.5).render(camera).image.sum(),
        "render": lambda factor: (factor * CpuBackend().render(splats, camera, Effects(1)).image).sum(),
    }
    for name, call in calls.items():
        with pytest.raises(SettingsError, match=rf"^{name} cannot be transformed by torch\.func .*; call it outside of the transform, or use"):
            transform(call)(torch.tensor([1.0, 2.0]) if transform is torch.func.vmap else torch.tensor(1.0))
