"""Scenes, for tests of jobs."""

import pytest
import tiny


@pytest.fixture
def scenes(tmp_path):
    """Two model folders, one beside the other."""
    for seed, name in enumerate(("chair", "lego")):
        tiny.folder(tmp_path / "output" / name, tiny.cameras(3), seed=seed)
    return tmp_path / "output"
