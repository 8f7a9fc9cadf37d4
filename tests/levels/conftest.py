"""Chunks of scenes as small as those of tests."""

import pytest

from mipmap_plugin.levels.distance import chunks as chunks_module
from mipmap_plugin.levels.distance.chunks import Chunks


@pytest.fixture
def small_chunks(monkeypatch):
    """The scenes here have hardly more splats than the smallest chunk of splat-transform."""
    cut = Chunks.of
    monkeypatch.setattr(chunks_module.Chunks, "of", classmethod(lambda _, splats, extent, least=None: cut(splats, extent, least=16)))
