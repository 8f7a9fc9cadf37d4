"""What Python is given in place of what it should be: tensors, numbers, paths, plug-ins, lists, ...

Either it is understood, or one error of ours says what to give, in place of torch's or Python's.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from torch_checkpoints import splats

from mipmap_plugin import Camera, Effects, Gaussians, load_model, wrap_model
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import digest_of
from mipmap_plugin.errors import MipmapPluginError, SceneError, SettingsError, ShapeError
from mipmap_plugin.levels.finished import Ladder
from mipmap_plugin.scenes import load_scene, write_cameras

pytestmark = pytest.mark.usefixtures("few_views")

VIEW = {"width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0, "viewmat": torch.eye(4)}


@pytest.mark.parametrize(("name", "value"), [
    ("sh_degree", "x"), ("sh_degree", 1.5), ("sh_degree", -1), ("screen_filter", 3), ("eps2d", "0.3"), ("eps2d", math.nan), ("eps2d", torch.ones(2)),
    ("background", 1), ("background", (0, 0, math.nan)), ("background", "abc"), ("supersampling", 2.0), ("supersampling", None),
    ("near_plane", "x"), ("near_plane", -1.0), ("near_plane", math.nan), ("near_plane", math.inf),
    ("settings", None), ("outputs", 3), ("outputs", "depth"), ("exposure", []),
])  # fmt: skip
def test_effects_of_the_wrong_kind_are_named(name, value):
    with pytest.raises(SettingsError, match=name):
        Effects(**{name: value})


def test_a_sparse_pose_is_one():
    assert torch.equal(Camera(**VIEW | {"viewmat": torch.eye(4).to_sparse()}).viewmat, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("given", [torch.ones(3, 3), np.ones((2, 4, 4)), "x", torch.ones(2).to_sparse(), torch.eye(4, device="meta")])
def test_what_is_no_pose_is_named(given):
    for make in (lambda: Camera(**VIEW | {"viewmat": given}), lambda: Camera.of_matrices(given, np.eye(3), 8, 6)):
        with pytest.raises(ShapeError, match=r"^viewmat: expected"):
            make()
    with pytest.raises(ShapeError, match=r"^c2w: expected"):
        Camera.of_opengl(given, np.eye(3), 8, 6)


@pytest.mark.parametrize(("name", "value"), [("fx", torch.tensor(1 + 1j)), ("width", -1), ("cx", math.nan), ("split", np.ones(3))])
def test_what_is_no_number_of_a_camera_is_named(name, value):
    with pytest.raises(SettingsError, match="camera"):
        Camera(**VIEW | {name: value})


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda tensor: tensor.int(), "floating-point"),
    (lambda tensor: tensor.to_sparse(), "dense"),
    (lambda tensor: tensor.numpy(), "expected a torch tensor, got ndarray"),
])  # fmt: skip
def test_splats_of_other_kinds_of_tensors_are_named(change, sentence):
    with pytest.raises(ShapeError, match=sentence):
        Gaussians(**{name: change(tensor) for name, tensor in tiny.gaussians(3).tensors().items()})


@pytest.mark.parametrize(("change", "sentence"), [
    (dict(sh=None), "sh: expected a torch tensor, got NoneType"),
    (dict(means=torch.tensor(1.0)), r"means: expected shape \[0, 3\], got \[\]"),
])  # fmt: skip
def test_what_are_no_splats_is_named(change, sentence):
    with pytest.raises(ShapeError, match=sentence):
        replace(tiny.gaussians(10), **change)


@pytest.mark.parametrize(("call", "error", "sentence"), [
    (lambda splats: splats.to("nowhere"), SettingsError, "splats cannot be moved .device='nowhere', dtype=None.: Expected one of cpu"),
    (lambda splats: splats.to(torch.float64), SettingsError, "splats cannot be moved .device=torch.float64"),
    (lambda splats: splats.to(dtype=torch.int32), ShapeError, "means: expected floating-point numbers"),
    (lambda splats: splats[0], ShapeError, "splats are chosen by a mask, a list of indices or a slice, got an int"),
    (lambda splats: splats["means"], ShapeError, "got a str"),
    (lambda splats: splats[torch.tensor([[0, 1]])], ShapeError, "got a Tensor"),
    (lambda splats: splats[torch.tensor([True, False])], IndexError, r"a mask of 3 splats has shape \[3\], not \[2\]"),
    (lambda splats: splats.joined(3), ShapeError, r"only splats of one kind can be joined \(SH degree 1, float32 on cpu\), got 3"),
    (lambda splats: splats.joined(splats.to(dtype=torch.float64)), ShapeError, "float64 on cpu"),
    (lambda splats: splats.joined(splats.to("meta")), ShapeError, "float32 on meta"),
    (lambda splats: splats.joined(replace(splats, sh=splats.sh[:, :1])), ShapeError, "SH degree 0"),
    (lambda splats: splats.joined(replace(splats, covariances=torch.eye(3).expand(3, 3, 3))), ShapeError, "with covariances"),
])  # fmt: skip
def test_what_cannot_be_done_with_splats_is_one_sentence(call, error, sentence):
    with pytest.raises(error, match=sentence):
        call(tiny.gaussians(3))


@pytest.mark.parametrize(("call", "sentence"), [
    (lambda base: base.effects(supersampling="2"), "supersampling"),
    (lambda base: base.render(base.views()[0], supersampling=np.ones(3)), "supersampling"),
    (lambda base: base.render(base.views()[0], scale=torch.tensor(1 + 1j)), "^scale"),
    (lambda base: base.adapt(0.5, cameras=torch.tensor(1.0)), "^cameras must be of the type"),
    (lambda base: base.adapt(0.5, cameras="cameras.json"), "^cameras must be of the type"),
    (lambda base: base.adapt(0.5, cameras=[]), "^cameras: there are none"),
    (lambda base: base.place(3), "^images must be the path"),
    (lambda base: base.refuse_output(3, overwrite=False), "^path must be a text"),
    (lambda base: base.refuse_undrawn([3]), "^cameras must be of the type"),
    (lambda base: base.refuse_undrawn(scale="x"), "^scale"),
    (lambda base: load_model(np.ones(3)), "path"),
])  # fmt: skip
def test_arguments_of_the_wrong_kind_are_named(call, sentence):
    base = wrap_model(tiny.model(5), cameras=tiny.cameras(2, width=8, height=6), backend="reference")
    with pytest.raises(SettingsError, match=sentence):
        call(base)


@pytest.fixture
def adapted():
    return wrap_model(tiny.model(10), cameras=tiny.cameras(), backend="reference").adapt(1 / 2, recipe="instant")


@pytest.mark.parametrize(("options", "sentence"), [
    (dict(backend="gpu"), "there is no backend 'gpu'; choose from"),
    (dict(backend=ReferenceBackend), "backends are given by their names, got type"),
    (dict(threads="2"), "threads must be at least 1, got '2'"),
    (dict(threads=np.ones(2)), "^threads must be at least 1"),
    (dict(cameras=""), "^cameras must be a text such as .*, got an empty text$"),
    (dict(cameras=[3]), "^cameras must be of the type mipmap_plugin.Camera, got int"),
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


def test_outputs_may_be_none(adapted):
    assert adapted.render(adapted.views()[0], outputs=None).depth is None


def test_a_ladder_is_a_line_in_a_notebook():
    assert repr(Ladder(SimpleNamespace(levels=[1, 2]), None, None)) == "<Ladder: 2 levels>"
