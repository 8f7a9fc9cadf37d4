"""The command line, called in a folder of its own."""

import pytest


@pytest.fixture
def run(run, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("here"))
    return run
