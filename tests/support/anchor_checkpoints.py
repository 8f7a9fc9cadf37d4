"""Checkpoints of Scaffold-GS and Octree-GS in the originals' formats, from seeded numbers, written without the package's writers."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import ply_files
import torch
from torch import nn

FILES = {name: f"{name}.pt" for name in ("opacity_mlp", "cov_mlp", "color_mlp", "feature_bank_mlp")}
VOXEL, STANDARD = 0.1, 6.0  # world units: Octree-GS's two constants


@dataclass(frozen=True)
class Layout:
    """What a checkpoint has of all that the formats allow."""

    family: str = "scaffold"
    distance: tuple[str, ...] = ()  # networks that take the distance
    level: bool = False
    bank: bool = False
    appearance: tuple[int, int] | None = None  # views, size
    united: bool = False
    to_level: str = "round"
    features: int = 8
    splats: int = 3

    def inputs(self, name: str) -> int:
        """The width of a network's input."""
        if name == "feature_bank_mlp":
            return 4 if self.family == "scaffold" else 3 + self.level
        appearance = self.appearance[1] if self.appearance and name == "color_mlp" else 0
        return self.features + 3 + (name in self.distance) + self.level + appearance


def weights(layout: Layout, seed: int = 0) -> dict[str, dict[str, np.ndarray]]:
    """By network and by name in its state dict, f4."""
    random = np.random.default_rng(seed)
    outputs = {"opacity_mlp": layout.splats, "cov_mlp": 7 * layout.splats, "color_mlp": 3 * layout.splats}
    outputs |= {"feature_bank_mlp": 3} if layout.bank else {}
    states = {}
    for name, count in outputs.items():
        width, hidden = layout.inputs(name), layout.features
        shapes = {"0.weight": (hidden, width), "0.bias": (hidden,), "2.weight": (count, hidden), "2.bias": (count,)}
        states[name] = {key: (random.normal(size=shape) / shape[-1] ** 0.5).astype(np.float32) for key, shape in shapes.items()}
    if layout.appearance:
        states["appearance"] = {"embedding.weight": random.normal(size=layout.appearance).astype(np.float32)}
    return states


def columns(layout: Layout, count: int = 40, seed: int = 0, **changed: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of the PLY in the original's order, f4. Some anchors' quaternions are turned, though the originals never turn them."""
    random = np.random.default_rng(seed)
    normal = lambda: random.normal(size=count)  # noqa: E731
    values = {name: 0.5 * normal() for name in "xyz"}
    if layout.family == "octree":
        values |= {"level": random.integers(0, 4, count).astype(float), "extra_level": 0.3 * normal(), "info": np.zeros(count)}
        values["level"][:4], values["info"][:2] = [0, 1, 2, 3], [VOXEL, STANDARD]
        smaller = np.log(2) * values["level"]
    else:
        values |= {name: np.zeros(count) for name in ("nx", "ny", "nz")}
        smaller = 0.0
    values |= {f"f_offset_{i}": 0.5 * normal() for i in range(3 * layout.splats)}
    values |= {f"f_anchor_feat_{i}": normal() for i in range(layout.features)}
    values |= {"opacity": np.full(count, -2.1972246)}
    values |= {f"scale_{i}": np.log(0.1 if i < 3 else 0.08) - smaller + 0.5 * normal() for i in range(6)}
    values |= {f"rot_{i}": (i == 0) + 0.3 * normal() for i in range(4)}
    return {name: column.astype(np.float32) for name, column in (values | changed).items()}


def write(folder: Path, layout: Layout = Layout(), iteration: int = 30_000, cfg: bool = True, **options) -> Path:
    """A model folder; return its PLY. `options`: of `columns`."""
    place = folder / "point_cloud" / f"iteration_{iteration}"
    place.mkdir(parents=True)
    if cfg:
        (folder / "cfg_args").write_text(cfg_args(layout))
    write_networks(place, layout, weights(layout))
    return ply_files.write(place / "point_cloud.ply", columns(layout, **options))


def cfg_args(layout: Layout) -> str:
    octree = f", fork=2, add_level={layout.level}, dist2level={layout.to_level!r}" if layout.family == "octree" else ", sh_degree=3, lod=0"
    return f"Namespace(feat_dim={layout.features}, n_offsets={layout.splats}, white_background=False, resolution=1, eval=False{octree})"


def write_networks(place: Path, layout: Layout, states: dict[str, dict[str, np.ndarray]]) -> None:
    torch_states = {name: {key: torch.from_numpy(held) for key, held in state.items()} for name, state in states.items()}
    if layout.united:
        torch.save(torch_states, place / "checkpoints.pth")
        return
    last = {"opacity_mlp": [nn.Tanh()], "color_mlp": [nn.Sigmoid()], "feature_bank_mlp": [nn.Softmax(dim=1)], "cov_mlp": []}
    for name, file in FILES.items():
        if name in states:
            width, count = layout.inputs(name), len(states[name]["2.bias"])
            network = nn.Sequential(nn.Linear(width, layout.features), nn.ReLU(True), nn.Linear(layout.features, count), *last[name])
            trace(network, torch_states[name], torch.rand(1, width), place / file)
    if "appearance" in states:
        trace(Embedding(*layout.appearance), torch_states["appearance"], torch.zeros(1, dtype=torch.long), place / "embedding_appearance.pt")


class Embedding(nn.Module):
    """As the originals' scene/embedding.py names its parts."""

    def __init__(self, count: int, size: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(count, size)

    def forward(self, index):
        return self.embedding(index)


def trace(network: nn.Module, state: dict[str, torch.Tensor], example: torch.Tensor, path: Path) -> None:
    network.load_state_dict(state)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.trace(network.eval(), example, check_trace=False).save(str(path))
