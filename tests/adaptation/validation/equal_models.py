"""The scale of these runs, and whether two models are the same, bit for bit."""

import torch

SCALE = 1 / 4


def same(model, other) -> bool:
    return all(torch.equal(tensor, other.parameters()[name]) for name, tensor in model.parameters().items())
