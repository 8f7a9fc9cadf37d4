"""Chunks of scenes as small as those of tests, and a program that writes what viewers stream."""

import pytest
from exchange_files import answer_by
from streaming_tool import STAND_IN

from mipmap_plugin.levels.distance import chunks as chunks_module
from mipmap_plugin.levels.distance.chunks import Chunks


@pytest.fixture
def small_chunks(monkeypatch):
    """The scenes here have hardly more splats than the smallest chunk of splat-transform."""
    cut = Chunks.of
    monkeypatch.setattr(chunks_module.Chunks, "of", classmethod(lambda _, splats, extent, least=None: cut(splats, extent, least=16)))


@pytest.fixture
def tool(tmp_path, monkeypatch):
    """The only program on the path, in place of splat-transform."""
    place = tmp_path / "bin"
    place.mkdir()
    monkeypatch.setenv("PATH", str(place))
    answer_by(place, STAND_IN)
