"""The table of what real viewers show: what was measured before stays, and what was not measured is not made up."""

import json

from viewers import Row, keep, page


def test_what_is_not_measured_again_is_kept(tmp_path):
    file = tmp_path / "lego.json"
    keep(file, [Row("lego", 0.25, "spark", "base", 9, 20.0), Row("lego", 0.25, "spark", "classic", 9, 13.0)])
    keep(file, [Row("lego", 0.25, "spark", "classic", 9, 14.0)])
    assert [(row["file"], row["psnr_db"]) for row in json.loads(file.read_text())] == [("base", 20.0), ("classic", 14.0)]


def test_a_file_that_was_not_measured_is_a_dash():
    facts = [(1.0, "base", 20.0), (0.5, "base", 21.0), (0.5, "classic", 13.0)]
    rows = [Row("lego", scale, "spark", file, 9000, quality) for scale, file, quality in facts]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page(rows).splitlines() if line.startswith("| x")]
    assert lines == [["x1", "spark", "20.0 (9.0)", "–"], ["x0.5", "spark", "21.0 (9.0)", "13.0 (9.0)"]]
