"""Several small views of the same splats, as the steps of an adaptation draw them: in one call, and one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from gpu_gsplat import ITSELF, find, rasterized, with_itself
from gpu_tables import Failure
from gpu_timing import Clock
from torch import Tensor
from workloads import activated, effects_of

from mipmap_plugin import Camera, Gaussians, load_model
from mipmap_plugin.wrap import own_cameras

BASE = "lego_200"
WIDTHS = (50, 100, 200, 400)  # px
COUNTS = (1, 4, 8)  # views


@dataclass(frozen=True)
class Views:
    """Milliseconds per view, forward and backward."""

    backend: str
    width: int  # px
    views: int
    alone_ms: float  # one after the other
    together_ms: float | None  # in one call; None: the backend has none


@dataclass(frozen=True)
class Shots:
    """Raw parameters, and views of them of one size."""

    raw: dict[str, Tensor]
    cameras: Sequence[Camera]


def measure_views(data: Path, backends: Sequence[str], device: str, runs: int) -> Iterator[Views | Failure]:
    """Every backend on every size and number of views of one base."""
    model = load_model(data / "checkpoints" / "bases" / BASE)
    cameras = own_cameras(model)[: max(COUNTS)]
    raw = raw_of(model.gaussians(cameras[0]).detach(), device)
    for width in WIDTHS:
        sized = [camera.resized(width, round(width * camera.height / camera.width)) for camera in cameras]
        for name in with_itself(backends):
            try:
                for count in COUNTS:
                    yield measure(name, Shots(raw, sized[:count]), device, runs)
            except Exception as error:  # as in `gpu_speed.py`
                yield Failure.of(name, f"views of {width} px", error)


def raw_of(gaussians: Gaussians, device: str) -> dict[str, Tensor]:
    """The raw parameters of splats, to be differentiated."""
    raw = {
        "means": gaussians.means, "log_scales": gaussians.scales.log(), "quats": gaussians.quats,
        "logits": gaussians.opacities.logit(eps=1e-6), "sh": gaussians.sh,
    }  # fmt: skip
    return {name: tensor.to(device).clone().requires_grad_() for name, tensor in raw.items()}


def measure(name: str, shots: Shots, device: str, runs: int) -> Views:
    clock, count, width = Clock(device), len(shots.cameras), shots.cameras[0].width
    alone, together = (clock.milliseconds(call, runs) / count if call else None for call in (_alone(name, shots), _together(name, shots)))
    return Views(name, width, count, round(alone or 0.0, 4), together and round(together, 4))


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
