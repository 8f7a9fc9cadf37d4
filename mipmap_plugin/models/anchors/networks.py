"""The networks that all anchors of a Scaffold-GS or Octree-GS model share: their files, shapes and inputs."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.models.anchors.companions import FILES, NEEDED, UNITED, missing_networks

Weights = dict[str, dict[str, Tensor]]  # network -> its state dict

LAYERS = {"0.weight", "0.bias", "2.weight", "2.bias"}
EMBEDDING = "embedding.weight"

# In the archives that torch.jit writes: what only debuggers read, and how names of classes are told apart.
OF_TRACING, NUMBERED = (".debug_pkl", "/serialization_id"), re.compile(rb"___torch_mangle_(\d+)")

LAST: dict[str, nn.Module] = {"opacity_mlp": nn.Tanh(), "color_mlp": nn.Sigmoid(), "feature_bank_mlp": nn.Softmax(dim=1)}


def read_networks(folder: Path) -> tuple[Weights, dict[str, bytes]]:
    """The weights beside an anchor PLY, and the contents of the files they were read from. Raises CheckpointError."""
    if missing := missing_networks(folder):
        raise CheckpointError(f"{folder} is an incomplete checkpoint: {', '.join(missing)} must lie beside the PLY; copy the whole folder")
    split = {name: folder / file for name, file in FILES.items() if (folder / file).is_file()}
    if split.keys() >= set(NEEDED):
        weights, files = {name: read_torchscript(file) for name, file in split.items()}, list(split.values())
    else:
        weights, files = _read_united(folder / UNITED), [folder / UNITED]
    return weights, {file.name: file.read_bytes() for file in files}


def check_networks(weights: Weights, features: int, splats: int, folder: Path | str) -> None:
    """Raise CheckpointError unless the networks are valid and fit anchors with `features` features and `splats` splats each."""
    for name, state in weights.items():
        _check(name, state, folder)
    rows = {"opacity_mlp": splats, "cov_mlp": 7 * splats, "color_mlp": 3 * splats, "feature_bank_mlp": 3}
    for name, count in rows.items():
        if name in weights and len(weights[name]["2.weight"]) != count:
            outputs = len(weights[name]["2.weight"])
            raise CheckpointError(f"{folder}: {name} gives {outputs} numbers, but anchors with {splats} splats need {count}; the files do not match")
    if "feature_bank_mlp" in weights and features % 4:
        raise CheckpointError(f"{folder}: a feature bank needs features in fours, but the anchors have {features}; the files do not match")


def refuse_infinite(name: str, state: Mapping[str, Tensor]) -> None:
    """Raise SettingsError for a network that is not finite, which could not be loaded again."""
    if not all(bool(tensor.isfinite().all()) for tensor in state.values()):
        raise SettingsError(f"{name} holds weights that are not finite, so nothing is saved; adapt less boldly, or to another scale")


def surplus(weights: Weights, name: str, features: int) -> int:
    """The number of a network's inputs besides the anchor's features, the viewing direction, and the appearance."""
    known = features if name != "feature_bank_mlp" else 0
    return weights[name]["0.weight"].shape[1] - known - 3 - (appearance_size(weights) if name == "color_mlp" else 0)


def inputs_of(weights: Weights, features: int, bank: tuple[str, ...], where: Path | str | None, *, level: bool = False) -> dict[str, tuple[str, ...]]:
    """The inputs of each network, in order: features, direction and, depending on the widths, distance, level and appearance.

    `bank`: the inputs of a feature bank; `level`: whether the networks take the level; `where`: what the CheckpointError names.
    """
    inputs: dict[str, tuple[str, ...]] = {}
    for name in NEEDED:
        extra = surplus(weights, name, features)
        distance = extra - level
        if distance not in (0, 1):
            reason = "embedding_appearance.pt is missing" if name == "color_mlp" and distance > 1 else "the files do not match"
            raise CheckpointError(f"{where}: {name} takes {extra} numbers more than features and direction; {reason}")
        inputs[name] = ("features", "direction", *("distance",) * distance, *("level",) * level)
    if "feature_bank_mlp" in weights:
        inputs["feature_bank_mlp"] = bank
    if "appearance" in weights:
        inputs["color_mlp"] += ("appearance",)
    return inputs


def appearance_size(weights: Weights) -> int:
    """The length of an appearance embedding; 0 if the model has none."""
    return weights["appearance"][EMBEDDING].shape[1] if "appearance" in weights else 0


def packed(weights: Weights, read: Weights, files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files of `weights`, by name. Networks that equal those `read` keep the bytes of their `files`.

    Others keep their format: one file of state dicts, or the TorchScript that the original loads, which is built and traced from
    modules of this package, so that no code of the original files runs. Networks without a file become TorchScript.
    """
    changed = {name for name, state in weights.items() if any(not torch.equal(tensor.cpu(), read[name][key].cpu()) for key, tensor in state.items())}
    if UNITED in files:
        return {UNITED: _united(weights)} if changed else dict(files)
    kept = {FILES[name] for name in weights if name not in changed and FILES[name] in files}
    return {FILES[name]: files[FILES[name]] if FILES[name] in kept else _traced(name, state) for name, state in weights.items()}


