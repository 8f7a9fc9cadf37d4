"""Models of plain 3DGS, for tests of what is read and written."""

import torch

from mipmap_plugin.models.vanilla import VanillaModel

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}


def raw_model(count: int = 4) -> VanillaModel:
    torch.manual_seed(0)
    return VanillaModel({name: torch.randn(count, *shape) for name, shape in SHAPES.items()})


def same(a: VanillaModel, b: VanillaModel) -> bool:
    """Bit for bit."""
    return all(torch.equal(x.view(torch.int32), y.view(torch.int32)) for x, y in zip(a.parameters().values(), b.parameters().values(), strict=True))
