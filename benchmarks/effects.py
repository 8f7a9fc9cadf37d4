"""What each effect costs on a scene that calls for it, and what leaving it out saves on a scene that does not.

    python benchmarks/effects.py --output benchmarks/results/effects.md

Scene A of `scenes.py` (10,000 splats, 256 x 256 px), as each effect needs it; anchors and fields from the generators of the tests.
Each pair of calls is run in turn, so that a busy spell of the machine meets both alike; CPU time of one thread, medians.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from scenes import Name, make
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))  # its modules import one another by bare names

import anchor_checkpoints
import moving

from mipmap_plugin import Camera, Effects, Gaussians, load_model, wrap_model
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler
from mipmap_plugin.backends import choose_backend, geometry, supersample
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.exposure import exposed
from mipmap_plugin.models.mip import MipModel
from mipmap_plugin.models.moving.deformable import DeformNetwork
from mipmap_plugin.models.moving.hexplane import HexPlane
from mipmap_plugin.models.moving.model import MovingModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.projection import covariances_of

ANCHORS = 1_000  # of ten splats each

Draw = Callable[[], Tensor]  # -> an image, or whatever else is differentiated


@dataclass(frozen=True)
class Pair:
    """The same work with an effect and without it."""

    effect: str
    scene: str
    on: Draw
    off: Draw
    needed: bool  # by the scene: then the image is another one without it, else the very same
    backward: bool = True
    change: str = "another image"  # where it is needed


@dataclass(frozen=True)
class Cost:
    on_ms: float
    off_ms: float


class Bench:
    """A scene of `scenes.py`, drawn by one backend."""

    def __init__(self, backend: str, name: Name) -> None:
        scene = make(name)
        raw = {name: torch.from_numpy(array) for name, array in scene.raw.items()}
        named = {"means": raw["means"], "scales": raw["log_scales"], "quats": raw["quats"], "opacities": raw["logits"]}
        self.parameters = {**named, "sh0": raw["sh"][:, :1].clone(), "shN": raw["sh"][:, 1:].clone()}
        self.camera = replace(scene.camera, time=0.3)
        needs = Needs("cpu", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")
        self.backend, _ = choose_backend(backend, needs)

    def model(self, degree: int = 3, room: int = 3) -> VanillaModel:
        """The scene's splats with SH up to `degree`, and zeros up to degree `room`."""
        coefficients = self.parameters["shN"][:, : (room + 1) ** 2 - 1].clone()
        coefficients[:, (degree + 1) ** 2 - 1 :] = 0
        held = {**self.parameters, "shN": coefficients}
        return VanillaModel({name: tensor.clone().requires_grad_() for name, tensor in held.items()})

    def draw(self, gaussians: Callable[[Camera], Gaussians], effects: Effects = Effects(3)) -> Draw:  # noqa: B008
        return lambda: supersample.render(self.backend, gaussians(self.camera), self.camera, effects).image


def pairs(bench: Bench, folder: Path) -> Iterator[Pair]:
    """Every effect, where it is called for and, if it could be simulated there for nothing, where it is not."""
    full, plain = bench.model(), bench.model(0)
    yield Pair("view-dependent color", "degree 3", bench.draw(full.gaussians), bench.draw(full.gaussians, Effects(0)), True)
    unlit = bench.model(0)
    unlit.parameters()["shN"].requires_grad_(False)
    yield Pair("view-dependent color", "degree 0, room for 3", bench.draw(plain.gaussians), bench.draw(unlit.gaussians, Effects(0)), False)
    yield from _fields(bench)
    yield from _anchors(bench, folder)
    filtered = MipModel("mip", full, torch.full((len(full),), 0.005))
    yield Pair("3D filter", "Mip-Splatting", bench.draw(filtered.gaussians), bench.draw(full.gaussians), True)
    with_covariances = bench.draw(lambda camera: replace(splats := full.gaussians(camera), covariances=covariances_of(splats)))
    yield Pair("covariances", "given for the same splats", with_covariances, bench.draw(full.gaussians), False)
    classic = bench.draw(full.gaussians)
    yield Pair("compensation", "antialiased", bench.draw(full.gaussians, Effects(3, "antialiased")), classic, True)
    yield Pair("screen filter: analytic", "Analytic-Splatting", bench.draw(full.gaussians, Effects(3, "analytic", 0.0)), classic, True)
    for n in (2, 4):
        yield Pair(f"supersampling, {n} x {n}", "any", bench.draw(full.gaussians, Effects(3, supersampling=n)), classic, True)
    yield from _on_request(bench, full)
    yield from _adapting(bench)


