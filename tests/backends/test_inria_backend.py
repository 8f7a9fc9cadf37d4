"""The arguments that INRIA's rasterizer is called with, in both generations, and that they describe the reference's image."""

import importlib.util
import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import inria_stand_in
import pytest
import torch
from samples import camera, gaussians

from mipmap_plugin.backends import BACKENDS, survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.conformance import CASES, check_backend
from mipmap_plugin.backends.external import NO_CUDA
from mipmap_plugin.backends.inria import NO_PACKAGE, OLDER, PACKAGE, Frame, InriaBackend, splats_of
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.render_settings import RenderSettings

USUAL = Needs("cuda", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")
WIDE = camera(50, 40, 30.0, 26.0, cx=21.3, cy=18.9)

# Its covariance is squared before its determinant is taken: axes 10⁶ times apart are more than float32 has digits for.
FEWER_DIGITS = {f"needle-1e12-{kind}" for kind in ("classic", "antialiased", "mip")}


class OnProcessor(InriaBackend):
    capabilities = replace(InriaBackend.capabilities, devices=frozenset({"cpu"}))

    def lacking(self, needs):
        return self.capabilities.lacking(needs)


@pytest.fixture(params=[False, True], ids=["older", "newer"])
def package(request, monkeypatch):
    stand_in = inria_stand_in.package(request.param)
    monkeypatch.setitem(sys.modules, PACKAGE, stand_in)
    return stand_in


def is_newer(package) -> bool:
    return package.GaussianRasterizationSettings._fields != OLDER


def test_the_arguments_are_those_of_the_rasterizer(package):
    splats = gaussians(20, 2, dtype=torch.float32)
    OnProcessor().render(splats, WIDE, Effects(1, background=(0.2, 0.5, 0.9)))
    ((settings, shs, packed),) = package.received
    assert (settings.image_height, settings.image_width, settings.sh_degree) == (40, 50, 1)
    assert (settings.tanfovx, settings.tanfovy) == (50 / 60, 40 / 52)
    assert (settings.scale_modifier, settings.prefiltered, settings.debug) == (1.0, False, False)
    assert settings.bg.tolist() == pytest.approx([0.2, 0.5, 0.9])
    assert shs is splats.sh and packed is None
    assert settings.viewmatrix[3, :3].tolist() == [0.0, 0.0, 0.0]  # row vectors, and the eye is the origin
    torch.testing.assert_close(settings.viewmatrix[:3, :3].T.double(), WIDE.viewmat[:3, :3], atol=1e-7, rtol=0)
    assert (settings._asdict().get("antialiasing", False)) is False


def test_shapes_lie_row_by_row_in_memory():
    """The rasterizer's backward pass does not ask how they lie."""
    splats = gaussians(20, dtype=torch.float32)
    turned = replace(splats, scales=splats.scales.T.contiguous().T, quats=splats.quats.T.contiguous().T)
    passed, usual = splats_of(turned), splats_of(splats)
    assert all(passed[name].is_contiguous() and torch.equal(passed[name], usual[name]) for name in ("scales", "rotations"))


def test_a_point_projects_to_where_the_camera_says(package):
    OnProcessor().render(gaussians(2, dtype=torch.float32), WIDE, Effects(1))
    point = torch.tensor([0.4, -0.3, 2.0, 1.0])
    seen = (point @ package.received[0][0].projmatrix).double()
    x, y, z = (WIDE.viewmat[:3, :3] @ point[:3].double()).tolist()
    pixel = [(float(seen[axis] / seen[3]) + 1) / 2 * size for axis, size in enumerate((50, 40))]
    assert pixel == pytest.approx([30 * x / z + 21.3, 26 * y / z + 18.9], abs=1e-5)


@pytest.mark.parametrize(("kind", "eps2d"), [("classic", 0.3), ("classic", 4.8), ("classic", 0.3 / 64), ("antialiased", 0.3), ("mip", 0.1)])
def test_its_own_filter_is_used_where_possible(package, kind, eps2d):
    OnProcessor().render(gaussians(20, dtype=torch.float32), WIDE, Effects(1, kind, eps2d))
    settings, _, packed = package.received[0]
    own = eps2d == 0.3 and (kind == "classic" or (kind == "antialiased" and is_newer(package)))
    assert (packed is None) == own
    assert settings._asdict().get("antialiasing", False) == (own and kind == "antialiased")


def test_it_draws_the_reference_but_for_extreme_needles(package):
    cases = {name: build for name, build in CASES.items() if not name.startswith("10000")}  # large and slow, and alike in every backend
    outcomes = check_backend(OnProcessor(), cases)
    assert {outcome.case for outcome in outcomes if not outcome.passed} == FEWER_DIGITS
    skipped = {outcome.case for outcome in outcomes if outcome.skipped}
    integrated = {case for case in cases if case.endswith(("analytic", "window")) or "analytic-" in case or "window-" in case}
    assert skipped == integrated | {case for case, build in cases.items() if build().effects.settings != RenderSettings()} | {"sh-degree-4"}


def test_alpha_is_rendered_on_first_access(package):
    splats = gaussians(40, dtype=torch.float32)
    rendered = OnProcessor().render(splats, WIDE, Effects(1))
    assert len(package.received) == 1
    torch.testing.assert_close(rendered.alpha, ReferenceBackend().render(splats, WIDE, Effects(1)).alpha, atol=1e-5, rtol=0)
    assert rendered.alpha is rendered.alpha and len(package.received) == 2
    assert rendered.replaced(effects=()).alpha is rendered.alpha


@pytest.mark.parametrize("near", [0.0, 0.01, 0.2, 1.5])
def test_the_near_plane_is_the_requested_one(package, near):
    splats = gaussians(40, dtype=torch.float32)
    splats.means[:4] = 0  # behind the camera or exactly at the eye
    effects = Effects(1, near_plane=near)
    torch.testing.assert_close(
        OnProcessor().render(splats, WIDE, effects).image, ReferenceBackend().render(splats, WIDE, effects).image, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(("center", "left", "width"), [(20.0, 0, 40), (25.9, 0, 40), (26.5, 0, 53), (50.0, 0, 100), (13.5, 13, 53), (-9.0, 58, 98)])
def test_a_principal_point_far_off_comes_to_the_middle(center, left, width):
    view = camera(40, 32, cx=center)
    frame = Frame.around(view)
    assert (frame.columns.start, frame.camera.width, frame.camera.cx) == (left, width, center + left)
    assert abs(frame.camera.cx - width / 2) <= max(0.5, 0.15 * width)
    image = torch.arange(width)[None].expand(32, width)
    assert frame.crop(image)[0].tolist() == list(range(left, left + 40))


@pytest.fixture
def without_package(monkeypatch):
    """No rasterizer is installed; all else is, for other backends remember what they lack."""
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == PACKAGE else find_spec(name))


@pytest.mark.usefixtures("without_package")
def test_what_is_missing_is_reported(monkeypatch):
    assert InriaBackend().lacking(USUAL) == [NO_PACKAGE]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert InriaBackend().lacking(USUAL) == [NO_CUDA]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, PACKAGE, None)
    assert InriaBackend().lacking(USUAL)[0].startswith("diff_gaussian_rasterization does not load: ")
    fork = SimpleNamespace(GaussianRasterizationSettings=SimpleNamespace(_fields=(*OLDER, "kernel_size")))
    monkeypatch.setitem(sys.modules, PACKAGE, fork)
    assert "a fork with other settings: image_height" in InriaBackend().lacking(USUAL)[0]
    monkeypatch.setitem(sys.modules, PACKAGE, inria_stand_in.package(True))
    assert InriaBackend().lacking(USUAL) == []
    assert InriaBackend().lacking(replace(USUAL, sh_degree=4)) == ["it evaluates SH up to degree 3, not 4"]


@pytest.mark.usefixtures("without_package")
def test_it_is_listed_with_its_reasons_and_refuses():
    assert "inria" in BACKENDS.names()
    assert survey(replace(USUAL, device="cpu"))["inria"] == [NO_PACKAGE, "it runs on cuda, not on cpu"]
    with pytest.raises(BackendUnavailable, match="backend 'inria' cannot do this: it needs diff_gaussian_rasterization"):
        InriaBackend().render(gaussians(2, dtype=torch.float32), WIDE, Effects(1))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available() or bool(InriaBackend().lacking(USUAL)), reason="there is no GPU, or no rasterizer for it")
def test_the_rasterizer_itself_draws_the_reference():
    """Within what its footprint leaves out, a rim of at most exp(-9/2) of an opacity; so without the suite's tolerances."""
    splats = gaussians(200, dtype=torch.float32).to("cuda")
    actual = InriaBackend().render(splats, WIDE, Effects(1))
    right = ReferenceBackend().render(splats, WIDE, Effects(1))
    assert float((actual.image - right.image).abs().max()) < 2 * math.exp(-4.5)
    assert float((actual.image - right.image).square().mean()) < 1e-6
