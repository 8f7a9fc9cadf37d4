"""A stand-in for splat-transform, the only program on the path."""

import pytest
import tiny
from exchange_files import STAND_IN, answer_by


@pytest.fixture
def tool(tmp_path_factory, monkeypatch):
    """The folder of a stand-in that is the only program on the path."""
    place = tmp_path_factory.mktemp("bin")
    answer_by(place, STAND_IN)
    tiny.ply(place / "answer.ply")
    monkeypatch.setenv("PATH", str(place))
    return place
