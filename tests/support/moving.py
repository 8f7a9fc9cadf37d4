"""Moving scenes for the tests: model folders as the two projects write them, from seeded weights, and what adapting them gains."""

from dataclasses import replace
from pathlib import Path
from statistics import fmean

import tiny
import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.moving.model import Field
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Adapted, Wrapped

SPLATS = 60

DEFORMABLE_OPTIONS = "sh_degree={degree}, white_background=True, load2gpu_on_the_fly=False, is_blender=False, is_6dof=False"


def layers(sizes: dict[str, tuple[int, int]], seed: int, gain: float = 1.0) -> dict[str, Tensor]:
    """A weight and a bias for each layer (outputs, inputs) by name, float32."""
    rng = torch.Generator().manual_seed(seed)
    state = {}
    for name, (outputs, inputs) in sizes.items():
        state[f"{name}.weight"] = gain * torch.randn(outputs, inputs, generator=rng) / inputs**0.5
        state[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=rng)
    return state


def moved_to(field: Field, canonical: VanillaModel, time: float) -> Gaussians:
    """The splats at `time`, by a new evaluation of the field."""
    return field.moved(canonical, field.changes(canonical.parameters()["means"].detach(), time))


def deform_state(timenet: bool = False, six_dof: bool = False, width: int = 256, seed: int = 0) -> dict[str, Tensor]:
    """The weights of a DeformNetwork that moves a scene of unit size by about a tenth."""
    inputs = 63 + (30 if timenet else 21)
    sizes = {"timenet.0": (256, 13), "timenet.2": (30, 256)} if timenet else {}
    sizes |= {f"linear.{i}": (width, {0: inputs, 5: inputs + width}.get(i, width)) for i in range(8)}
    heads = {"branch_w": 3, "branch_v": 3} if six_dof else {"gaussian_warp": 3}
    heads |= {"gaussian_rotation": 4, "gaussian_scaling": 3}
    state = layers({**sizes, **{name: (size, width) for name, size in heads.items()}}, seed, 1.4)
    for name in heads:
        share = 0.01 if name == "gaussian_scaling" else 0.1
        state[f"{name}.weight"] *= share
        state[f"{name}.bias"] *= share
    return state


def write_deformable(folder: Path, state: dict[str, Tensor] | None = None, iteration: int = 40_000, degree: int = 1, count: int = SPLATS) -> Path:
    """A model folder of Deformable 3D Gaussians."""
    _write_splats(folder, iteration, DEFORMABLE_OPTIONS.format(degree=degree), degree, count)
    network = folder / f"deform/iteration_{iteration}/deform.pth"
    network.parent.mkdir(parents=True)
    torch.save(deform_state() if state is None else state, network)
    return folder


def hexplane_state(width: int = 32, channels: int = 8, scales: tuple[int, ...] = (1, 2), depth: int = 1, no_grid: bool = False, seed: int = 0):
    """The weights of a deform_network: every head, used or not, and what nobody uses."""
    n = "deformation_net."
    sizes = {"timenet.0": (64, 9), "timenet.2": (32, 64), n + "feature_out.0": (width, 4 if no_grid else channels * len(scales))}
    sizes |= {f"{n}feature_out.{2 * i}": (width, width) for i in range(1, depth)}
    for name, size in {"pos_deform": 3, "scales_deform": 3, "rotations_deform": 4, "opacity_deform": 1, "shs_deform": 48, "static_mlp": 1}.items():
        sizes |= {f"{n}{name}.1": (width, width), f"{n}{name}.3": (size, width)}
    state = layers(sizes, seed, 0.8)
    rng = torch.Generator().manual_seed(seed + 1)
    state[n + "grid.aabb"] = torch.tensor([[1.0, 1.1, 0.9], [-1.2, -1.0, -0.8]])
    for scale, factor in enumerate(scales):
        size = [8 * factor, 6 * factor, 7 * factor, 5]  # x, y, z, time
        for number, (a, b) in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
            state[f"{n}grid.grids.{scale}.{number}"] = 0.5 + 0.9 * torch.rand(1, channels, size[b], size[a], generator=rng)
    return {**state, "time_poc": 2.0 ** torch.arange(4), "pos_poc": 2.0 ** torch.arange(10)}


def write_hexplane(folder: Path, options: str = "", state: dict[str, Tensor] | None = None, degree: int = 3, count: int = SPLATS) -> Path:
    """A model folder of 4D Gaussians, with its bookkeeping by row."""
    kplanes = "kplanes_config={'grid_dimensions': 2, 'resolution': [8, 6, 7, 5]}, multires=[1, 2], net_width=32"
    _write_splats(folder, 14_000, f"sh_degree={degree}, white_background=True, {kplanes}{options and ', ' + options}", degree, count)
    place = folder / "point_cloud/iteration_14000"
    torch.save(hexplane_state() if state is None else state, place / "deformation.pth")
    torch.save(torch.ones(count, dtype=torch.bool), place / "deformation_table.pth")
    torch.save(torch.zeros(count, 3), place / "deformation_accum.pth")
    return folder


def without(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key: tensor for key, tensor in state.items() if key != name}


def at(time: float | None) -> Camera:
    return replace(tiny.cameras(1)[0], time=time)


def decibels(wrapped: Wrapped, adapted: Adapted, views: list[Camera]) -> tuple[float, float]:
    """Mean dB against the pseudo truth, at its size: of the unadapted base at the adapted model's scale, and of the adapted model."""
    report, zoom = adapted.report, [view.zoomed(adapted.report.scale) for view in views]
    truth = PseudoTruth(BaseImages(wrapped.model, adapted.backend, wrapped.effects()), report.scale, report.settings)
    targets = [truth(view) for view in views]

    def quality(images: list[Tensor]) -> float:
        return fmean(psnr(resize(image, target.shape[:2], "area"), target) for image, target in zip(images, targets, strict=True))

    return quality([wrapped.render(camera).image for camera in zoom]), quality([adapted.render(camera).image for camera in zoom])


def _write_splats(folder: Path, iteration: int, options: str, degree: int, count: int) -> None:
    ply = folder / f"point_cloud/iteration_{iteration}/point_cloud.ply"
    ply.parent.mkdir(parents=True)
    tiny.ply(ply, degree=degree, count=count)
    (folder / "cfg_args").write_text(f"Namespace({options})")
    write_cameras(folder / "cameras.json", tiny.cameras())
