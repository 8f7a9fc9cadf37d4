"""A checkpoint of anchors."""

import anchor_checkpoints as checkpoints
import pytest


@pytest.fixture
def folder(tmp_path):
    checkpoints.write(tmp_path / "model")
    return tmp_path / "model"
