"""The command line and scenes, for tests of jobs."""

import pytest
import tiny

from mipmap_plugin.cli import main


@pytest.fixture
def run(capsys):
    """Call the command line; return (exit code, what it said on stdout, what on stderr)."""

    def call(*words):
        capsys.readouterr()
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def scenes(tmp_path):
    """Two model folders, one beside the other."""
    for seed, name in enumerate(("chair", "lego")):
        tiny.folder(tmp_path / "output" / name, tiny.cameras(3), seed=seed)
    return tmp_path / "output"
