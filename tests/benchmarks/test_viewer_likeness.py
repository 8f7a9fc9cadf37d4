"""The table of how like a viewer's picture ours is: what was not measured again is kept."""

import json

import pytest

pytest.importorskip("playwright", reason="browsers are driven with playwright")


import viewer_likeness


class NoBrowser:
    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_a_viewer_that_is_not_measured_again_keeps_its_row(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_likeness, "Browser", NoBrowser)
    monkeypatch.setattr(viewer_likeness, "likeness", lambda browser, viewer, checkpoint, scene: [50.0, 40.25])
    (tmp_path / "viewer_likeness.json").write_text(json.dumps({"spark": {scene: [30.0, 31.0] for scene in viewer_likeness.SCENES}}))
    viewer_likeness.main(tmp_path, tmp_path, viewer=("three",))
    rows = [line.split("|")[1:3] for line in (tmp_path / "viewer_likeness.md").read_text().splitlines() if " to " in line and line.startswith("|")]
    assert [[cell.strip() for cell in row] for row in rows] == [["spark", "30.0 to 31.0"], ["three", "40.2 to 50.0"]]
