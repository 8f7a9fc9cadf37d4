"""Checkpoints of gsplat and splatfacto, written from seeded weights exactly as the two projects write them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.gaussians import Gaussians

# What yaml.dump(vars(cfg)) of gsplat's simple_trainer leaves: a tag of a Python object, and lists, among plain lines.
CFG_YML = """antialiased: {antialiased}
app_opt: false
ckpt: null
data_dir: data/360_v2/garden
data_factor: 4
far_plane: 10000000000.0
max_steps: 30000
near_plane: 0.01
normalize_world_space: {normalized}
save_steps:
- 7000
- 30000
sh_degree: {degree}
strategy: !!python/object:gsplat.strategy.default.DefaultStrategy
  antialiased: null
  refine_every: 100
  near_plane: 7.0
"""

# The head and the interesting parts of a nerfstudio config.yml.
CONFIG_YML = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
experiment_name: poster
method_name: splatfacto
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager: !!python/object:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanagerConfig
    dataparser: !!python/object:nerfstudio.data.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig
      data: !!python/object/apply:pathlib.PosixPath
      - data
      - poster
      downscale_factor: {downscale}
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    background_color: random
    camera_optimizer: &id1 !!python/object:nerfstudio.cameras.camera_optimizers.CameraOptimizerConfig
      mode: 'off'
    rasterize_mode: {mode}
    sh_degree: 3
    use_bilateral_grid: {grid}
timestamp: 2024-05-01_120000
"""


def splats(count: int = 30, bands: int = 3, seed: int = 0) -> dict[str, torch.Tensor]:
    """Raw parameters by gsplat's names, float32; thin and bright enough to be adapted."""
    rng = torch.Generator().manual_seed(seed)
    return {
        "means": 0.5 * torch.randn(count, 3, generator=rng),
        "scales": (0.015 + 0.15 * torch.rand(count, 3, generator=rng) ** 3).log(),
        "quats": torch.randn(count, 4, generator=rng),
        "opacities": torch.randn(count, generator=rng) + 0.5,
        "sh0": torch.randn(count, 1, 3, generator=rng),
        "shN": 0.2 * torch.randn(count, bands, 3, generator=rng),
    }


def gsplat_folder(folder: Path, raw: dict[str, torch.Tensor], ranks: int = 1, step: int = 6999, antialiased="false", normalized="true") -> Path:
    """A result folder of gsplat 1.2 and later; the splats are shared out to the ranks in turn."""
    (folder / "ckpts").mkdir(parents=True)
    (folder / "cfg.yml").write_text(CFG_YML.format(antialiased=antialiased, normalized=normalized, degree=1))
    for rank, rows in enumerate(torch.arange(len(raw["means"])).chunk(ranks)):
        state = {name: torch.nn.Parameter(tensor[rows].clone()) for name, tensor in raw.items()}
        torch.save({"step": step, "splats": torch.nn.ParameterDict(state).state_dict()}, folder / f"ckpts/ckpt_{step}_rank{rank}.pt")
    return folder


def splatfacto_state(raw: dict[str, torch.Tensor], prefix: str = "_model.gauss_params.") -> dict[str, torch.Tensor]:
    names = {"sh0": "features_dc", "shN": "features_rest"}
    shaped = {**raw, "sh0": raw["sh0"][:, 0], "opacities": raw["opacities"][:, None]}
    return {prefix + names.get(name, name): tensor.clone() for name, tensor in shaped.items()}


def splatfacto_content(pipeline: dict[str, torch.Tensor], step: int = 29_999) -> dict:
    """What nerfstudio's Trainer.save_checkpoint hands to torch.save, with its NumPy scalars."""
    count = next(len(tensor) for name, tensor in pipeline.items() if name.endswith("means"))
    moments = {"step": torch.tensor(5.0), "exp_avg": torch.ones(count, 3), "exp_avg_sq": torch.ones(count, 3)}
    optimizer = {"state": {0: moments}, "param_groups": [{"lr": np.float64(1.6e-6), "params": [0]}]}
    schedulers = {"means": {"base_lrs": [1.6e-4], "last_epoch": 7, "_last_lr": [np.float64(1.6e-6)], "lr_lambdas": [None]}}
    return {"step": step, "pipeline": pipeline, "optimizers": {"means": optimizer}, "schedulers": schedulers, "scalers": {"scale": 1.0}}


