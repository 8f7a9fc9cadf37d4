"""The embedded scene: small enough to ship, whole, and gained by adapting."""

from importlib.resources import files
from pathlib import Path

import pytest

from mipmap_plugin.commands.demo import demo
from mipmap_plugin.demo.run import PROTOCOL, WorldView, embedded, run_demo
from mipmap_plugin.demo.story import story
from mipmap_plugin.errors import OutputExists
from mipmap_plugin.evaluation.evaluate import Evaluator, Row


def test_the_base_fits_into_two_megabytes_and_knows_its_views():
    assert files("mipmap_plugin.demo").joinpath("base.ply").stat().st_size <= 2_000_000
    base = embedded()
    assert {camera.split for camera in base.cameras} == {"train", "test"}
    assert all(camera.name.startswith(camera.split) for camera in base.cameras)


def test_the_base_shows_the_world():
    base = embedded()
    views = [WorldView(camera) for camera in base.cameras if camera.split == "test"][:1]
    row = Evaluator(views, PROTOCOL).row("base", 0.5, lambda camera: base.render(camera.zoomed(0.5), 0.5, "scaled").image, gaussians=0)
    assert row.psnr_db > 22


def test_a_second_demo_does_not_overwrite_the_first(tmp_path):
    (tmp_path / "x0.25.ply").write_text("mine")
    with pytest.raises(OutputExists, match="--overwrite"):
        run_demo(tmp_path, [0.25])
    assert (tmp_path / "x0.25.ply").read_text() == "mine"


def test_a_scale_that_is_given_twice_is_adapted_to_once(monkeypatch):
    """The second file would be in the way of the first, after all the work."""
    asked = []
    monkeypatch.setattr("mipmap_plugin.demo.run.run_demo", lambda output, scales, *rest, **options: asked.extend(scales) or "")
    demo(scale=(0.25, 4.0, 0.25))
    assert asked == [0.25, 4.0]


def test_the_story_says_what_changed_at_each_zoom_and_where_it_is(tmp_path):
    def row(name: str, scale: float, psnr_db: float, gaussians: int) -> Row:
        return Row(name, scale, "demo", psnr_db, None, adapt_seconds=6.2, ms_per_view=1.0, gaussians=gaussians)

    rows = [row("base", 0.25, 14.3, 12_000), row("supersampled", 0.25, 36.0, 12_000), row("adapted", 0.25, 30.6, 2_400)]
    rows += [row("base", 4.0, 14.2, 12_000), row("adapted", 4.0, 19.8, 12_000)]
    lines = story(rows, "spark", 41.0, tmp_path, tmp_path / "report.html").splitlines()
    assert "in spark" in lines[0] and len(lines) == 5
    assert "x1/4" in lines[1] and "base 14.3 dB (thick and bright) -> adapted 30.6 dB, 12,000 -> 2,400 splats, in 6 s" in lines[1]
    assert "x4" in lines[2] and "needles and holes" in lines[2]
    assert "41 s" in lines[3] and str(tmp_path) in lines[3]
    assert lines[4] == f"page: {tmp_path / 'report.html'}"


def test_the_story_tells_paths_from_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = story([], None, 1.0, Path("demo"), tmp_path / "demo/report.html").splitlines()
    assert lines[1].endswith("(base | adapted | truth): demo") and lines[2] == "page: demo/report.html"
