"""Backends of a stranger."""

import torch

from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.reference import ReferenceBackend

NEEDS = Needs("cpu", torch.float32, gradients=True, sh_degree=1, screen_filter="classic")


class Fast(ReferenceBackend):
    name = "fast"
    speed = 1000


class Fussy(ReferenceBackend):
    name = "fussy"
    speed = 2000

    def lacking(self, needs):
        return ["it is not in the mood", "nor will it be"]


class Crashing:
    def __init__(self):
        raise RuntimeError("no driver")
