"""Checkpoints of Mip-Splatting, GOF and Analytic-Splatting as their projects leave them, from seeded numbers."""

from pathlib import Path

import numpy as np
import ply_files

from mipmap_plugin.camera import Camera
from mipmap_plugin.models.columns import to_columns
from mipmap_plugin.models.mip import filter_3d_of
from mipmap_plugin.models.vanilla import VanillaModel

MIP = "kernel_size=0.1, ray_jitter=False, resample_gt_image=False, load_allres=False, sample_more_highres=False"
OPTIONS = {"mip": MIP, "gof": "kernel_size=0.0, use_decoupled_appearance=False", "analytic": "load_allres=False, sample_more_highres=False"}


def splats(count: int = 40, bands: int = 3) -> dict[str, np.ndarray]:
    """Raw columns of a ball of small splats around the origin, the 3D filter of each last."""
    random = np.random.default_rng(3)
    columns = ply_files.splat_columns(count, bands)
    for name in ("scale_0", "scale_1", "scale_2"):
        columns[name] = random.uniform(-5, -2, count).astype(np.float32)
    for name in ("x", "y", "z"):
        columns[name] = (0.5 * columns[name]).astype(np.float32)
    return {**columns, "filter_3D": random.uniform(0.01, 0.1, count).astype(np.float32)}


def columns_of(model: VanillaModel, views: list[Camera]) -> dict[str, np.ndarray]:
    """Raw columns of a model's splats, with the 3D filter that training on `views` gives them."""
    means = model.parameters()["means"]
    return {**to_columns(model.parameters()), "filter_3D": filter_3d_of(means, views).float().numpy()}


def folder(path: Path, family: str = "mip", columns: dict[str, np.ndarray] | None = None) -> Path:
    """A model folder as the family's project leaves it."""
    ply = path / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    ply.parent.mkdir(parents=True)
    ply_files.write(ply, splats() if columns is None else columns)
    (path / "cfg_args").write_text(f"Namespace(sh_degree=1, resolution=1, white_background=False, {OPTIONS[family]})")
    return path
