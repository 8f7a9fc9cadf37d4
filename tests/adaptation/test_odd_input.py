"""What Python is given in place of what it should be: a path, a plug-in, a list, ...; either it is understood or one sentence says what to give."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from torch_checkpoints import splats

from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import digest_of
from mipmap_plugin.errors import MipmapPluginError, SceneError, SettingsError, ShapeError
from mipmap_plugin.levels.finished import Ladder
from mipmap_plugin.scenes import load_scene, write_cameras
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


@pytest.fixture
def adapted():
    return wrap_model(tiny.model(10), cameras=tiny.cameras(), backend="reference").adapt(1 / 2, recipe="instant")


@pytest.mark.parametrize(("options", "sentence"), [
    (dict(backend="gpu"), "there is no backend 'gpu'; choose from"),
    (dict(backend=ReferenceBackend), "backends are given by their names, got type"),
    (dict(threads=0), "threads must be at least 1, got 0"),
    (dict(threads="2"), "threads must be at least 1, got '2'"),
    (dict(cameras=""), "^cameras must be a text such as .*, got an empty text$"),
])  # fmt: skip
def test_a_model_is_not_wrapped_with_what_cannot_draw_it(options, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrap_model(tiny.model(5), **{"cameras": tiny.cameras(), **options})


def test_cameras_may_be_a_path(tmp_path):
    write_cameras(tmp_path / "cameras.json", tiny.cameras())
    for path in (tmp_path / "cameras.json", str(tmp_path / "cameras.json")):
        assert digest_of(wrap_model(tiny.model(5), cameras=path).cameras) == digest_of(load_scene(path).cameras)


@pytest.mark.parametrize(("draw", "sentence"), [
    (lambda adapted: adapted.render("a.png"), "cameras must be of the type mipmap_plugin.Camera, got str"),
    (lambda adapted: adapted.render(adapted.views()), "cameras must be of the type mipmap_plugin.Camera, got list"),
    (lambda adapted: adapted.render(adapted.views()[0], outputs="depth"), "outputs must be a sequence of names, such as"),
    (lambda adapted: adapted.render(adapted.views()[0], outputs=3), "outputs must be a sequence of names, such as"),
    (lambda adapted: adapted.render(adapted.views()[0], viewer=["spark"]), r"this model was not made for the viewer \['spark'\], but for no viewer"),
    (lambda adapted: adapted.save(None), "^path must be a text such as 'output/bicycle', or a pathlib.Path, got NoneType$"),
    (lambda adapted: adapted.save(""), "^path must be a text .*, got an empty text$"),
])  # fmt: skip
def test_what_an_adapted_model_cannot_draw_or_write_is_named(adapted, draw, sentence):
    with pytest.raises(SettingsError, match=sentence):
        draw(adapted)


def test_a_tilde_is_the_home_folder(adapted, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    assert adapted.save("~/a.ply") == tmp_path / "a.ply"
    write_cameras(tmp_path / "cameras.json", tiny.cameras())
    assert len(wrap_model("~/a.ply", cameras="~/cameras.json").cameras) == len(tiny.cameras())


@pytest.mark.parametrize("path", [None, 3, {"frames": []}])
def test_what_is_no_path_of_a_scene_is_named(path):
    with pytest.raises(SettingsError, match=r"^path must be a text such as 'output/bicycle', or a pathlib.Path, got "):
        load_scene(path)


def test_splats_of_gsplat_in_memory_are_told_how_to_take_cameras_as_they_are(tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    with pytest.raises(SceneError, match=r"or give wrap_model the cameras themselves \(load_scene\(path\).cameras\)$"):
        wrap_model(splats(), cameras=scene)
    assert wrap_model(splats(), cameras=load_scene(scene).cameras).cameras


def test_an_adapted_model_may_be_what_a_coarser_one_starts_from(adapted):
    base = wrap_model(tiny.model(10), cameras=tiny.cameras(), backend="reference")
    finer = FinerLevel(adapted.model, 1 / 2, "the model adapted to x0.5")
    coarser, same, other = (base.adapt(1 / 4, start=start, steps=2, extra_views=0) for start in (adapted, finer, None))
    assert coarser.report.validation == same.report.validation
    assert coarser.report.validation != other.report.validation
    with pytest.raises(SettingsError, match="start: it is made for what draws as the training did, and not for spark"):
        base.adapt(1 / 4, start=adapted, viewer="spark")
    with pytest.raises(SettingsError, match=r"start: x0\.5 is not finer than x0\.5"):
        base.adapt(1 / 2, start=adapted)
    with pytest.raises(SettingsError, match="start must be a model that was adapted to a finer scale, got Wrapped"):
        base.adapt(1 / 4, start=base)
    with pytest.raises(SettingsError, match="start: it was adapted from another base; leave it out"):
        wrap_model(tiny.model(10, seed=1), cameras=tiny.cameras(), backend="reference").adapt(1 / 4, start=adapted)


@pytest.mark.parametrize("given", [None, ["camera"], [None]])
def test_only_cameras_are_written_as_such(given, tmp_path):
    with pytest.raises(SettingsError, match=r"cameras must be of the type mipmap_plugin.Camera, got (NoneType|str)"):
        write_cameras(tmp_path / "cameras.json", given)


@pytest.mark.parametrize(("images", "sentence"), [
    ("nowhere", "nowhere: there is no such file or folder"),
    (3, "images must be the path of the photographs' scene, or a Scene, got an int"),
])  # fmt: skip
def test_what_is_no_scene_of_photographs_is_refused(images, sentence):
    with pytest.raises(MipmapPluginError, match=sentence):
        wrap_model(tiny.model(10), cameras=tiny.cameras()).adapt(2, images=images)


@pytest.mark.parametrize(("change", "sentence"), [
    (dict(means=np.zeros((10, 3))), "means: expected a torch tensor, got ndarray"),
    (dict(sh=None), "sh: expected a torch tensor, got NoneType"),
    (dict(means=torch.tensor(1.0)), r"means: expected shape \[0, 3\], got \[\]"),
])  # fmt: skip
def test_what_are_no_splats_is_named(change, sentence):
    with pytest.raises(ShapeError, match=sentence):
        replace(tiny.gaussians(10), **change)


def test_outputs_may_be_none(adapted):
    assert adapted.render(adapted.views()[0], outputs=None).depth is None


def test_a_ladder_is_a_line_in_a_notebook():
    assert repr(Ladder(SimpleNamespace(levels=[1, 2]), None, None)) == "<Ladder: 2 levels>"


@pytest.mark.parametrize("cameras", [[], ()])
def test_an_empty_list_of_cameras_is_no_wish_for_an_orbit(cameras):
    with pytest.raises(SettingsError, match="cameras: there are none"):
        wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(0.5, cameras=cameras)