def _on_request(bench: Bench, model: VanillaModel) -> Iterator[Pair]:
    """What a user requests besides the image, or of its colors."""
    image, camera = bench.draw(model.gaussians), bench.camera

    def with_(draw: Callable[..., Tensor]) -> Tensor:
        gaussians = model.gaussians(camera)
        rendered = bench.backend.render(gaussians, camera, Effects(3)).image
        return torch.cat([rendered, draw(bench.backend, gaussians, camera, Effects(3)).reshape(*camera.size, -1)], -1)

    for name, draw in {"depth": geometry.depth, "normals": geometry.normals}.items():
        yield Pair(name, "any", partial(with_, draw), image, True, change="the same, and more")
    matrix = torch.tensor([[1.1, 0.0, 0.0, 0.02], [0.0, 0.9, 0.1, 0.0], [0.0, 0.0, 1.2, -0.01]])
    yield Pair("exposure", "3DGS with train_test_exp", lambda: exposed(image(), matrix), image, True)


def _fields(bench: Bench) -> Iterator[Pair]:
    fields = {"Deformable-3D-Gaussians": DeformNetwork(moving.deform_state()), "4DGaussians": HexPlane(moving.hexplane_state(), {})}
    for name, field in fields.items():
        canonical = bench.model()
        moved = bench.draw(lambda camera, field=field, canonical=canonical: moving.moved_to(field, canonical, camera.time or 0.0))
        yield Pair("time", name, moved, bench.draw(canonical.gaussians), True)
    state = {name: torch.zeros_like(held) if name.startswith("gaussian_") else held for name, held in moving.deform_state().items()}
    canonical, unmoved = bench.model(), DeformNetwork(state)
    evaluated = bench.draw(lambda camera: moving.moved_to(unmoved, canonical, camera.time or 0.0))
    yield Pair("time", "a still scene of Deformable-3D-Gaussians", evaluated, bench.draw(MovingModel("", canonical, unmoved).gaussians), False)


def _anchors(bench: Bench, folder: Path) -> Iterator[Pair]:
    camera, behind = (replace(bench.camera, viewmat=_facing(side)) for side in (1.0, -1.0))

    def drawn(gaussians: Callable[[Camera], Gaussians]) -> Draw:
        return lambda: bench.backend.render(gaussians(camera), camera, Effects(0)).image

    models = []
    for appearance in (None, (50, 32)):
        layout = anchor_checkpoints.Layout(features=32, splats=10, appearance=appearance)
        anchor_checkpoints.write(folder / str(appearance), layout, count=ANCHORS)
        models.append(load_model(folder / str(appearance)).copy())
    plain, dressed = models
    scene = f"Scaffold-GS, {ANCHORS:,} anchors of 10"
    fixed = VanillaModel.from_gaussians(plain.gaussians(behind)).copy()
    yield Pair("view-dependent geometry", scene, drawn(plain.gaussians), drawn(fixed.gaussians), True)
    yield Pair("appearance embedding", f"{scene}, 32 numbers a view", drawn(dressed.gaussians), drawn(plain.gaussians), True)


def _facing(side: float) -> Tensor:
    """The origin from four units away, on the one side or the other."""
    viewmat = torch.diag(torch.tensor([side, 1.0, side, 1.0], dtype=torch.float64))
    viewmat[2, 3] = 4.0
    return viewmat


