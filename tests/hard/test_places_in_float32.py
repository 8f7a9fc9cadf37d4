"""Splats in float32 whose place or shape on the image is a small difference of large numbers: every digit that their numbers hold is used."""

import importlib.util
from dataclasses import replace

import pytest
import torch

from mipmap_plugin.backends import geometry, get_backend
from mipmap_plugin.backends.conformance.cases import HardCase, crowd, view
from mipmap_plugin.backends.conformance.checks import check_case
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.screen_filters import USUAL_EPS2D
from mipmap_plugin.splatting.precision import finest
from mipmap_plugin.splatting.projection import covariances_of

BACKENDS = ["reference", "cpu"] if importlib.util.find_spec("numba") else ["reference"]


def from_afar(far: float, effects: Effects) -> HardCase:
    """A crowd `far` units from the world's origin, seen from an eye that lies between two numbers of float32."""
    splats, camera = crowd(), view(turned=True)
    eye = torch.tensor([far, -far, far], dtype=torch.float64) + 0.021
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return HardCase(replace(splats, means=splats.means + eye, scales=splats.scales + 0.2), camera.looking_from(viewmat, ""), effects)


def through_a_telescope(effects: Effects, focal: float = 1e6) -> HardCase:
    """A crowd of ordinary size on the image, in a narrow tube along the line of sight: pixels are small differences of large numbers."""
    splats, pose = crowd(), view(turned=True).viewmat
    narrow = 24 / focal
    means = splats.means * torch.tensor([narrow, narrow, 1.0], dtype=torch.float64)
    world = (means - pose[:3, 3]) @ pose[:3, :3]
    return HardCase(replace(splats, means=world, scales=splats.scales * narrow), Camera(24, 18, focal, focal, 12, 9, pose), effects)


def of_needles(effects: Effects) -> HardCase:
    """Needles of a thousandth of a pixel by a hundred pictures, whose covariances are handed over."""
    splats = crowd()
    needles = replace(splats, scales=torch.tensor([[100.0, 1e-4, 2e-4]], dtype=torch.float64).expand(len(splats), 3))
    return HardCase(replace(needles, covariances=covariances_of(needles)), view(turned=True), effects)


def filtered(name: str) -> Effects:
    return Effects(1, name, USUAL_EPS2D.get(name, 0.5))


CASES = {
    **{f"from afar, {name}": lambda name=name: from_afar(1e5, filtered(name)) for name in (*USUAL_EPS2D, SURFEL)},
    "from afar, in linear light": lambda: from_afar(1e5, Effects(1, settings=RenderSettings(linear_light=2.2))),
    "from afar, by distance": lambda: from_afar(1e5, Effects(1, settings=RenderSettings(radial=True))),
    **{f"through a telescope, {name}": lambda name=name: through_a_telescope(filtered(name)) for name in USUAL_EPS2D},
    **{f"covariances of needles, {name}": lambda name=name: of_needles(filtered(name)) for name in ("classic", "antialiased", "mip")},
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", CASES)
def test_float32_equals_float64(name, backend):
    outcome = check_case(get_backend(backend), name, CASES[name])
    if outcome.skipped:
        pytest.skip(outcome.message)
    assert outcome.passed, outcome.message


def test_depths_far_from_the_origin_equal_those_in_float64():
    case = from_afar(1e5, Effects(1))
    single = case.gaussians.to(dtype=torch.float32)
    one, two = (geometry.depth(get_backend("reference"), g, case.camera, case.effects) for g in (single, single.to(dtype=torch.float64)))
    assert one.dtype == torch.float32
    torch.testing.assert_close(one.double(), two, rtol=1e-5, atol=1e-5)


def test_a_device_without_float64_places_splats_in_float32():
    assert [finest(torch.device(name)) for name in ("cpu", "cuda", "mps")] == [torch.float64, torch.float64, torch.float32]
