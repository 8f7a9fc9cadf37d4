"""The embedded scene: small enough to ship, whole, and gained by adapting."""

from __future__ import annotations

from importlib.resources import files

import pytest

from mipmap_plugin.demo.run import PROTOCOL, WorldView, embedded, run_demo
from mipmap_plugin.errors import OutputExists
from mipmap_plugin.evaluation.evaluate import Evaluator


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
