"""Super-resolution networks from files as upsamplers: any architecture that spandrel supports."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.disk_cache import cached, fingerprint
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError, brief, install
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.magic import archive, is_archive
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.limits import is_out_of_memory
from mipmap_plugin.process.torchvision_absent import torchvision_optional

SUFFIXES = (".pth", ".pt", ".ckpt", ".safetensors")
INSTALL = install("sr")

# Larger images are processed in tiles of this many px, with this many px of margin around each, so that memory stays small.
TILE = 256
MARGIN = 32


class Network:
    """A network as an upsampler: `network(image [H, W, 3], size) -> [size[0], size[1], 3]`. Results are cached on disk."""

    def __init__(self, path: str | Path) -> None:
        """Raises CheckpointError if the file is not a network, SettingsError if it does not enlarge, PluginError without spandrel."""
        self.path = Path(path)
        self._network = _load(self.path)

    @cached_property
    def _digest(self) -> str:
        return sha256(self.path)

    def __call__(self, image: Tensor, size: tuple[int, int]) -> Tensor:
        name = fingerprint(image, self._digest, tuple(size), TILE, MARGIN)
        return cached(name, lambda: self._enlarged(image, size)).to(image)

    @torch.no_grad()
    def _enlarged(self, image: Tensor, size: tuple[int, int]) -> Tensor:
        """Apply the network until the image is large enough, then shrink it to the exact size."""
        network = self._network.to(image.device)
        while image.shape[0] < size[0] or image.shape[1] < size[1]:
            with _quietly():
                image = _in_tiles(network, image.float().clamp(0, 1))
        return resize(image, size, "pil-bicubic").clamp(0, 1)


def _load(path: Path) -> Any:
    """Return spandrel's descriptor of the network. spandrel's own file reader is not used, because it executes TorchScript."""
    with torchvision_optional():
        try:
            import spandrel
        except ImportError as error:
            raise PluginError(f"{path}: spandrel is needed to load a super-resolution network; {INSTALL} ({error})") from error
    weights = _weights(path)
    try:
        with _quietly():
            network = spandrel.ModelLoader().load_from_state_dict(spandrel.canonicalize_state_dict(weights))
    except Exception as error:  # it concludes from shapes what a network is, and fails in any way where these are odd
        if is_out_of_memory(error):
            raise
        raise CheckpointError(f"{path}: not a network that spandrel supports ({brief(error)})") from error
    if not isinstance(network, spandrel.ImageModelDescriptor) or (network.input_channels, network.output_channels) != (3, 3):
        raise SettingsError(f"{path}: {network.architecture.name} does not turn one RGB image into another; give a super-resolution network")
    if network.scale < 2:
        raise SettingsError(f"{path}: this {network.architecture.name} network does not enlarge images; give one that does")
    return network.eval()


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Suppress warnings about a network's code, such as SwinIR's use of torch.meshgrid, which a user can do nothing about."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _weights(path: Path) -> Any:
    """The tensors of a file by name; no code in it is executed."""
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{path} is damaged; download it again ({error})") from error
    return read_torchscript(path) if _is_torchscript(path) else load_torch(path)


def _is_torchscript(path: Path) -> bool:
    if not is_archive(path):
        return False
    with archive(path) as opened:
        return any(name.endswith("/constants.pkl") for name in opened.namelist())


def _in_tiles(network: Any, image: Tensor) -> Tensor:
    """Apply the network to [H, W, 3] in tiles, or at once if the image is small or the architecture needs all of it: [scale H, scale W, 3]."""
    planes = image.movedim(-1, 0)[None]
    if max(planes.shape[2:]) <= TILE or network.tiling.name != "SUPPORTED":
        result: Tensor = network(planes)[0].movedim(0, -1).clone()  # a copy, because a loss cannot use inference tensors
        return result
    height, width, factor = *image.shape[:2], network.scale
    result = image.new_empty(height * factor, width * factor, 3)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            margin_y, margin_x = min(top, MARGIN), min(left, MARGIN)
            part = network(planes[..., top - margin_y : top + TILE + MARGIN, left - margin_x : left + TILE + MARGIN])[0].movedim(0, -1)
            tile = result[top * factor : (top + TILE) * factor, left * factor : (left + TILE) * factor]
            tile.copy_(part[margin_y * factor :, margin_x * factor :][: tile.shape[0], : tile.shape[1]])
    return result
