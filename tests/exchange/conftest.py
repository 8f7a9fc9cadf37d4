"""A stand-in for splat-transform, the only program on the path."""

import sys

import pytest
import tiny
from exchange_files import STAND_IN


@pytest.fixture
def tool(tmp_path_factory, monkeypatch):
    """The folder of a stand-in that is the only program on the path."""
    place = tmp_path_factory.mktemp("bin")
    (place / "splat-transform").write_text(STAND_IN.format(python=sys.executable))
    (place / "splat-transform").chmod(0o755)
    tiny.ply(place / "answer.ply")
    monkeypatch.setenv("PATH", str(place))
    return place