def splatfacto_folder(
    folder: Path, raw: dict[str, torch.Tensor], mode="classic", downscale="null", grid="false", prefix="_model.gauss_params."
) -> Path:
    """The folder of a run, without dataparser_transforms.json."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "config.yml").write_text(CONFIG_YML.format(mode=mode, downscale=downscale, grid=grid))
    pipeline = {"_model.device_indicator_param": torch.zeros(0), **splatfacto_state(raw, prefix), "_model.lpips.net.lin0.weight": torch.ones(2)}
    torch.save(splatfacto_content(pipeline), folder / "nerfstudio_models/step-000029999.ckpt")
    return folder


class Hostile:
    """What runs code where it is unpickled."""

    def __reduce__(self):
        return print, ("executed",)


def equal(model, raw: dict[str, torch.Tensor]) -> bool:
    """Whether a model has these raw parameters, bit by bit."""
    return all(torch.equal(model.parameters()[name], tensor) for name, tensor in raw.items())


def activated(raw: dict[str, torch.Tensor]) -> Gaussians:
    """In float64: exp, sigmoid, sh0 before shN; gsplat normalizes quaternions inside."""
    wide = {name: tensor.double() for name, tensor in raw.items()}
    sh = torch.cat([wide["sh0"], wide["shN"]], 1)
    return Gaussians(wide["means"], wide["quats"], wide["scales"].exp(), wide["opacities"].sigmoid(), sh)


def aim(base, camera, scale: float) -> Tensor:
    """What a zoomed view should show: the base's render at its own scale, resized."""
    image, size = base.render(camera).image, camera.zoomed(scale).size
    return resize(image, size, "pil-bicubic") if scale < 1 else UPSAMPLERS.get("bicubic")(image, size)


def normalized_by_numpy(cameras, points):
    """gsplat's own steps, in NumPy: similarity from the cameras, then principal axes of the points."""
    c2w = np.stack([np.linalg.inv(camera.viewmat.numpy()) for camera in cameras])
    t, R = c2w[:, :3, 3], c2w[:, :3, :3]
    up = -R[:, :, 1].mean(0)
    up /= np.linalg.norm(up)
    target = np.array([0.0, -1.0, 0.0])
    c, v = target @ up, np.cross(up, target)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    align = np.eye(3) + skew + skew @ skew / (1 + c)
    R, t = align @ R, t @ align.T
    forward = R[:, :, 2]
    nearest = t + (forward * -t).sum(-1)[:, None] * forward
    shift = -np.median(nearest, axis=0)
    scale = 1 / np.median(np.linalg.norm(t + shift, axis=-1))
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = align * scale, shift * scale
    moved = points @ first[:3, :3].T + first[:3, 3]
    centroid = np.median(moved, axis=0)
    values, vectors = np.linalg.eigh(np.cov(moved - centroid, rowvar=False))
    vectors = vectors[:, values.argsort()[::-1]]
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1
    second = np.eye(4)
    second[:3, :3], second[:3, 3] = vectors.T, -vectors.T @ centroid
    return second @ first


def live_model(raw: dict[str, Tensor], **more) -> SimpleNamespace:
    """An object with the tensors of INRIA's GaussianModel, and `more` attributes."""
    named = {"_xyz": "means", "_scaling": "scales", "_rotation": "quats", "_features_dc": "sh0", "_features_rest": "shN"}
    return SimpleNamespace(**{name: raw[own] for name, own in named.items()}, _opacity=raw["opacities"][:, None], **more)
