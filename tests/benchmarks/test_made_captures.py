"""Made-up captures: what adapting does where cameras are as people move them, and the table of it."""

import json

import pytest
from captures import Row, main
from made_captures import CAPTURES
from rows import joined

from mipmap_plugin.adaptation.views.shown import showing
from mipmap_plugin.evaluation.measure import views_seen
from mipmap_plugin.formats.atomic import write_json


@pytest.mark.parametrize("name", CAPTURES)
def test_views_that_are_judged_show_something_and_are_not_adapted_to(name):
    capture = CAPTURES[name]()
    assert len(showing(capture.held_out, capture.splats.means, 0.2)) == len(capture.held_out)
    assert not views_seen(capture.held_out, capture.cameras)


def test_what_few_views_show_is_adapted_too(tmp_path):
    """A board that a tenth of the views show, on a plain wall: views of the wall alone, which are right as they are, do not outweigh it."""
    main(only=("board",), scale=(0.25,), output=tmp_path)
    (row,) = json.loads((tmp_path / "captures.json").read_text())
    assert row["psnrs_db"]["default"] > row["psnrs_db"]["base"] + 8 and row["least_change_db"] > 5
    write_json(tmp_path / "captures.json", [row | {"seed": 7}, row | {"psnrs_db": {}}], overwrite=True)
    kept = joined(tmp_path / "captures.json", Row, [Row(**row)], lambda each: each.seed)
    assert [each.seed for each in kept] == [7, 0] and kept[1].psnrs_db == row["psnrs_db"]
    assert "| board   | x0.25 | 0    |" in (tmp_path / "captures.md").read_text()
