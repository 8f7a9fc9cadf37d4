"""The CPU backend against a brute-force float64 sum, and errors that only compiled, threaded code can have."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from oracle import brute_force
from samples import camera, gaussians

from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.viewers import BUILT_IN

pytestmark = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba, the extra `cpu`, is not installed")
BACKEND = CpuBackend()

# Three tiles across with the last one cut, and three down; off center, fx != fy.
WIDE = camera(150, 40, 90.0, 70.0, cx=61.3, cy=24.9)


@pytest.fixture
def threads_for_any_work(monkeypatch):
    """Use as many threads as torch, even for little work."""
    from mipmap_plugin.backends.cpu_kernels import threads

    monkeypatch.setattr(threads, "MIN_WORK", 0)
    monkeypatch.setattr(threads, "LEAST_ROWS", 16)
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def leaf(g: Gaussians) -> Gaussians:
    return Gaussians(**{name: tensor.detach().clone().requires_grad_() for name, tensor in g.tensors().items()})


def gradients(image: torch.Tensor, alpha: torch.Tensor, g: Gaussians) -> dict[str, torch.Tensor]:
    """The gradients of a fixed weighted sum of all pixels, by the name of the tensor."""
    weights = torch.randn(*alpha.shape, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64).to(image)
    loss = (image * weights[..., :3]).sum() + (alpha * weights[..., 3]).sum()
    loss.backward()
    return {name: tensor.grad.double() for name, tensor in g.tensors().items() if tensor.grad is not None}


def draw(g: Gaussians, view, effects: Effects):
    """The image, alpha and gradients of the CPU backend."""
    g = leaf(g.to(dtype=torch.float32))
    rendered = BACKEND.render(g, view, effects)
    return rendered.image.detach(), rendered.alpha.detach(), gradients(rendered.image, rendered.alpha, g)


def assert_gradients_close(actual, expected, relative=2e-5):
    assert set(actual) == set(expected)
    for name, grad in expected.items():
        assert (actual[name] - grad).norm() <= relative * grad.norm(), name


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased", "mip", "analytic", "window"])
@pytest.mark.parametrize("view", [camera(), WIDE], ids=["one-tile", "many-tiles"])
def test_equals_a_sum_over_every_pixel(view, screen_filter):
    count = 20 if screen_filter == "window" else 80  # its sum is slow
    g = leaf(gaussians(count, dtype=torch.float32).to(dtype=torch.float64))  # the same numbers in both precisions
    effects = Effects(1, screen_filter, background=(0.2, 0.5, 0.9))
    expected_image, expected_alpha = brute_force(g, view, effects.eps2d, effects.background, screen_filter)
    image, alpha, grads = draw(g, view, effects)
    torch.testing.assert_close(image.double(), expected_image.detach(), atol=5e-6, rtol=0)
    torch.testing.assert_close(alpha.double(), expected_alpha.detach(), atol=5e-6, rtol=0)
    assert_gradients_close(grads, gradients(expected_image, expected_alpha, g))


def test_pixels_stop_at_the_least_transmittance():
    g = gaussians(300, dtype=torch.float32)
    g = leaf(replace(g, opacities=0.9 + 0.1 * g.opacities, scales=3 * g.scales).to(dtype=torch.float64))
    expected_image, expected_alpha = brute_force(g, camera())
    assert (expected_alpha > 0.999).double().mean() > 0.5
    image, _, grads = draw(g, camera(), Effects(1))
    torch.testing.assert_close(image.double(), expected_image.detach(), atol=5e-6, rtol=0)
    assert_gradients_close(grads, gradients(expected_image, expected_alpha, g), 1e-4)


@pytest.mark.parametrize(("count", "opacity", "settings"), [
    (3, 1.0, RenderSettings(max_alpha=1.0, min_transmittance=0.0)),
    (20, 1.0, RenderSettings(max_alpha=0.999, min_transmittance=0.0)),
    (60, 0.9, RenderSettings(max_alpha=0.999, min_transmittance=0.0)),
])  # fmt: skip
def test_gradients_of_splats_that_let_nothing_through_are_right(count, opacity, settings):
    """What is left of a pixel is less than float32 holds, or nothing; the backward pass divides by it."""
    depths = torch.linspace(1.0, 2.0, count)
    means = torch.stack([depths * 0, depths * 0, depths], 1)
    splats = Gaussians(means, torch.eye(4)[:1].expand(count, 4), torch.full((count, 3), 5.0), torch.full((count,), opacity), torch.rand(count, 1, 3))
    view, effects = Camera(5, 5, 10.0, 10.0, 2.5, 2.5, torch.eye(4)), Effects(0, settings=settings)
    grads, images = [], []
    for backend, dtype in ((BACKEND, torch.float32), (ReferenceBackend(), torch.float64)):
        own = leaf(splats.to(dtype=dtype))
        rendered = backend.render(own, view, effects)
        images.append(rendered.image.detach().double())
        grads.append(gradients(rendered.image, rendered.alpha, own))
    torch.testing.assert_close(*images, atol=1e-5, rtol=1e-5)
    for name in ("means", "sh"):
        torch.testing.assert_close(grads[0][name], grads[1][name], atol=1e-5 * float(grads[1][name].abs().max()), rtol=1e-3)


def test_every_harmonic_has_its_gradient():
    g = leaf(gaussians(30, 4, dtype=torch.float32).to(dtype=torch.float64))
    reference = ReferenceBackend().render(g, camera(), Effects(4))
    image, _, grads = draw(g, camera(), Effects(4))
    torch.testing.assert_close(image.double(), reference.image.detach(), atol=5e-6, rtol=0)
    assert_gradients_close(grads, gradients(reference.image, reference.alpha, g))


def test_covariances_need_not_be_symmetric_to_have_their_gradient():
    g = gaussians(40, dtype=torch.float32).to(dtype=torch.float64)
    factor = torch.randn(40, 3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * g.scales[:, None]
    g = leaf(replace(g, covariances=(factor @ factor.mT).float().double()))
    reference = ReferenceBackend().render(g, camera(), Effects(1))
    grads = draw(g, camera(), Effects(1))[2]
    expected = gradients(reference.image, reference.alpha, g)
    assert "scales" not in grads
    assert_gradients_close(grads, {name: grad for name, grad in expected.items() if name in grads})


@pytest.mark.parametrize("screen_filter", ["analytic", "window"])
def test_splats_that_are_integrated_are_blended_in_linear_light_too(screen_filter):
    splats, effects = gaussians(20).to(dtype=torch.float32), Effects(1, screen_filter, settings=RenderSettings(linear_light=2.2))
    assert BACKEND.lacking(Needs.of(splats, effects, gradients=True)) == []
    expected = ReferenceBackend().render(splats, WIDE, effects).image
    torch.testing.assert_close(BACKEND.render(splats, WIDE, effects).image, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("cut_off", [{"min_alpha": 0.02}, {"min_transmittance": 0.1}, {"radius": 2.0}, {"frame": 0.7}], ids=str)
def test_splats_that_are_integrated_are_drawn_with_the_usual_cut_offs_only(cut_off):
    needs = Needs.of(gaussians(20).to(dtype=torch.float32), Effects(1, "window", settings=RenderSettings(**cut_off)), gradients=True)
    assert BACKEND.lacking(needs) == ["it draws the screen filter window with the usual cut-offs only"]


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased", "mip", "analytic", "window"])
def test_the_number_of_threads_changes_no_bit(screen_filter, threads_for_any_work):
    g = gaussians(2000)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        results.append(draw(g, WIDE, Effects(1, screen_filter)))
    for image, alpha, grads in results[1:]:
        assert torch.equal(image, results[0][0]) and torch.equal(alpha, results[0][1])
        assert all(torch.equal(grad, results[0][2][name]) for name, grad in grads.items())


IN_PARTS = """
import hashlib, sys, torch
from mipmap_plugin.backends.cpu_kernels import lanes
torch.set_num_threads(1)
lanes.PART = int(sys.argv[1])
from test_cpu_backend import WIDE, Effects, draw, gaussians
image, alpha, grads = draw(gaussians(1003, 3), WIDE, Effects(3))
print(*(hashlib.sha256(part.numpy().tobytes()).hexdigest() for part in (image, alpha, *grads.values())))
"""


@pytest.mark.slow
def test_how_many_numbers_a_register_holds_changes_no_bit(tmp_path):
    """Processors with AVX-512 compute the geometry of 8 splats at a time, others that of 4; either can be compiled anywhere."""
    printed = []
    for part in ("4", "8"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / part), "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-c", IN_PARTS, part]
        printed.append(subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout)
    assert printed[0] == printed[1] and len(printed[0].split()) == 7


SHOTS = [
    (WIDE, Effects(1)), (camera(40, 30, 50.0, 50.0), Effects(1, "analytic", background=(0.2, 0.4, 0.6))), (WIDE, Effects(0, "window")),
    (camera(40, 30, 50.0, 50.0), Effects(1, settings=RenderSettings(bucketed=True, picture_step=1 / 255))),
]  # fmt: skip


def test_views_of_any_effects_drawn_in_one_call_are_those_drawn_alone(threads_for_any_work):
    g = gaussians(2000, dtype=torch.float32)
    alone, together = leaf(g), []
    images = [BACKEND.render(alone, *shot).image for shot in SHOTS]
    sum(image.square().sum() for image in images).backward()
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        leaves = leaf(g)
        drawn = BACKEND.render_views(leaves, SHOTS)
        assert all(torch.equal(rendered.image, image) for rendered, image in zip(drawn, images, strict=True))
        sum(rendered.image.square().sum() for rendered in drawn).backward()
        together.append(leaves)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        first, *others = (getattr(leaves, name).grad for leaves in together)
        assert all(torch.equal(other, first) for other in others)
        torch.testing.assert_close(first, getattr(alone, name).grad, atol=1e-5 * float(first.abs().max()), rtol=1e-4)


def test_packed_views_are_packed_for_each_camera():
    packed = next(viewer for viewer in BUILT_IN if viewer.settings.packing).effects(Effects(1))
    g, shots = gaussians(300, dtype=torch.float32), [(each, packed) for each, _ in SHOTS[:2]]
    drawn = BACKEND.render_views(g, shots)
    assert all(torch.equal(rendered.image, BACKEND.render(g, *shot).image) for rendered, shot in zip(drawn, shots, strict=True))


@pytest.mark.parametrize("size", [1e4, 1e8, 1e20, 1e38])
def test_splats_whose_size_overflows_an_integer_are_finite(size):
    g = gaussians(20, dtype=torch.float32)
    g.scales[:5] = size
    g.means[5:10, :2] = size / 10
    image, alpha, grads = draw(g, camera(33, 17), Effects(1, near_plane=1e-3))
    assert torch.isfinite(image).all() and torch.isfinite(alpha).all()
    assert all(torch.isfinite(grad).all() for grad in grads.values())


def test_an_input_changed_before_the_backward_pass_is_noticed():
    g = leaf(gaussians(20, dtype=torch.float32))
    rendered = BACKEND.render(g, camera(), Effects(1))
    with torch.no_grad():
        g.scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        rendered.image.sum().backward()


def test_only_tensors_that_require_gradients_get_them():
    g = gaussians(20, dtype=torch.float32)
    g = replace(g, means=g.means.requires_grad_())
    BACKEND.render(g, camera(), Effects(1)).alpha.sum().backward()
    expected = g.means.grad.clone()
    assert g.means.grad.any() and g.sh.grad is None
    g = leaf(g)
    BACKEND.render(g, camera(), Effects(1)).alpha.sum().backward()
    assert torch.equal(g.means.grad, expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_draws_with_threads_of_its_own(threads_for_any_work):
    torch.set_num_threads(2)
    g = gaussians(200, dtype=torch.float32)
    expected = BACKEND.render(g, WIDE, Effects(1)).image
    child = os.fork()
    if child == 0:
        os._exit(0 if torch.equal(BACKEND.render(g, WIDE, Effects(1)).image, expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_torch_still_works_after_its_idle_threads_were_dismissed(threads_for_any_work):
    torch.set_num_threads(2)
    values = torch.rand(100_000)
    expected = values.exp().sum()
    for _ in range(3):
        BACKEND.render(gaussians(20, dtype=torch.float32), camera(), Effects(1))
        assert torch.equal(values.exp().sum(), expected)
