"""Warnings point at the line that called this package, and the command line shows them."""

import inspect
import warnings

import pytest
import tiny

from mipmap_plugin import cli, load_model, wrap_model
from mipmap_plugin.errors import MipmapPluginWarning

pytestmark = pytest.mark.usefixtures("few_views")


def caught(call):
    """Category, file and line of the warnings of `call`."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return [(each.category, each.filename, each.lineno) for each in found]


def test_warnings_of_an_adaptation_point_at_the_callers_line():
    base = wrap_model(tiny.model(20))

    def adapt():
        return base.adapt(1 / 2, recipe="instant")

    found = caught(adapt)
    line = inspect.getsourcelines(adapt)[1] + 1
    assert found and set(found) == {(MipmapPluginWarning, __file__, line)}


def test_warnings_of_loading_point_at_the_callers_line(tmp_path):
    path = tiny.ply(tmp_path / "a.ply", count=20)
    raw = bytearray(path.read_bytes())
    raw[-4:] = b"\xff" * 4  # a NaN
    path.write_bytes(raw)

    def load():
        return load_model(path)

    found = caught(load)
    assert found == [(MipmapPluginWarning, __file__, inspect.getsourcelines(load)[1] + 1)]


def test_the_command_line_shows_them_once(tmp_path, capsys):
    path = tiny.ply(tmp_path / "a.ply", count=20)
    assert cli.main(["adapt", str(path), "--scale", "1/2", "--recipe", "instant"]) == 0
    assert capsys.readouterr().err.count("no cameras are known") == 1
