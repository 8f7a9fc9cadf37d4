"""Records and methods of the API given tensors, arrays and numbers of the wrong kind: one error of ours, in place of torch's or Python's."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin import Camera, Effects, Gaussians, load_model, wrap_model
from mipmap_plugin.errors import SettingsError, ShapeError

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


@pytest.mark.parametrize(("call", "error", "sentence"), [
    (lambda splats: splats.to("nowhere"), SettingsError, "splats cannot be moved .device='nowhere', dtype=None.: Expected one of cpu"),
    (lambda splats: splats.to(torch.float64), SettingsError, "splats cannot be moved .device=torch.float64"),
    (lambda splats: splats.to(dtype=torch.int32), ShapeError, "means: expected floating-point numbers"),
    (lambda splats: splats[0], ShapeError, "splats are chosen by a mask, a list of indices or a slice, got an int"),
    (lambda splats: splats["means"], ShapeError, "got a str"),
    (lambda splats: splats[torch.tensor([[0, 1]])], ShapeError, "got a Tensor"),
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
    (lambda base: base.place(3), "^images must be the path"),
    (lambda base: base.refuse_output(3, overwrite=False), "^path must be a text"),
    (lambda base: base.refuse_undrawn([3]), "^cameras must be of the type"),
    (lambda base: base.refuse_undrawn(scale="x"), "^scale"),
    (lambda base: wrap_model(base.model, threads=np.ones(2)), "^threads"),
    (lambda base: load_model(np.ones(3)), "path"),
])  # fmt: skip
def test_arguments_of_the_wrong_kind_are_named(call, sentence):
    base = wrap_model(tiny.model(5), cameras=tiny.cameras(2, width=8, height=6), backend="reference")
    with pytest.raises(SettingsError, match=sentence):
        call(base)
