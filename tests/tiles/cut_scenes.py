"""Scenes that are cut into tiles, for tests."""

from dataclasses import replace

from mipmap_plugin.formats.ply import read_ply, write_ply
from mipmap_plugin.recipes import recipe
from mipmap_plugin.tiles import truth
from mipmap_plugin.tiles.folder import work_folder
from mipmap_plugin.tiles.reading import make_cut
from mipmap_plugin.tiles.report import Judgment, make_report
from mipmap_plugin.tiles.scene import opened
from mipmap_plugin.tiles.truth import draw_truths, parts


def cut_in_three(job, **settings):
    """A scene in three tiles with its truths."""
    job = replace(job, settings=job.settings | settings)
    folder = work_folder(job.target)
    folder.mkdir()
    make_cut(job.base.checkpoint, 3, folder)
    scene = opened(job.base, job.scale, None, job.config(), folder)
    for part in range(parts(scene.used_views)):
        draw_truths(scene, part)
    return scene


def rewritten(job, change):
    """The file of a job's base, whose columns are now what `change` makes of them."""
    [file] = job.base.checkpoint.rglob("*.ply")
    return write_ply(file, change(read_ply(file).columns), overwrite=True)


def report(scene, file):
    """The report of a scene whose tiles are adapted."""
    return make_report(scene, [file], [], {"total": 1.0}, Judgment({}, "the start", []))


def config(**settings):
    return recipe("default", 0.25, **settings)


def base_pictures(monkeypatch):
    """The sizes of the pictures of the base that are drawn from now on."""
    sizes = []

    def draw_base(scene, view):
        image = real_draw_base(scene, view)
        sizes.append(tuple(image.shape[:2]))
        return image

    real_draw_base = truth.draw_base
    monkeypatch.setattr(truth, "draw_base", draw_base)
    return sizes
