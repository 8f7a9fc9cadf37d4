"""Finished cells of a long measurement, each in a file of its own: after Ctrl-C or a kill the same command begins with the one in progress.

A cell is found again by its provenance: the hash of everything that it depends on is its file's name.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.torch_file import load_torch, save_torch
from mipmap_plugin.process.versions import versions


def made_by(config: AdaptConfig) -> dict[str, Any]:
    """The settings of an adaptation for a cell's key, with a hash of the network that they name by its path."""
    return config.model_dump() | network_input(config.upsampler)


class Cells:
    """The cells of one measurement in a folder, or nowhere."""

    def __init__(self, folder: Path | None = None, provenance: Mapping[str, Any] | None = None) -> None:
        """`provenance`: what all cells depend on, as JSON: the base, the photographs, the protocol, the settings."""
        self.folder, self._provenance = folder, {**(provenance or {}), "versions": versions()}

    def find(self, key: Mapping[str, Any]) -> dict[str, Any] | None:
        """The content of a cell, if an earlier command finished it."""
        file = self._file(key)
        if file is None or not file.is_file():
            return None
        try:
            content: dict[str, Any] = load_torch(file)
        except CheckpointError:  # cut off by a crash of the machine
            return None
        return content

    def keep(self, key: Mapping[str, Any], content: dict[str, Any]) -> None:
        """Write a finished cell, of tensors and plain values, atomically. Raises OutputError."""
        file = self._file(key)
        if file is not None:
            save_torch(file, content, overwrite=True)

    def _file(self, key: Mapping[str, Any]) -> Path | None:
        facts = json.dumps([self._provenance, dict(key)], sort_keys=True, default=str)
        return self.folder and self.folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:24]}.pt"
