"""The command `tradeoff`, and what it refuses before anything is measured."""

import json
import sys
from unittest.mock import Mock

import pytest
import tiny

from mipmap_plugin import cli
from mipmap_plugin.errors import OutputError
from mipmap_plugin.evaluation.tradeoff import measuring
from mipmap_plugin.limits import MAX_SEED

pytestmark = pytest.mark.usefixtures("few_views")


def command(tmp_path, *more):
    """The exit code of a small comparison; what `more` has takes the place of its own."""
    folder, own = tmp_path / "base", {"--steps": "2", "--views": "1", "--repeats": "1"}
    if not folder.exists():
        tiny.folder(folder, tiny.cameras(3))
    some = ["--recipe", "default", "--supersampling", "2", "--no-renderers"]
    some += [word for option in own.items() if option[0] not in more for word in option]
    return cli.main(["tradeoff", str(folder), "--scale", "1/4", "--output", str(tmp_path / "new"), "--no-picture", *some, *more])


def test_the_command_prints_a_table_and_refuses_to_replace_it(tmp_path, capsys):
    assert command(tmp_path) == 0
    out = capsys.readouterr().out
    assert "x0.25, dB against the base supersampled 4 x 4 (no photographs)" in out and "| base  " in out
    assert out.endswith(f"\nwritten: {tmp_path / 'new' / 'tradeoff.json'}, {tmp_path / 'new' / 'tradeoff.csv'}\n")
    assert command(tmp_path) == 2
    assert "exists already" in capsys.readouterr().err
    assert command(tmp_path, "--overwrite", "--json") == 0
    assert json.loads(capsys.readouterr().out)["complete"]


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (["--views", "0"], "views: at least 1"), (["--steps", "-1"], "setting steps"), (["--seed", "-1"], "setting seed"),
        (["--seed", str(MAX_SEED), "--repeats", "2"], "setting seed"),
    ],
)  # fmt: skip
def test_wrong_options_are_refused_before_anything_is_measured(tmp_path, capsys, monkeypatch, wrong, reason):
    monkeypatch.setattr(measuring, "_measured", lambda *_: pytest.fail("it is refused before anything is measured"))
    assert command(tmp_path, *wrong) == 2 and reason in capsys.readouterr().err


def test_pictures_without_matplotlib_are_refused_before_anything_is_measured(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert command(tmp_path, "--picture") == 2
    assert 'pip install "mipmap-plugin[plot]"' in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_page_that_cannot_be_written_is_written_by_the_same_command(tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as failing:
        failing.setattr("mipmap_plugin.pages.html.write_page", Mock(side_effect=OutputError("the disk is full")))
        assert command(tmp_path, "--report") == 2 and "the disk is full" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"tradeoff.resume"}
    monkeypatch.setattr(measuring, "adapt_alone", lambda *_, **__: pytest.fail("what was measured is kept"))
    assert command(tmp_path, "--report") == 0
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"tradeoff.json", "tradeoff.csv", "report.html"}


def test_a_page_goes_with_the_results_that_it_shows(tmp_path):
    assert command(tmp_path, "--report") == 0 and (tmp_path / "new" / "report.html").exists()
    assert command(tmp_path, "--overwrite") == 0 and not (tmp_path / "new" / "report.html").exists()


def test_a_page_of_something_else_stays(tmp_path):
    ladder = tmp_path / "new"
    ladder.mkdir()
    (ladder / "report.html").write_text("<title>mipmap_plugin</title>")
    assert command(tmp_path) == 0 and (ladder / "report.html").exists()
