"""Depth and normals besides the image: of known shapes, by any backend, and at no cost where they are not requested."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from tiny import wrapped

from mipmap_plugin import cli
from mipmap_plugin.backends import geometry, get_backend
from mipmap_plugin.backends.conformance.cases import CASES
from mipmap_plugin.backends.geometry import facing
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import rotations
from mipmap_plugin.wrap import wrap_model

BOTH = ("depth", "normals")
WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(params=["reference", "cpu"])
def backend(request):
    if request.param == "cpu":
        pytest.importorskip("numba")
    return request.param


def view():
    return tiny.cameras(1)[0]


def flat(means: torch.Tensor, quat, size: float, opacity: float = 0.9) -> Gaussians:
    """Discs `size` wide, whose shortest axis is the local z."""
    n = len(means)
    scales = torch.tensor([size, size, size / 1000]).expand(n, 3)
    return Gaussians(means.float(), torch.tensor(quat).float().expand(n, 4), scales, torch.full((n,), opacity), 0.3 * torch.ones(n, 1, 3))


def sheet(camera, distance: float, opacity: float = 0.9) -> Gaussians:
    """Discs that fill the view, all of them `distance` before the eye along the optical axis."""
    steps = torch.linspace(-0.6, 0.6, 9, dtype=torch.float64)
    x, y = torch.meshgrid(steps, steps, indexing="xy")
    seen = torch.stack([x.flatten(), y.flatten(), torch.ones(81, dtype=torch.float64)], -1) * distance
    to_world = torch.linalg.inv(camera.viewmat)
    turned = quaternion(to_world[:3, :3])
    return flat(seen @ to_world[:3, :3].T + to_world[:3, 3], turned, 0.1 * distance, opacity)


def quaternion(rotation: torch.Tensor) -> list[float]:
    """wxyz of a rotation [3, 3] by less than half a turn."""
    w = math.sqrt(1 + rotation.trace()) / 2
    skew = (rotation - rotation.T) / (4 * w)
    return [w, skew[2, 1].item(), skew[0, 2].item(), skew[1, 0].item()]


# Depth


@pytest.mark.parametrize("distance", [0.5, 3.0, 1e5])
def test_the_depth_of_a_plane_is_its_distance_along_the_axis_even_in_the_corners(backend, distance):
    rendered = wrapped(sheet(view(), distance), backend, background=WHITE).render(view(), outputs=["depth"])
    assert rendered.alpha.min() > 0.1 and rendered.depth.shape == rendered.alpha.shape
    torch.testing.assert_close(rendered.depth, torch.full_like(rendered.depth, distance), rtol=2e-6, atol=0)


def test_the_depth_of_what_is_very_near_is_as_exact(backend):
    camera = replace(view(), viewmat=torch.eye(4))
    rendered = wrapped(sheet(camera, 0.002), backend, near_plane=0.001).render(camera, outputs=["depth"])
    torch.testing.assert_close(rendered.depth, torch.full_like(rendered.depth, 0.002), rtol=2e-6, atol=0)


def test_behind_a_veil_the_depth_is_the_mean_of_what_is_seen(backend):
    at = torch.linalg.inv(view().viewmat) @ torch.tensor([[0, 0, 2, 1], [0, 0, 5, 1]], dtype=torch.float64).T
    splats = flat(at.T[:, :3], [1.0, 0, 0, 0], 50.0)
    splats = replace(splats, scales=torch.full((2, 3), 50.0), opacities=torch.tensor([0.5, 0.8]))
    rendered = wrapped(splats, backend).render(view(), outputs=["depth"]).depth
    expected = (0.5 * 2 + 0.5 * 0.8 * 5) / (0.5 + 0.5 * 0.8)
    torch.testing.assert_close(rendered[12, 16], torch.tensor(expected), rtol=1e-3, atol=0)


@pytest.mark.parametrize("n", [1, 2])
def test_where_nothing_is_there_is_no_depth_and_no_direction_whatever_the_background(backend, n):
    splats = tiny.gaussians(3, spread=0.05)
    rendered = wrapped(splats, backend, background=WHITE).render(view(), outputs=BOTH, supersampling=n)
    empty = rendered.alpha == 0
    assert empty.any() and not empty.all()
    assert (rendered.depth[empty] == 0).all() and (rendered.normals[empty] == 0).all()
    assert (rendered.depth[~empty] > 1).all()
    torch.testing.assert_close(rendered.normals[~empty].norm(dim=-1), torch.ones(int((~empty).sum())))


def test_samples_are_averaged_by_what_they_show(backend):
    rendered = wrapped(sheet(view(), 3.0), backend).render(view(), outputs=["depth"], supersampling=3)
    torch.testing.assert_close(rendered.depth, torch.full(view().size, 3.0), rtol=2e-6, atol=0)


# Normals


@pytest.mark.parametrize("opacity", [0.95, 0.02])
@pytest.mark.parametrize("quat", [[1.0, 0, 0, 0], [0.3, -0.5, 0.7, 0.2], [0.1, 0.9, -0.2, 0.4], [0.6, 0.3, 0.6, -0.5]])
def test_the_normal_of_a_disc_is_its_short_axis_on_the_side_that_is_seen(backend, quat, opacity):
    disc = flat(torch.zeros(1, 3), quat, 0.4, opacity)
    axis, camera = rotations(disc.quats)[0, :, 2], view()
    toward = axis * torch.sign(axis @ camera.center.float())
    rendered = wrapped(disc, backend, background=WHITE).render(camera, outputs=["normals"])
    there = rendered.alpha > 0.3 * opacity
    torch.testing.assert_close(rendered.normals[there], toward.expand(int(there.sum()), 3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("short", [0, 1, 2])
def test_the_short_axis_is_found_wherever_it_is_stored(short):
    splats = tiny.gaussians(6)
    splats.scales[:, short] = 1e-4
    expected = rotations(splats.quats)[:, :, short]
    normals = facing(splats, view())
    torch.testing.assert_close((normals * expected).sum(-1).abs(), torch.ones(6))
    assert ((view().center.float() - splats.means) * normals).sum(-1).min() >= 0


def test_covariances_have_the_same_normals_and_a_broken_one_affects_no_other():
    splats = tiny.gaussians(6)
    factors = rotations(splats.quats) * splats.scales[:, None]
    covariances = factors @ factors.mT
    covariances[0] = math.nan
    normals = facing(replace(splats, covariances=covariances), view())
    torch.testing.assert_close(normals[1:], facing(splats, view())[1:], atol=1e-3, rtol=0)


# Hard cases


@pytest.mark.parametrize("screen_filter", ["classic", "mip"])
def test_hard_cases_have_depths_and_directions_that_are_finite(backend, screen_filter):
    able = get_backend(backend)
    cases = {name: CASES[name]() for name in CASES if name.endswith(f"-{screen_filter}")}
    assert len(cases) > 40
    for name, case in cases.items():
        scene = able, case.gaussians.to(dtype=torch.float32), case.camera, case.effects
        far, turned = geometry.depth(*scene), geometry.normals(*scene)
        assert far.isfinite().all() and (far >= 0).all() and turned.isfinite().all(), name


# Beside the image


def test_outputs_do_not_change_the_image(backend):
    model = wrapped(tiny.with_bands(2, 3), backend, background=WHITE)
    plain, more = model.render(view()), model.render(view(), outputs=BOTH)
    assert torch.equal(plain.image, more.image) and torch.equal(plain.alpha, more.alpha)
    assert plain.depth is None and plain.normals is None


@pytest.mark.parametrize("outputs", [(), ("depth",), ("normals",), BOTH])
def test_one_more_image_is_rendered_per_output_and_none_without(monkeypatch, outputs):
    model, drawn = wrapped(tiny.with_bands(2, 3)), []
    real = ReferenceBackend.render
    monkeypatch.setattr(ReferenceBackend, "render", lambda *scene: drawn.append(scene[-1]) or real(*scene))
    rendered = model.render(view(), outputs=outputs)
    assert len(drawn) == 1 + len(outputs)
    assert [effects.sh_degree for effects in drawn] == [2] + [0] * len(outputs)
    assert {name for name in BOTH if getattr(rendered, name) is not None} == set(outputs)
    assert {effect.name for effect in rendered.effects if effect.on} & set(BOTH) == set(outputs)


def test_an_adapted_model_renders_outputs_too():
    model = wrapped(tiny.gaussians(30))
    adapted = model.adapt(1 / 4, recipe="instant")
    small = view().zoomed(1 / 4)
    rendered = adapted.render(small, outputs=["depth"])
    assert rendered.depth.shape == small.size and torch.equal(rendered.image, adapted.render(small).image)


class Strange:
    """A backend that knows nothing of outputs, and has the classic filter only."""

    name, api_version, speed = "strange", get_backend("reference").api_version, 0

    def lacking(self, needs):
        return [] if needs.screen_filter == "classic" else ["it has the classic filter only"]

    def render(self, gaussians, camera, effects):
        known = Effects(effects.sh_degree, "classic", effects.eps2d, effects.background)
        return ReferenceBackend().render(gaussians, camera, known)


def test_any_backend_renders_outputs(monkeypatch):
    model = wrapped(tiny.gaussians(30))
    expected = model.render(view(), outputs=BOTH)
    monkeypatch.setattr(type(model), "backend", lambda *_, **__: (Strange(), "for the test"))
    rendered = model.render(view(), outputs=BOTH)
    assert torch.equal(rendered.depth, expected.depth) and torch.equal(rendered.normals, expected.normals)


def test_an_unknown_output_is_refused():
    for name, guess in (("albedo", "$"), ("normal", "; did you mean normals")):
        with pytest.raises(SettingsError, match=f"there is no output '{name}'; choose from depth, normals{guess}"):
            wrapped(tiny.gaussians(3)).render(view(), outputs=[name])


# The command


def test_the_command_writes_arrays_beside_the_pictures(tmp_path, capsys):
    base, out = tiny.folder(tmp_path / "base"), tmp_path / "out"
    words = ["render", str(base), "--output", str(out), "--view", "view_1", "--backend", "reference", "--depth"]
    assert cli.main(words) == 0
    assert sorted(path.name for path in out.iterdir()) == ["train_view_1.png", "train_view_1_depth.npy"]
    model = wrap_model(base, backend="reference")
    [camera] = [camera for camera in model.cameras if camera.name == "view_1"]
    written = np.load(out / "train_view_1_depth.npy")
    assert written.dtype == np.float32
    np.testing.assert_array_equal(written, model.render(camera, outputs=["depth"]).depth.numpy())
    assert cli.main([*words, "--overwrite", "--normals"]) == 0
    assert np.load(out / "train_view_1_normals.npy").shape == (*camera.size, 3)


def test_the_command_replaces_no_array_without_the_option_and_then_writes_nothing(tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "train_view_1_normals.npy").write_text("mine")
    words = ["render", str(tiny.folder(tmp_path / "base")), "--output", str(out), "--backend", "reference", "--normals"]
    assert cli.main(words) == 2
    assert "train_view_1_normals.npy exists already" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["train_view_1_normals.npy"]
