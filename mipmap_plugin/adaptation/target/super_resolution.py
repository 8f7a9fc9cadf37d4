"""Super-resolution networks from files, by spandrel: any architecture and weights that it knows, as an upsampler."""

from __future__ import annotations

import contextlib
import warnings
import zipfile
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.disk_cache import cached, fingerprint
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.torchvision_absent import torchvision_optional

SUFFIXES = (".pth", ".pt", ".ckpt", ".safetensors")
INSTALL = "install it with `pip install 'mipmap-plugin[sr]'`"

# Larger images go through a network in tiles of this many px with this much of their surroundings, so that memory stays small.
TILE = 256
MARGIN = 32


class Network:
    """A network as an upsampler: `network(image [H, W, 3], size) -> [size[0], size[1], 3]`, kept on disk by what goes in."""

    def __init__(self, path: str | Path) -> None:
        """Raises CheckpointError for a file that is no network, SettingsError for one that does not enlarge, PluginError without spandrel."""
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
        """Through the network until it is large enough, then down to the exact size."""
        network = self._network.to(image.device)
        while image.shape[0] < size[0] or image.shape[1] < size[1]:
            with _quietly():
                image = _in_tiles(network, image.float().clamp(0, 1))
        return resize(image, size, "pil-bicubic").clamp(0, 1)


def _load(path: Path) -> Any:
    """spandrel's descriptor of the network. spandrel's own file reader is passed by, for it executes TorchScript."""
    with torchvision_optional():
        try:
            import spandrel
        except ImportError as error:
            raise PluginError(f"{path}: is a super-resolution network, which spandrel loads; {INSTALL} ({error})") from error
    try:
        weights = spandrel.canonicalize_state_dict(_weights(path))
        with _quietly():
            network = spandrel.ModelLoader().load_from_state_dict(weights)
    except (spandrel.UnsupportedModelError, RuntimeError, AttributeError, KeyError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise CheckpointError(f"{path}: is no network that spandrel knows ({reason})") from error
    if not isinstance(network, spandrel.ImageModelDescriptor) or (network.input_channels, network.output_channels) != (3, 3):
        raise SettingsError(f"{path}: {network.architecture.name} does not turn one RGB image into another; give a super-resolution network")
    if network.scale < 2:
        raise SettingsError(f"{path}: this {network.architecture.name} network does not enlarge; give one that does")
    return network.eval()


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Without what the authors of networks are warned of, such as SwinIR's of torch.meshgrid: it is nothing that a user can act on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _weights(path: Path) -> Any:
    """The tensors of a file by name; nothing in it is executed."""
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{path} is damaged; download it again ({error})") from error
    return read_torchscript(path) if _is_torchscript(path) else load_torch(path)


def _is_torchscript(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _in_tiles(network: Any, image: Tensor) -> Tensor:
    """[H, W, 3] -> [scale H, scale W, 3], whole where it is small or the architecture looks at all of it."""
    planes = image.movedim(-1, 0)[None]
    if max(planes.shape[2:]) <= TILE or network.tiling.name != "SUPPORTED":
        return network(planes)[0].movedim(0, -1).clone()  # not an inference tensor, which no loss may use
    height, width, times = *image.shape[:2], network.scale
    result = image.new_empty(height * times, width * times, 3)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            above, before = min(top, MARGIN), min(left, MARGIN)
            part = network(planes[..., top - above : top + TILE + MARGIN, left - before : left + TILE + MARGIN])[0].movedim(0, -1)
            spot = result[top * times : (top + TILE) * times, left * times : (left + TILE) * times]
            spot.copy_(part[above * times :, before * times :][: spot.shape[0], : spot.shape[1]])
    return result
