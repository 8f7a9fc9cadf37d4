"""Seconds of what a device was asked for: a GPU goes on with it after the host has asked."""

from __future__ import annotations

import time

import torch


def now(device: torch.device | None) -> float:
    """The time in seconds, once the GPU `device` has done all that it was asked for. There is nothing to wait for on a processor, or for None."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