def _adapting(bench: Bench) -> Iterator[Pair]:
    """What adapting may do besides, with one image of the result. Without gradients: those of the steps are part of them."""
    wrapped = wrap_model(VanillaModel(bench.parameters, TrainedScale()), cameras=[bench.camera], backend=bench.backend.name)

    def steps(scale: float, count: int | None = None, **settings: object) -> Draw:
        chosen = {"views": "given", **({} if count is None else {"steps": count}), **settings}
        return lambda: wrapped.adapt(scale, **chosen).render(bench.camera.zoomed(scale)).image

    on = steps(1 / 4, 20, densify_gradient=1e9)  # kept and never used
    yield Pair("densification statistics", "adapting by 20 steps", on, steps(1 / 4, 20), False, backward=False)
    image = torch.rand(64, 64, 3)
    enlarge = find_upsampler("bicubic")
    yield Pair("upsampler: bicubic", "an image of 64 x 64 px at x4", lambda: enlarge(image, (256, 256)), lambda: image, True, backward=False)
    # The nearest scale at which there seems to be something to do.
    yield Pair("adapting at all", "scale 1", steps(1 + 1e-9), steps(1.0), False, backward=False)


def measure(pair: Pair, runs: int) -> tuple[Cost, Cost | None, float]:
    """Milliseconds forward, and forward with backward; and the largest difference of the two images."""
    on, off = pair.on().detach(), pair.off().detach()
    difference = float((on - off).abs().max()) if on.shape == off.shape else float("nan")

    def forward(draw: Draw) -> None:
        with torch.set_grad_enabled(not pair.backward):  # adapting needs its gradients
            draw()

    ahead = _in_turn([lambda: forward(pair.on), lambda: forward(pair.off)], runs)
    both = _in_turn([lambda: pair.on().sum().backward(), lambda: pair.off().sum().backward()], runs) if pair.backward else None
    return ahead, both, difference


def _in_turn(calls: list[Callable[[], None]], runs: int) -> Cost:
    rounds = [[_milliseconds(call) for call in calls] for _ in range(runs + 1)]
    return Cost(*map(statistics.median, zip(*rounds[1:], strict=True)))  # the first is for warming up


def _milliseconds(call: Callable[[], None]) -> float:
    began = time.process_time()
    call()
    return 1000 * (time.process_time() - began)


def row(pair: Pair, runs: int) -> list[str]:
    ahead, both, difference = measure(pair, runs)
    return [pair.effect, pair.scene, *_cells(ahead), *_cells(both), pair.change if pair.needed else f"{difference:.0e}"]


def _cells(cost: Cost | None) -> list[str]:
    """On, off, and their ratio."""
    if cost is None:
        return ["-"] * 3
    return [f"{cost.on_ms:.1f}", f"{cost.off_ms:.1f}", f"{cost.on_ms / cost.off_ms:.2f}" if cost.off_ms > 0.1 else "-"]


def main(output: Path = Path("benchmarks/results/effects.md"), backend: str = "auto", scene: Name = "A", runs: int = 7) -> None:
    """Measure every pair and write the table.

    Args:
        output: Markdown; replaced.
        backend: A backend's name.
        scene: A scene of scenes.py.
        runs: Of each call; the median counts.
    """
    torch.set_num_threads(1)
    bench = Bench(backend, scene)
    head = ["effect", "scene", "fwd on", "fwd off", "ratio", "fwd+bwd on", "fwd+bwd off", "ratio", "difference"]
    with tempfile.TemporaryDirectory() as folder:
        body = []
        for pair in pairs(bench, Path(folder) / "anchors"):
            body.append(row(pair, runs))
            print(" | ".join(body[-1]), flush=True)
    text = f"""# What effects cost, and what leaving them out saves

Made by `python benchmarks/effects.py`, backend `{bench.backend.name}`. CPU milliseconds of one thread, medians of {runs} runs, on and off in turn.
Scene {scene}: {len(bench.model()):,} splats at {bench.camera.width} x {bench.camera.height} px. The ratio is on over off.

Where the scene calls for an effect, or a person asks for it, leaving it out gives another image, or the same without depth or normals
beside it, and the ratio is what the effect costs. Where it is not called for, the image is the same but for the difference given, and the
ratio is what is saved. (The 2e-03 is one pixel, on which one splat lies at the alpha threshold of 1/255. At scale 1, "on" optimizes a base
that is right as it is.)

{markdown(head, body)}
"""
    with new_file(output, overwrite=True) as temporary:
        temporary.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