def _united(weights: Weights) -> bytes:
    content = io.BytesIO()
    torch.save({name: {key: tensor.detach().cpu() for key, tensor in state.items()} for name, state in weights.items()}, content)
    return content.getvalue()


class _Appearance(nn.Module):
    """One embedding per training view, under the original's name."""

    def __init__(self, count: int, size: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(count, size)

    def forward(self, index: Tensor) -> Tensor:
        return cast(Tensor, self.embedding(index))


def _traced(name: str, state: dict[str, Tensor]) -> bytes:
    network: nn.Module
    if name == "appearance":
        network, example = _Appearance(*state[EMBEDDING].shape), torch.zeros(1, dtype=torch.long)
    else:
        (hidden, width), count = state["0.weight"].shape, len(state["2.weight"])
        last = [LAST[name]] if name in LAST else []
        network, example = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(True), nn.Linear(hidden, count), *last), torch.zeros(1, width)
    network.load_state_dict({key: tensor.detach().cpu() for key, tensor in state.items()})
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit, the only way to write the original's format
        torch.jit.trace(network, example)  # what is traced first in a process has the names without numbers
        torch.jit.save(torch.jit.trace(network, example), content)
    return _repeatable(content)


def _repeatable(archive: io.BytesIO) -> bytes:
    """A TorchScript archive whose bytes follow from the network: without the calls by which it was traced, in which there are paths of this machine,
    and with numbers in the names of classes that do not count what else the process has traced."""
    content = io.BytesIO()
    with zipfile.ZipFile(archive) as traced, zipfile.ZipFile(content, "w") as out:
        kept = [name for name in traced.namelist() if not name.endswith(OF_TRACING)]
        numbers = sorted({int(number) for name in kept for number in NUMBERED.findall(name.encode())})
        renumbered = partial(NUMBERED.sub, lambda name: b"___torch_mangle_%d" % numbers.index(int(name[1])))
        for name in kept:
            held = traced.read(name)
            out.writestr(zipfile.ZipInfo(renumbered(name.encode()).decode()), held if "/data/" in name else renumbered(held))
    return content.getvalue()


def _read_united(path: Path) -> Weights:
    states = load_torch(path)
    if not isinstance(states, Mapping) or not states.keys() >= set(NEEDED) or not all(isinstance(state, Mapping) for state in states.values()):
        raise CheckpointError(f"{path} does not hold the networks {', '.join(NEEDED)}; copy it again")
    return {name: dict(states[name]) for name in FILES if name in states}


def _check(name: str, state: dict[str, Tensor], folder: Path | str) -> None:
    wanted = {EMBEDDING} if name == "appearance" else LAYERS
    if state.keys() != wanted or not all(isinstance(tensor, Tensor) and tensor.dtype == torch.float32 for tensor in state.values()):
        raise CheckpointError(f"{folder}: {name} holds {', '.join(sorted(map(str, state))) or 'nothing'}, not {', '.join(sorted(wanted))} in 32 bits")
    if name == "appearance":
        fits = state[EMBEDDING].dim() == 2
    else:
        (first, second), hidden = (state["0.weight"], state["2.weight"]), len(state["0.bias"].flatten())
        fits = first.dim() == second.dim() == 2 and len(first) == second.shape[1] == hidden and state["2.bias"].shape == second.shape[:1]
    if not fits:
        raise CheckpointError(f"{folder}: the layers of {name} do not fit together; copy the checkpoint again")
    if not all(bool(tensor.isfinite().all()) for tensor in state.values()):
        raise CheckpointError(f"{folder}: {name} holds weights that are not finite; the training failed")
