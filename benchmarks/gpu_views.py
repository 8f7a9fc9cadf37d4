"""Several small views of the same splats, as the steps of an adaptation draw them: in one call, and one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from gpu_gsplat import ITSELF, find, rasterized, with_itself
from gpu_records import Views
from gpu_timing import Clock
from gpu_work import Work, kept
from torch import Tensor
from workloads import activated, effects_of, raw_of

from mipmap_plugin import Camera, Gaussians, load_model, wrap_model
from mipmap_plugin.backends.base import AdamStep

BASE = "lego_200"
WIDTHS = (50, 100, 200, 400)  # px
COUNTS = (1, 4, 8)  # views
EXPECTED_S = 6.0  # of one backend at one width

# The raw parameters' names in an `AdamStep`, and here.
NAMES = {"means": "means", "quats": "quats", "scales": "log_scales", "opacities": "logits", "sh": "sh"}


@dataclass(frozen=True)
class Shots:
    """Raw parameters, and views of them of one size."""

    raw: dict[str, Tensor]  # to be differentiated
    cameras: Sequence[Camera]

    @classmethod
    def of(cls, gaussians: Gaussians, cameras: Sequence[Camera]) -> Shots:
        return cls({name: tensor.clone().requires_grad_() for name, tensor in raw_of(gaussians).items()}, cameras)


@kept
def of_base(data: Path, device: str) -> Shots:
    """The raw parameters of the base, and its first views."""
    model = load_model(data / "checkpoints" / "bases" / BASE)
    cameras = wrap_model(model).cameras[: max(COUNTS)]
    return Shots.of(model.gaussians(cameras[0]).detach().to(device), cameras)


def measure_views(name: str, width: int, data: Path, device: str, runs: int) -> Iterator[Views]:
    """One backend on every number of views of one width of the base."""
    shots = of_base(data, device)
    sized = [camera.resized(width, round(width * camera.height / camera.width)) for camera in shots.cameras]
    for count in COUNTS:
        yield measure(name, Shots(shots.raw, sized[:count]), device, runs)


def works(data: Path, backends: Sequence[str], device: str, runs: int) -> list[Work]:
    """Every backend on every width."""
    return [
        Work("views", name, f"views of {width} px", EXPECTED_S, measure_views, (name, width, data, device, runs))
        for width in WIDTHS for name in with_itself(backends)
    ]  # fmt: skip


def measure(name: str, shots: Shots, device: str, runs: int) -> Views:
    clock, count, width = Clock(device), len(shots.cameras), shots.cameras[0].width
    kinds = (_alone(name, shots), _together(name, shots), _step(name, shots))
    alone, together, step = (round(clock.milliseconds(call, runs) / count, 4) if call else None for call in kinds)
    return Views(name, width, count, alone or 0.0, together, step or 0.0)


def _differentiated(shots: Shots, images: Callable[[Gaussians], list[Tensor]]) -> None:
    for leaf in shots.raw.values():
        leaf.grad = None
    torch.stack([image.square().sum() for image in images(activated(shots.raw))]).sum().backward()


def _alone(name: str, shots: Shots) -> Callable[[], None]:
    backend = find(name)

    def images(gaussians: Gaussians) -> list[Tensor]:
        return [backend.render(gaussians, camera, effects_of(gaussians)).image for camera in shots.cameras]

    return lambda: _differentiated(shots, images)


def _together(name: str, shots: Shots) -> Callable[[], None] | None:
    """gsplat itself draws several cameras at once."""
    backend = find(name)
    if name == ITSELF:
        return lambda: _differentiated(shots, lambda gaussians: list(rasterized(gaussians, shots.cameras, effects_of(gaussians))[0]))
    if not hasattr(backend, "render_views"):
        return None

    def images(gaussians: Gaussians) -> list[Tensor]:
        drawn = backend.render_views(gaussians, [(camera, effects_of(gaussians)) for camera in shots.cameras])
        return [rendered.image for rendered in drawn]

    return lambda: _differentiated(shots, images)


def _step(name: str, shots: Shots) -> Callable[[], None]:
    backend = find(name)
    if hasattr(backend, "stepper"):
        return _of_stepper(backend, shots)
    draw, optimizer = _together(name, shots) or _alone(name, shots), torch.optim.Adam(shots.raw.values(), lr=1e-9, fused=True)

    def step() -> None:
        draw()
        optimizer.step()

    return step


def _of_stepper(backend: Any, shots: Shots) -> Callable[[], None]:
    """A step by what draws, differentiates and moves splats itself."""
    raw = {own: shots.raw[name].detach().clone() for own, name in NAMES.items()}
    first, second = ({own: torch.zeros_like(tensor) for own, tensor in raw.items()} for _ in range(2))
    rates = dict.fromkeys(("means", "quats", "scales", "opacities", "sh0", "shN"), 1e-9)
    adam = AdamStep(raw, first, second, rates, betas=(0.9, 0.95), correction=1.0, eps=1e-15)
    stepper, effects = backend.stepper(raw), effects_of(activated(shots.raw))

    def step() -> None:
        views = [(camera, effects) for camera in shots.cameras]
        if hasattr(stepper, "render_all"):
            stepper.differentiate_all([2 * drawn.image for drawn in stepper.render_all(views)])
        else:
            for number, view in enumerate(views):
                stepper.differentiate(number, 2 * stepper.render(number, *view).image)
        stepper.step(adam)

    return step
