"""The walk's own parts: what a film measures, and its page."""

from dataclasses import asdict

import pytest
import tiny
import torch
from levels_walk import film, page, scales, walks

from mipmap_plugin import wrap_model
from mipmap_plugin.levels.distance.chunks import Chunks
from mipmap_plugin.levels.distance.ladder import scene_of
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.request import Band, LadderRequest


@pytest.fixture
def scene(monkeypatch):
    """Three frames of a walk away from a ball."""
    monkeypatch.setattr("levels_walk.FRAMES", 3)
    base = wrap_model(tiny.model(80, degree=0), cameras=tiny.cameras(3), backend="cpu", threads=1)
    return scene_of(base, LadderRequest("classic"), Band.first(2.0, as_it_is=False))


def test_a_film_measures_what_is_shown(scene):
    """Of two equal levels every switch shows nothing; with a second level without splats it does, and every chunk changes to it once."""
    walked = walks(scene)
    chunks = Chunks.of(scene.splats, extent=0.3, least=20)
    alone = film(scene, "base", Mixture.of(DistanceRule(1.0, 2.0, 1), chunks, [scene.splats]), walked)
    near = DistanceRule(float(chunks.distances(walked[0].cameras[1].center).mean()) / walked[0].cameras[1].fx, 2.0, 2)
    same, less = (film(scene, "two", Mixture.of(near, chunks, [scene.splats, level]), walked) for level in (scene.splats, scene.splats[:0]))
    assert [frame.scale for frame in alone.frames] == pytest.approx(scales()) and alone.frames[0].psnr_db > 30
    assert [frame.psnr_db for frame in same.frames] == pytest.approx([frame.psnr_db for frame in alone.frames], abs=0.01)
    assert sum(frame.switches for frame in same.frames) == len(chunks) == sum(frame.switches for frame in less.frames)
    assert min(frame.likeness_db for frame in same.frames if frame.likeness_db is not None) > 60
    assert less.frames[-1].splats == 0 and abs(less.frames[-1].psnr_db - alone.frames[-1].psnr_db) > 3


def test_the_page_has_a_row_for_every_film(scene):
    found = film(scene, "by distance", Mixture.of(DistanceRule(1.0, 2.0, 1), Chunks.of(scene.splats, 9.0), [scene.splats]), walks(scene)[:1])
    facts = {"base": "ball", "viewer": "classic", "chunks": 1, "extent": 9, "counts": "80", "films": [asdict(found)], "steps": 5, "note": "Small."}
    text = page([facts])
    assert "## ball in classic" in text and "5 steps each at most. Small." in text and "| by distance" in text
    assert torch.isfinite(torch.tensor(found.frames[1].flicker))
