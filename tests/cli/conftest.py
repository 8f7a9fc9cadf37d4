"""The command line, called in a folder of its own."""

import pytest

from mipmap_plugin.cli import main


@pytest.fixture
def run(capsys, tmp_path_factory, monkeypatch):
    """Call the command line in a folder of its own; return (exit code, what it said on stdout, what on stderr)."""
    monkeypatch.chdir(tmp_path_factory.mktemp("here"))

    def call(*words):
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as leaving:  # how the argument parser ends
            code = leaving.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return call
