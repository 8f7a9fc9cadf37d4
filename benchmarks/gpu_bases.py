"""A base trained by gsplat from photographs, at the size that the zoom protocols begin with: a 3DGS model folder.

    python benchmarks/gpu_bases.py SCENE --width 400 --steps 7000 --mode classic --output lego_400

SCENE is what `mipmap_plugin.load_scene` reads; views of its test split are not trained on. Rates, losses and refinement are those of 3DGS
(arXiv:2308.04079) as gsplat's own trainer has them, which in 1.5.3 never resets opacities; `mip` is Mip-Splatting (arXiv:2311.16493): its 3D filter,
and the antialiased one of 0.1 px². What cannot be trained ends with a sentence and exit code 2.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from gpu_gsplat import lenses
from torch import Tensor

from mipmap_plugin import Camera, load_scene
from mipmap_plugin.adaptation.target.structure import similarity
from mipmap_plugin.backends.gsplat import missing
from mipmap_plugin.errors import BackendUnavailable, MipmapPluginError, OutputExists, SceneError, SettingsError
from mipmap_plugin.formats.atomic import refuse_unwritable
from mipmap_plugin.formats.cfg_args import format_cfg_args
from mipmap_plugin.formats.images import pillow_bicubic
from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.models.base import SplatModel, TrainedScale
from mipmap_plugin.models.mip import MipModel, filter_3d_of, smooth_3d
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.progress import counted, note
from mipmap_plugin.scenes import Scene
from mipmap_plugin.scenes.cameras_json import read_cameras, write_cameras

Mode = Literal["classic", "antialiased", "mip"]
FILTERS: dict[Mode, tuple[str, float]] = {"classic": ("classic", 0.3), "antialiased": ("antialiased", 0.3), "mip": ("mip", 0.1)}  # variance in px²

# Of 3DGS: learning rates per step; that of means is in units of the scene's size and ends at a hundredth.
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
MEANS_END, EPSILON, STRUCTURE = 0.01, 1e-15, 0.2
FIRST_OPACITY, BAND_EVERY, DEGREE = 0.1, 1000, 3
SIZE_MARGIN = 1.1  # the scene's size is the distance of the farthest camera from their mean, times this

# Where no points of structure from motion are given: as 3DGS begins on NeRF-Synthetic.
RANDOM_POINTS, RANDOM_WITHIN = 100_000, 1.3

# Mip-Splatting finds its filters again after so many steps.
FILTER_EVERY = 100

# Of a point, whose mean square distance is the square of its splat's size; and the points whose distances to all others are found at once.
NEIGHBORS, CHUNK = 3, 4096

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
DEVICE = "cuda"  # the only one that gsplat serves


@dataclass(frozen=True)
class Photographs:
    """The training views of a scene at one size, on the device."""

    cameras: Sequence[Camera]
    bytes: Tensor  # [V, H, W, 3], uint8

    @classmethod
    def of(cls, scene: Scene, width: int, background: Sequence[float], device: str) -> Photographs:
        """Shrunk as by protocol P3. Raises SceneError for a scene that cannot be trained on."""
        own = [camera for camera in scene.split("train") if camera in scene.images]
        cameras = [at_width(camera, width) for camera in own]
        if len({tuple(camera.center.tolist()) for camera in cameras}) < 2:
            raise SceneError(f"{scene.source} has {len(own)} photographs to train on; training needs some that were taken from different places")
        if len(heights := sorted({camera.height for camera in cameras})) > 1:
            raise SceneError(f"{scene.source}: its photographs, {width} px wide, are {heights[0]} to {heights[-1]} px high; give some of one shape")
        images = [pillow_bicubic(scene.image(camera, background), small.size) for camera, small in zip(own, cameras, strict=True)]
        return cls(cameras, (torch.stack(images) * 255).round().byte().to(device))

    def shuffled(self, steps: int) -> Iterator[tuple[int, Camera, Tensor]]:
        """A step's number, camera and photograph [H, W, 3], 0..1, each view once before any comes again."""
        rng, count = torch.Generator().manual_seed(0), len(self.cameras)
        order = torch.cat([torch.randperm(count, generator=rng) for _ in range(-(-steps // count))])[:steps].tolist()
        for step, view in enumerate(order):
            yield step, self.cameras[view], self.bytes[view].float() / 255

    @property
    def extent(self) -> float:
        """The scene's size, world units."""
        centers = torch.stack([camera.center for camera in self.cameras])
        return SIZE_MARGIN * float((centers - centers.mean(0)).norm(dim=1).max())


def at_width(camera: Camera, width: int) -> Camera:
    """The same view, `width` px wide."""
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))


class Training:
    """Splats, their optimizers and gsplat's strategy of refinement."""

    def __init__(self, photographs: Photographs, points: Tensor | None, mode: Mode, steps: int, background: Sequence[float]) -> None:
        from gsplat import DefaultStrategy

        device, extent = photographs.bytes.device, photographs.extent
        self.photographs, self.mode, self.steps = photographs, mode, steps
        self.background = torch.tensor([background], dtype=torch.float32, device=device)
        self.splats = {name: torch.nn.Parameter(tensor) for name, tensor in first_splats(points, device).items()}
        rates = RATES | {"means": RATES["means"] * extent}
        self.optimizers = {name: torch.optim.Adam([self.splats[name]], rate, eps=EPSILON, fused=True) for name, rate in rates.items()}
        self.decay = torch.optim.lr_scheduler.ExponentialLR(self.optimizers["means"], MEANS_END ** (1 / steps))
        self.strategy = DefaultStrategy()
        self.state = self.strategy.initialize_state(scene_scale=extent)
        self.filter_3d: Tensor | None = None

    def run(self) -> None:
        """All steps."""
        for step, camera, photograph in counted(self.photographs.shuffled(self.steps), self.steps, "training", "step"):
            self._find_filters(step)
            image, info = self.image(camera, min(step // BAND_EVERY, DEGREE))
            self.strategy.step_pre_backward(self.splats, self.optimizers, self.state, step, info)
            loss = (1 - STRUCTURE) * (image - photograph).abs().mean() + STRUCTURE * (1 - similarity(image, photograph)[0].mean())
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            self.decay.step()
            self.strategy.step_post_backward(self.splats, self.optimizers, self.state, step, info)

    def image(self, camera: Camera, degree: int) -> tuple[Tensor, dict[str, Any]]:
        """The image [H, W, 3] of the splats with so many SH bands, and what gsplat says of it."""
        from gsplat import rasterization

        raw, (name, eps2d) = self.splats, FILTERS[self.mode]
        scales, opacities = raw["scales"].exp(), raw["opacities"].sigmoid()
        if self.filter_3d is not None:
            scales, opacities = smooth_3d(scales, opacities, self.filter_3d)
        images, _, info = rasterization(
            raw["means"], raw["quats"], scales, opacities, torch.cat([raw["sh0"], raw["shN"]], 1), *lenses((camera,), raw["means"].device),
            camera.width, camera.height, eps2d=eps2d, sh_degree=degree, packed=False, backgrounds=self.background,
            rasterize_mode="classic" if name == "classic" else "antialiased",
        )  # fmt: skip
        return images[0], info

    def _find_filters(self, step: int) -> None:
        """Mip-Splatting's 3D filters, every so often and whenever there are other splats."""
        means = self.splats["means"].detach()
        if self.mode == "mip" and (step % FILTER_EVERY == 0 or self.filter_3d is None or len(self.filter_3d) != len(means)):
            self.filter_3d = filter_3d_of(means, self.photographs.cameras)

    def model(self, trained: TrainedScale) -> SplatModel:
        """What is to be saved."""
        screen_filter, eps2d = FILTERS[self.mode]
        raw = {name: tensor.detach().cpu() for name, tensor in self.splats.items()}
        splats = VanillaModel(raw, replace(trained, screen_filter=screen_filter, eps2d=eps2d))
        if self.mode != "mip":
            return splats
        return MipModel("mip", splats, filter_3d_of(splats.parameters()["means"].detach(), self.photographs.cameras))


def first_splats(points: Tensor | None, device: torch.device) -> dict[str, Tensor]:
    """Gray splats as large as the distance to their neighbors, at the points [P, 3] of structure from motion, or at random if these are too few."""
    if points is None or len(points) <= NEIGHBORS:
        note(f"the scene has no points to begin at: {RANDOM_POINTS:,} lie at random within {RANDOM_WITHIN} of its origin, as suits NeRF-Synthetic")
        points = (2 * torch.rand(RANDOM_POINTS, 3, generator=torch.Generator().manual_seed(0)) - 1) * RANDOM_WITHIN
    means, count = points.float().to(device), len(points)
    exact = "donot_use_mm_for_euclid_dist"  # products lose the distances of points that are far from the origin
    nearest = [torch.cdist(some, means, compute_mode=exact).topk(NEIGHBORS + 1, largest=False)[0][:, 1:] for some in means.split(CHUNK)]
    lengths = torch.cat(nearest).square().mean(1).sqrt().clamp_min(1e-6)
    empty = {"sh0": torch.zeros(count, 1, 3, device=device), "shN": torch.zeros(count, (DEGREE + 1) ** 2 - 1, 3, device=device)}
    turns = torch.tensor([1.0, 0, 0, 0], device=device).repeat(count, 1)
    opacities = torch.full((count,), FIRST_OPACITY, device=device).logit()
    return {"means": means, "scales": lengths.log()[:, None].repeat(1, 3), "quats": turns, "opacities": opacities} | empty


def main(
    scene: tyro.conf.Positional[Path],
    width: int,
    output: Path,
    steps: int = 7000,
    mode: Mode = "classic",
    background: tuple[float, float, float] = WHITE,
) -> None:
    """Train and save.

    Args:
        scene: A folder with photographs and their cameras.
        width: Of the images that are trained on, px.
        output: The model folder, which must not be there yet.
        steps: Of training; 3DGS takes 7000 or 30000.
        mode: The filter that is trained with.
        background: White or black (0 0 0), behind the splats and transparent photographs.
    """
    try:
        check(width, steps, output, background)
        train(scene, width, output, steps, mode, background)
    except MipmapPluginError as error:
        print(f"benchmarks/gpu_bases.py: {error}", file=sys.stderr)
        raise SystemExit(2) from error


def check(width: int, steps: int, output: Path, background: Sequence[float]) -> None:
    """Raise what a run would end with after a while."""
    if reasons := missing():
        raise BackendUnavailable("; ".join(reasons))
    if width < 1 or steps < 1:
        raise SettingsError(f"--width and --steps must be at least 1, got {width} and {steps}")
    if tuple(background) not in (WHITE, BLACK):
        raise SettingsError(f"--background must be 1 1 1 or 0 0 0, the two that cfg_args can say, got {' '.join(f'{part:g}' for part in background)}")
    if output.suffix.lower() == ".ply" or is_written(output):
        raise SettingsError(f"{output} is the name of a file; a base is a folder")
    if os.path.lexists(output):
        raise OutputExists(f"{output} exists already; remove it, or choose another path")
    refuse_unwritable(output)


def train(scene: Path, width: int, output: Path, steps: int, mode: Mode, background: tuple[float, float, float]) -> None:
    """Train a base and save it, with its cameras."""
    loaded = load_scene(scene)
    photographs = Photographs.of(loaded, width, background, DEVICE)
    training = Training(photographs, loaded.points, mode, steps, background)
    began = time.perf_counter()
    training.run()
    seconds = time.perf_counter() - began
    made = {"trainer": "gsplat", "steps": steps, "photographs": len(photographs.cameras)}
    training.model(TrainedScale(background=background, resolution=1)).save(output, provenance=made)
    save_cameras(output, loaded, width, background)
    first = photographs.cameras[0]
    print(f"{output}: {len(training.splats['means']):,} splats after {steps:,} steps in {seconds:.0f} s, {mode}, {first.width} x {first.height} px")


def save_cameras(folder: Path, scene: Scene, width: int, background: Sequence[float]) -> None:
    """The cameras of all splits, and options that say whether there are views for testing."""
    write_cameras(folder / "cameras.json", [at_width(camera, width) for camera in scene.cameras])
    tests = [camera.name for camera in scene.split("test")]
    options = {"sh_degree": DEGREE, "source_path": "", "model_path": "", "images": "images", "resolution": 1, "data_device": "cuda"}
    options |= {"eval": bool(tests), "white_background": tuple(background) == WHITE}
    if [camera.name for camera in read_cameras(folder / "cameras.json", options) if camera.split == "test"] != tests:
        warnings.warn(f"{folder}/cameras.json cannot say which views are for testing; judge by those of {scene.source}", stacklevel=2)
    (folder / "cfg_args").write_text(format_cfg_args(options), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
