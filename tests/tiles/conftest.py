"""Small scenes, as a job and cut into tiles."""

import pytest
import tiny
from cut_scenes import cut_in_three

from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.tiles.halo import draw_halos, draw_layers
from mipmap_plugin.tiles.start import StartSearch


@pytest.fixture
def job(tmp_path):
    """A scene that is adapted in tiles in a moment."""
    folder = tiny.folder(tmp_path / "scene", tiny.cameras(3, width=20, height=16), count=80)
    settings = {"steps": 4, "seed": 0, "views": "given", "validation_views": 2, "views_per_step": 1, "merge_to": 1.0}
    return Job(Base(folder), tmp_path / "out.ply", 0.5, settings=settings)


@pytest.fixture
def halved(job):
    """A scene in three tiles that begins with the base, and has the layers and halos of its first sweep."""
    scene = cut_in_three(job, closed_form=False)
    StartSearch(scene).run()
    for number in range(3):
        draw_layers(scene, number, scene.sweeps[0])
    draw_halos(scene, 0, scene.sweeps[0])
    return scene
