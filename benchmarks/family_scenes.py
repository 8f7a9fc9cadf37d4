"""A small scene of each family: a checkpoint in its exact format, true images at every scale, and a base trained on those at x1.

The generators are those of the tests. What they write is taken for the world: it is drawn without any dilation, many times finer than
the pictures. The base starts from it with every number disturbed, and is trained on the pictures at x1 in the family's own
filter, so that it stands to the world as any checkpoint does: right at x1, and nowhere else.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))  # its modules import one another by bare names

import anchor_checkpoints
import mip_checkpoints
import moving
import tiny
import torch_checkpoints

from mipmap_plugin import Camera, Effects, load_model
from mipmap_plugin.adaptation.optimization.loop import adapt
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import no_validation
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import CARRIED, SplatModel
from mipmap_plugin.models.vanilla import VanillaModel

SIZE = (64, 48)  # px of a picture at x1
SPLATS, ANCHORS = 300, 100
TRAIN_VIEWS, HELD_OUT_VIEWS = 12, 6

# Samples a pixel of the finest pictures, each way; the thinnest splats are a third of a pixel of x4 wide.
FINEST, SAMPLES = 4, 4

# Standard deviation of what is added to the world's raw parameters; a pixel of x1 is 0.044 world units wide.
DISTURBANCE = {"means": 0.01, "offsets": 0.05}
USUAL_DISTURBANCE = 0.1

TRAINING = AdaptConfig(
    steps=1000, decay=0.1, prune_every=10_000,
    rates=LearningRates(means=0.07, scales=0.01, quats=0.005, sh0=0.01, shN=0.002, offsets=3e-3, networks=1e-3),
)  # fmt: skip


@dataclass(frozen=True)
class Family:
    """One row of the table."""

    name: str
    limit: str
    write: Callable[[Path], object]  # a checkpoint in the family's format into a new folder
    moves: bool = False


def _plain(count: int = SPLATS) -> VanillaModel:
    return tiny.model(count)


def _filtered(family: str) -> Callable[[Path], object]:
    return lambda folder: mip_checkpoints.folder(folder, family, mip_checkpoints.columns_of(_plain(), views(TRAIN_VIEWS, "train")))


def _anchors(family: str) -> Callable[[Path], object]:
    layout = anchor_checkpoints.Layout(family, features=16, splats=5, distance=("opacity_mlp",))
    changes = {"extra_level": np.full(ANCHORS, 2.0)} if family == "octree" else {}  # every level at x1, and coarser ones from afar
    return lambda folder: anchor_checkpoints.write(folder, layout, count=ANCHORS, **changes)


def _gsplat(antialiased: str) -> Callable[[Path], object]:
    return lambda folder: torch_checkpoints.gsplat_folder(folder, _plain().parameters(), antialiased=antialiased)


FAMILIES = {
    "3dgs": Family("3DGS, Pixel-GS, any tool with the same columns", "–", lambda folder: tiny.folder(folder, count=SPLATS)),
    "scaffold": Family("Scaffold-GS", "opacities cannot take part in the closed form", _anchors("scaffold")),
    "octree": Family("Octree-GS", "the same", _anchors("octree")),
    "deformable": Family(
        "Deformable-3D-Gaussians", "needs its folder; the field stays frozen", lambda folder: moving.write_deformable(folder, count=SPLATS), True
    ),
    "4dgs": Family("4DGaussians", "`empty_voxel` and `grid_pe` are refused", lambda folder: moving.write_hexplane(folder, count=SPLATS), True),
    "mip": Family("Mip-Splatting", "a file for its own viewer (`filter_3D` is 0 where shapes are new); `--viewer` for another", _filtered("mip")),
    "gof": Family("GOF", "drawn as EWA splats, an approximation", _filtered("gof")),
    "analytic": Family("Analytic-Splatting", "as Mip-Splatting", _filtered("analytic")),
    "gsplat": Family("gsplat `ckpt_*.pt`", "cameras from its COLMAP scene (`--cameras`)", _gsplat("false")),
    "gsplat-antialiased": Family("gsplat, `antialiased`", "written antialiased", _gsplat("true")),
    "splatfacto": Family(
        "splatfacto `.ckpt`", "training cannot go on from a pruned one",
        lambda folder: torch_checkpoints.splatfacto_folder(folder, _plain().parameters()),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """A base checkpoint, and what is true of it."""

    base: Path
    train: list[Camera]  # at x1, as the others
    held_out: list[Camera]
    pictures: Pictures


class Pictures:
    """True images of a world, rendered once per view at the finest scale and shrunk from there."""

    def __init__(self, world: SplatModel) -> None:
        self._world, self._finest = world, dict[Camera, Tensor]()

    def __call__(self, view: Camera, scale: float = 1.0) -> Tensor:
        """[h, w, 3] at `scale` times the size of `view`: the mean over each pixel, and below x1 that picture resized as photographs are."""
        seen = resize(self._draw(view), view.zoomed(max(1.0, scale)).size, "box")
        return resize(seen, view.zoomed(scale).size, "pil-bicubic").clamp(0, 1)

    @torch.no_grad()
    def _draw(self, view: Camera) -> Tensor:
        if view not in self._finest:
            fine = view.resized(view.width * FINEST * SAMPLES, view.height * FINEST * SAMPLES)
            seen = self._world.gaussians(view)  # for a family with levels: those of x1, whatever is drawn
            effects = Effects(sh_degree=seen.sh_degree, eps2d=0.0, background=self._world.trained.background or (0.0, 0.0, 0.0))
            image = choose_backend("auto", Needs.of(seen, effects, gradients=False))[0].render(seen, fine, effects).image
            self._finest[view] = resize(image, view.zoomed(FINEST).size, "box").clamp(0, 1)
        return self._finest[view]


def views(count: int, split: str, moves: bool = False) -> list[Camera]:
    """Views all around the ball, different ones for each split, and for a moving scene at times spread over 0..1."""
    width, height = SIZE
    seen = tiny.cameras(count, seed={"train": 1, "test": 9}[split], split=split, width=width, height=height)
    return [replace(view, time=number * 5 % count / (count - 1)) for number, view in enumerate(seen)] if moves else seen


def make(family: str, folder: Path) -> Scene:
    """Write the world and the base of a family into `folder`."""
    kind = FAMILIES[family]
    kind.write(folder / "world")
    pictures = Pictures(load_model(folder / "world"))
    train = views(TRAIN_VIEWS, "train", kind.moves)
    trained(load_model(folder / "world"), train, pictures).save(folder / "base", provenance={})
    return Scene(folder / "base", train, views(HELD_OUT_VIEWS, "test", kind.moves), pictures)


def trained(world: SplatModel, train: Sequence[Camera], pictures: Pictures) -> SplatModel:
    """A model of the pictures at x1."""
    student, filtered = world.copy(), world.trained
    disturb(student)
    with torch.no_grad():
        seen = student.gaussians(train[0])
    effects = Effects(seen.sh_degree, filtered.screen_filter, filtered.eps2d, filtered.background or (0.0, 0.0, 0.0))
    backend = choose_backend("auto", Needs.of(seen, effects, gradients=True))[0]

    def render(gaussians: Gaussians, camera: Camera) -> Tensor:
        return backend.render(gaussians, camera, effects).image

    task = Task(train, 1.0, pictures, [render], False, no_validation(pictures, render))
    run = Run.start(student, task, TRAINING)
    adapt(run, task, TRAINING, lambda run: sys.exit(130))
    return run.student


@torch.no_grad()
def disturb(model: SplatModel) -> None:
    rng = torch.Generator().manual_seed(0)
    rates = TRAINING.rates.model_dump() | {CARRIED: 0.0}
    for name, tensor in model.parameters().items():
        if rates[name]:
            tensor.add_(DISTURBANCE.get(name, USUAL_DISTURBANCE) * torch.randn(tensor.shape, generator=rng))
