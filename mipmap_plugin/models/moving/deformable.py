"""Deformable 3D Gaussians (Yang et al. 2024): canonical splats, and a network that translates, rotates and scales them over time."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import relu

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.state_dict import require, run_layer, shapes_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.moving.memory import Changes
from mipmap_plugin.models.moving.model import MovingModel, read_canonical
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import as_if_unit

# Frequencies of the embeddings (utils/time_utils.py): 3 + 2·3·10 = 63 numbers for a position, 1 + 2·10 = 21 for a time.
POSITION_FREQUENCIES, TIME_FREQUENCIES = 10, 10
POSITION_INPUTS, TIME_INPUTS = 3 + 6 * POSITION_FREQUENCIES, 1 + 2 * TIME_FREQUENCIES

# The published code adds this to each component of the screw axis, without need; the network was trained with it.
SCREW_OFFSET = 1e-5

# Multiplications in the time that a splat is drawn and differentiated: an evaluation takes 15 µs, and that 0.7.
PRODUCTS_A_DRAW = 24_000

# Radians: below it (angle - sin(angle)) / angle**3 is computed from its series, which is exact there to 1e-9.
SMALL_ANGLE = 0.5


class DeformNetwork:
    """A multilayer perceptron of position and time. Its variants, `timenet` (for synthetic scenes) and 6-DoF, are recognized by its weights."""

    changes_opacities = False

    def __init__(self, weights: Mapping[str, Tensor], where: str = "the network") -> None:
        """`weights`: the tensors of a `deform.pth` by name. Raises CheckpointError, whose message begins with `where`."""
        self._weights = {name: tensor.detach().float() for name, tensor in weights.items()}
        self.depth = sum(bool(re.fullmatch(r"linear\.\d+\.weight", name)) for name in weights)
        self.has_timenet = "timenet.0.weight" in weights
        self.is_6dof = "branch_w.weight" in weights
        if self.depth == 0:
            layers = ", ".join(sorted({name.partition(".")[0] for name in weights})[:4]) or "nothing"
            raise CheckpointError(f"{where}: it has no layers linear.0, linear.1, ..., but {layers}, so a changed copy of the project trained it")
        first_layers = ["linear.0.weight", *(["timenet.0.weight", "timenet.2.weight"] if self.has_timenet else [])]
        require(self._weights, dict.fromkeys(first_layers, (-1, -1)), where)
        self._refuse_other_inputs(where)
        require(self._weights, self._shapes(), where)
        self.is_still = not any(self._weights[f"{head}.{part}"].any() for head in self._heads for part in ("weight", "bias"))
        self.slopes = None  # the original has no gradient through the network
        products = sum(w.numel() for name, w in self._weights.items() if name.endswith("weight"))
        self.cost, self.work = f"{products:,} multiplications a splat and moment", products / PRODUCTS_A_DRAW

    def moved(self, canonical: VanillaModel, changes: Changes) -> Gaussians:
        """The splats as the original's kernel receives them: scales are changed additively and may become negative, quaternions are not
        normalized."""
        still, motion = canonical.gaussians(), changes["means"]
        means = move_along_screw(still.means, *motion.split(3, dim=1)) if self.is_6dof else still.means + motion
        quats, scales = still.quats + changes["quats"], still.scales + changes["scales"]
        return Gaussians(means, quats, scales.abs(), still.opacities, still.sh, kernel_covariances(quats, scales))

    @torch.no_grad()
    def changes(self, means: Tensor, time: float) -> Changes:
        """Translations [N, 3] of means, or screws [N, 6] with 6-DoF; changes of quaternions [N, 4] and of scales [N, 3]. As in the original,
        they have no gradient."""
        moment = embed(means.new_tensor([[time]]), self._frequencies_of_time)
        if self.has_timenet:
            moment = run_layer(self._weights, "timenet.2", relu(run_layer(self._weights, "timenet.0", moment)))
        hidden = self._hidden(means, moment)
        *motion, turn, growth = (run_layer(self._weights, head, hidden) for head in self._heads)
        return {"means": torch.cat(motion, dim=1), "quats": turn, "scales": growth}

    def to(self, device: torch.device | str) -> DeformNetwork:
        """The same network on another device."""
        return DeformNetwork({name: tensor.to(device) for name, tensor in self._weights.items()})

    @property
    def _frequencies_of_time(self) -> int:
        return (self._weights["timenet.0.weight"].shape[1] - 1) // 2 if self.has_timenet else TIME_FREQUENCIES

    def _hidden(self, means: Tensor, moment: Tensor) -> Tensor:
        inputs = torch.cat([embed(means, POSITION_FREQUENCIES), moment.expand(len(means), -1)], dim=1)
        hidden = inputs
        for number in range(self.depth):
            hidden = run_layer(self._weights, f"linear.{number}", hidden).relu_()
            if number == self.depth // 2:
                hidden = torch.cat([inputs, hidden], dim=1)
        return hidden

    @property
    def _heads(self) -> dict[str, int]:
        """The output layers by name, with the number of outputs of each."""
        motion = {"branch_w": 3, "branch_v": 3} if self.is_6dof else {"gaussian_warp": 3}
        return {**motion, "gaussian_rotation": 4, "gaussian_scaling": 3}

    def _refuse_other_inputs(self, where: str) -> None:
        inputs = self._weights["linear.0.weight"].shape[-1]
        moment = len(self._weights["timenet.2.weight"]) if self.has_timenet else TIME_INPUTS
        if inputs != POSITION_INPUTS + moment:
            reason = f"its first layer takes {inputs} numbers, not {POSITION_INPUTS} of the position and {moment} of the time"
            raise CheckpointError(f"{where}: {reason}, so a changed copy of the project trained it, with frequencies that the file does not tell")

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """The expected shapes of all layers, given the first."""
        width, inputs = self._weights["linear.0.weight"].shape
        layers = {f"linear.{i}": (width, width) for i in range(1, self.depth)}
        layers[f"linear.{self.depth // 2 + 1}"] = (width, width + inputs)
        layers |= {head: (size, width) for head, size in self._heads.items()}
        if self.has_timenet:
            hidden = len(self._weights["timenet.0.weight"])
            layers |= {"timenet.0": (hidden, 1 + 2 * self._frequencies_of_time), "timenet.2": (inputs - POSITION_INPUTS, hidden)}
        return shapes_of(layers) | {"linear.0.bias": (width,)}


def load_deformable(path: str | Path, *, iteration: int | None = None) -> MovingModel:
    """Load a model folder of Deformable 3D Gaussians. Raises CheckpointError if it is damaged, incomplete, or of another family."""
    canonical, network, weights = read_canonical(path, iteration, "deformable")
    return MovingModel("deformable", canonical, DeformNetwork(weights, f"{network} is not a network as the project publishes it"))


def embed(values: Tensor, frequencies: int) -> Tensor:
    """Positional encoding of [N, D] as [N, D·(1 + 2·frequencies)]: the values, then sine and cosine of the values times 1, 2, 4, ..."""
    waves = [wave(values * 2**octave) for octave in range(frequencies) for wave in (torch.sin, torch.cos)]
    return torch.cat([values, *waves], dim=1)


def move_along_screw(points: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """Points [N, 3] after a rigid motion, the exponential of the screws (turns [N, 3], shifts [N, 3]); finite for an angle of 0.

    The original divides both by the angle and multiplies by it again (utils/rigid_utils.py; Lynch and Park, Modern Robotics,
    3.88), which is 0/0 for an angle of 0. Here the powers of the angle are part of the coefficients, which are finite.
    """
    angles = turns.norm(dim=1, keepdim=True)
    turns, shifts = turns + SCREW_OFFSET * angles, shifts + SCREW_OFFSET * angles
    sine = torch.sinc(angles / torch.pi)  # sin(angle) / angle
    versine = torch.sinc(angles / (2 * torch.pi)).square() / 2  # (1 - cos(angle)) / angle**2
    turned = points + sine * torch.cross(turns, points, dim=1) + versine * _cross_twice(turns, points)
    return turned + shifts + versine * torch.cross(turns, shifts, dim=1) + _sine_rest(angles) * _cross_twice(turns, shifts)


def kernel_covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances [N, 3, 3], world units², as 3DGS's kernel computes them from scales [N, 3] and quaternions wxyz [N, 4], not normalized."""
    factors = as_if_unit(quats) * scales[:, None, :]
    return factors @ factors.mT


def _cross_twice(axes: Tensor, vectors: Tensor) -> Tensor:
    return torch.cross(axes, torch.cross(axes, vectors, dim=1), dim=1)


def _sine_rest(angles: Tensor) -> Tensor:
    """(angle - sin(angle)) / angle**3, which is 1/6 at 0."""
    squares = angles.square()
    series = 1 / 6 - squares / 120 + squares.square() / 5040 - squares**3 / 362_880
    large = angles.clamp_min(SMALL_ANGLE)
    return torch.where(angles < SMALL_ANGLE, series, (large - large.sin()) / large**3)
