"""Speed and memory of one image, forward and with gradients: generated splats, image sizes and screen filters."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Literal

import torch
from gpu_gsplat import find, with_itself
from gpu_records import Failure, Speed
from gpu_timing import Clock
from gpu_work import Work, kept
from scenes import Scene as Generated
from scenes import Spec, make_to
from torch import Tensor
from workloads import Passes, effects_of

from mipmap_plugin.adaptation.renderers import unrounded
from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import rotations
from mipmap_plugin.splatting.viewers import find_viewer

# Viewers by whose filter and cut-offs images are drawn, but not rounded: as in the steps of an adaptation.
Mode = Literal["classic", "antialiased", "playcanvas"]
MODES: tuple[Mode, ...] = ("classic", "antialiased", "playcanvas")

SPREAD = 0.47  # as in scenes A and C: about 44 splats reach a pixel, more where they are smaller than one
MOST_GENERATED = 1_000_000  # splats; numpy needs 4 s for so many, so more are made from these on the device

EXPECTED_S = 6.0  # of one backend on one case in one mode

Case = tuple[int, int, int]  # splats, width, height


@dataclass(frozen=True)
class Scene:
    """Raw parameters on a device, a view, and the gradient of a loss over its image."""

    raw: dict[str, Tensor]
    camera: Camera
    weights: Tensor  # [H, W, 3]

    @classmethod
    def of(cls, splats: int, width: int, height: int, device: str, generated: Generated | None = None) -> Scene:
        """`generated`: what `make_to(spec_of(...))` gave, in another process perhaps."""
        generated = generated or make_to(spec_of(splats, width, height))
        raw = {name: torch.from_numpy(array).to(device) for name, array in generated.raw.items()}
        raw = denser(raw, -(-splats // len(raw["means"])))
        raw = {name: tensor[:splats].clone().requires_grad_() for name, tensor in raw.items()}
        weights = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0)).to(device)
        return cls(raw, generated.camera.resized(width, height), weights)

    @property
    def parameter_bytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self.raw.values())


def spec_of(splats: int, width: int, height: int) -> Spec:
    """What is generated for a case: the same for all images of one shape."""
    return Spec(min(splats, MOST_GENERATED), *((1920, 1080) if width * 1080 == height * 1920 else (width, height)), SPREAD)


def denser(raw: dict[str, Tensor], times: int) -> dict[str, Tensor]:
    """`times` as many splats on the same surfaces: each becomes several, as much smaller, within the place that it filled."""
    if times == 1:
        return raw
    raw = {name: tensor.repeat(times, *[1] * (tensor.dim() - 1)) for name, tensor in raw.items()}
    rng = torch.Generator().manual_seed(0)
    along = (2 * torch.rand(raw["means"].shape, generator=rng).to(raw["means"]) - 1) * raw["log_scales"].exp()
    means = raw["means"] + (rotations(raw["quats"]) @ along[..., None])[..., 0]
    return raw | {"means": means, "log_scales": raw["log_scales"] - 0.5 * torch.tensor(float(times)).log().item()}


_made: dict[Spec, Generated] = {}


def generated(cases: Sequence[Case]) -> dict[Spec, Generated]:
    """The scenes of all cases, made once, by several processes at the same time."""
    missing = list(dict.fromkeys(spec for case in cases if (spec := spec_of(*case)) not in _made))
    if len(missing) < 2:
        _made.update((spec, make_to(spec)) for spec in missing)
    else:
        with ProcessPoolExecutor(len(missing), get_context("spawn")) as workers:
            _made.update(zip(missing, workers.map(make_to, missing), strict=True))
    return _made


def effects_in(mode: Mode, gaussians: Gaussians) -> Effects:
    """Every SH band, and the filter and cut-offs of a viewer."""
    effects = effects_of(gaussians)
    return effects if mode == "classic" else unrounded(find_viewer(mode).effects(effects))


def needs_of(mode: Mode, device: str) -> Needs:
    """What a backend has to serve to be measured."""
    empty = Gaussians(*(torch.zeros(0, *shape, device=device) for shape in ((3,), (4,), (3,), (), (16, 3))))
    return Needs.of(empty, effects_in(mode, empty), gradients=True)


@kept
def scene_of(case: Case, device: str, cases: Sequence[Case]) -> Scene:
    """The scene of a case, kept for the next piece of work on it; what all `cases` are made from is generated with the first."""
    return Scene.of(*case, device, generated(cases)[spec_of(*case)])


def measure_one(name: str, mode: Mode, case: Case, device: str, runs: int, cases: Sequence[Case]) -> Iterator[Speed | Failure]:
    """One backend on one case in one mode; `cases`: those of the whole run."""
    backend = find(name)
    if reasons := backend.lacking(needs_of(mode, device)):
        yield Failure(name, f"as {mode}", "; ".join(reasons))
        return
    yield measure(backend, scene_of(case, device, cases), device, runs, mode)
    gc.collect()


def title(case: Case) -> str:
    return "{:,} splats at {} x {} px".format(*case)


def works(backends: Sequence[str], cases: Sequence[Case], device: str, runs: int, modes: Sequence[Mode]) -> list[Work]:
    """Every backend on every case in every mode, each scene once after the other."""
    cases = tuple(cases)
    return [
        Work("speed", name, f"{title(case)} as {mode}", EXPECTED_S, measure_one, (name, mode, case, device, runs, cases))
        for case in cases for mode in modes for name in with_itself(backends)
    ]  # fmt: skip


def measure(backend: Backend, scene: Scene, device: str, runs: int, mode: Mode = "classic") -> Speed:
    """Raw parameters -> image, without a graph; and -> image -> gradients of all of them."""
    clock, (height, width) = Clock(device), scene.camera.size
    job = passes(backend, scene, mode)
    job.forward_backward()  # compiles what is to be compiled
    peak = clock.peak_mib(job.forward_backward)
    forward_ms, both_ms = clock.milliseconds(job.forward, runs), clock.milliseconds(job.forward_backward, runs)
    parameters, pixels = scene.parameter_bytes, 4 * width * height
    # The least that has to move: parameters are read, image and alpha written; on the way back both are read again, gradients written.
    least = (parameters + 4 * pixels, 3 * parameters + 2 * 4 * pixels)
    return Speed(backend.name, mode, len(scene.raw["means"]), width, height, forward_ms, both_ms, peak, *least)


def passes(backend: Backend, scene: Scene, mode: Mode) -> Passes:
    """A backend on a scene in a mode."""
    return Passes(scene.raw, scene.weights, lambda gaussians: backend.render(gaussians, scene.camera, effects_in(mode, gaussians)).image)
