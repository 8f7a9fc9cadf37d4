"""Train the checkpoint that `mipmap-plugin demo` embeds: the ray-traced demo world, seen at one scale, with our own loop.

    python examples/train_demo_scene.py demo_base --size 160

writes a 3DGS model folder. It needs no data: the truth is ray-traced. It takes about ten minutes on two cores.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import no_validation
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.demo.world import cameras, render_world, surface_points
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.atomic import refuse_output
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes.cameras_json import write_cameras
from mipmap_plugin.splatting.harmonics import C0

WHITE = (1.0, 1.0, 1.0)
DEGREE = 2
TRAINED = TrainedScale(background=WHITE)
RATES = LearningRates(means=0.045, scales=0.005, quats=0.001, opacities=0.05, sh0=0.0025, shN=0.0025 / 20)


def first_guess(count: int) -> VanillaModel:
    """One round splat on each of `count` surface points, as wide as its neighbors are far."""
    points, colors = surface_points(count, torch.Generator().manual_seed(0))
    spacing = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].mean(1, keepdim=True)
    sh = torch.zeros(count, (DEGREE + 1) ** 2, 3)
    sh[:, 0] = (colors - 0.5) / C0
    unturned = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    round_splats = Gaussians(points, unturned, spacing.expand(count, 3), torch.full((count,), 0.3), sh)
    return VanillaModel.from_gaussians(round_splats, TRAINED)


def train(model: VanillaModel, views: list[Camera], truth: dict[Camera, Tensor], config: AdaptConfig) -> VanillaModel:
    """`config.steps` steps towards the true images, with whatever densification it asks for."""
    student = model.copy()
    effects = Effects(DEGREE, background=WHITE)
    backend, _ = choose_backend("auto", Needs.of(student.gaussians(), effects, gradients=True))

    def render(gaussians: Gaussians, camera: Camera) -> Tensor:
        return backend.render(gaussians, camera, effects).image

    # The loop zooms each view by the scale; at scale 1 that is a copy, so truth is looked up by the view itself.
    task = Task(views, 1.0, truth.__getitem__, [render], True, no_validation(truth.__getitem__, render))
    adapt(Run.start(student, task, config), task, config, on_interrupt=lambda run: None)
    return student


def best_rows(model: VanillaModel, count: int) -> VanillaModel:
    """The `count` most opaque splats."""
    keep = torch.zeros(len(model), dtype=torch.bool)
    keep[model.row_opacities().topk(min(count, len(model))).indices] = True
    return model.keep_rows(keep)


def main(
    output: tyro.conf.Positional[Path], size: int = 160, views: int = 105, points: int = 9_000, splats: int = 12_000, steps: int = 5_000
) -> None:
    """Ray-trace, train, prune to `splats`, train on, save.

    Args:
        output: The model folder to write.
        size: Pixels along each side of the training images.
        views: How many of them.
        points: Splats to start from.
        splats: Splats to end with; 12,000 of SH degree 2 fill 2 MB.
        steps: Optimizer steps in all; densification ends after a third of them.
    """
    if min(size, splats, steps) < 1 or views < 7 or points < 4:
        raise SettingsError("size, splats and steps have to be 1 or more, views 7, and points 4")
    refuse_output(output, overwrite=False)  # before the minutes that it takes
    # One test view to seven for training: with `eval`, readers of cameras.json take the first eighth for testing.
    train_views, test_views = cameras(size, views, "train"), cameras(size, views // 7, "test")
    truth = {view: render_world(view, samples=16) for view in tqdm(train_views, desc="ray-tracing", disable=None)}
    growing = AdaptConfig(steps=steps // 3, rates=RATES, densify_gradient=6e-5, prune_every=250, patience=None)
    settling = AdaptConfig(steps=steps - steps // 3, rates=RATES, decay=0.03, prune_every=500, patience=None, seed=1)
    model = train(first_guess(points), train_views, truth, growing)
    print(f"{len(model):,} splats after densification")
    model = train(best_rows(model, splats), train_views, truth, settling)
    saved = model.save(output, provenance={"made by": "examples/train_demo_scene.py", "size": size, "views": views, "steps": steps})
    write_cameras(saved.parents[2] / "cameras.json", [*test_views, *train_views])
    print(f"{saved}: {len(model):,} splats, {quality(model, test_views[::4]):.2f} dB on views it was not trained on")


def quality(model: VanillaModel, views: list[Camera]) -> float:
    """Mean PSNR in dB against the ray-traced truth."""
    effects = Effects(DEGREE, background=WHITE)
    backend, _ = choose_backend("auto", Needs.of(model.gaussians(), effects, gradients=False))
    with torch.no_grad():
        return sum(psnr(backend.render(model.gaussians(), view, effects).image, render_world(view, samples=16)) for view in views) / len(views)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except MipmapPluginError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
