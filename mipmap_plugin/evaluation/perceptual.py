"""LPIPS (Zhang et al. 2018) by the lpips package, which includes the linear heads; the backbone's weights come from a file or a download."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import torch
from torch import Tensor, nn

from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError, brief, install
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.process.torchvision_absent import torchvision_optional
from mipmap_plugin.progress import announced

# A backbone and its input: images in -1..1, as LPIPS is defined, or (01) in 0..1, as papers of this field use VGG.
Kind = Literal["alex", "vgg", "vgg-01"]

INSTALL = install("metrics")

# torchvision's weights for ImageNet, at torchvision's own addresses.
DOWNLOADS = {"alex": "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth", "vgg": "https://download.pytorch.org/models/vgg16-397923af.pth"}

AGAIN = "remove it, so that it is downloaded again"

# px: a smaller image is less than one pixel after the last pooling.
SMALLEST = {"alex": 31, "vgg": 16}


class Perceptual:
    """LPIPS as a metric: `perceptual(image, truth)`, both [H, W, 3]. `label` names the variant."""

    def __init__(self, kind: Kind = "alex", weights: str | Path | None = None) -> None:
        """`weights`: a file of the backbone's weights, as torchvision names them; by default they are downloaded once.

        Raises PluginError without lpips, CheckpointError for a wrong file, SettingsError if they cannot be downloaded.
        """
        self._backbone = kind.removesuffix("-01")
        self._normalize = not kind.endswith("-01")
        self.label = f"LPIPS ({self._backbone}, {'normalized' if self._normalize else '0..1'})"
        self._network = _load(self._backbone, None if weights is None else Path(weights))

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> float | None:
        """The distance of two images [H, W, 3] clamped to 0..1; None for images that are too small for the backbone."""
        if min(image.shape[:2]) < SMALLEST[self._backbone]:
            return None
        planes = [pixels.detach().cpu().float().clamp(0, 1).movedim(-1, 0)[None] for pixels in (image, truth)]
        return float(self._network(*planes, normalize=self._normalize))


def _load(backbone: str, file: Path | None) -> nn.Module:
    """The lpips network with the backbone's weights from a file, or downloaded."""
    if file is not None and file.is_dir():
        raise CheckpointError(f"{file} is a folder; give the file of the weights of {backbone} in it")
    with torchvision_optional(models={"alexnet": _alexnet, "vgg16": _vgg16}):
        try:
            import lpips
        except ImportError as error:
            raise PluginError(f"LPIPS needs the package lpips; {INSTALL} ({error})") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision's warnings about the arguments that lpips passes to it
        network = lpips.LPIPS(net=backbone, pnet_rand=True, verbose=False)
    weights = _download(backbone) if file is None else load_torch(file)
    torchvision_names = {name: "features." + name.split(".", 1)[1] for name in network.net.state_dict()}  # lpips: slice1.0.weight
    try:
        network.net.load_state_dict({name: weights[torchvision_name] for name, torchvision_name in torchvision_names.items()})
    except (LookupError, TypeError, RuntimeError) as error:
        where, advice = (file, "leave it out to download one") if file else (_kept(backbone), AGAIN)
        raise CheckpointError(f"{where} holds no {backbone} backbone as torchvision saves it; {advice}") from error
    measure: nn.Module = network
    return measure


def _download(backbone: str) -> dict[str, Tensor]:
    try:
        with announced(f"downloading the weights of {backbone}"):
            return torch.hub.load_state_dict_from_url(DOWNLOADS[backbone], map_location="cpu", progress=False, weights_only=True, check_hash=True)
    except OSError as error:
        advice = f"download {DOWNLOADS[backbone]} elsewhere and give the file (--lpips-weights)"
        raise SettingsError(f"LPIPS needs the weights of its backbone, which cannot be downloaded ({error}); {advice}") from error
    except Exception as error:  # what torch raises for a file of an earlier download that is not whole
        raise CheckpointError(f"{_kept(backbone)} is damaged ({brief(error)}); {AGAIN}") from error


def _kept(backbone: str) -> Path:
    """Where torch keeps the weights that it downloads."""
    return Path(torch.hub.get_dir(), "checkpoints", Path(DOWNLOADS[backbone]).name)


def _alexnet(pretrained: bool) -> SimpleNamespace:
    """AlexNet's convolutions in torchvision's order, with random weights; used where torchvision does not work."""
    shapes = [(3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1)]
    layers: list[nn.Module] = []
    for number, shape in enumerate(shapes):
        layers += [nn.Conv2d(*shape), nn.ReLU()]
        if number in (0, 1, 4):
            layers.append(nn.MaxPool2d(3, 2))
    return SimpleNamespace(features=nn.Sequential(*layers))


def _vgg16(pretrained: bool) -> SimpleNamespace:
    """VGG-16's convolutions in torchvision's order, with random weights."""
    layers: list[nn.Module] = []
    channels = 3
    for width, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2, 2))
    return SimpleNamespace(features=nn.Sequential(*layers))
