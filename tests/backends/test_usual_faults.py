"""The sentence by which the conformance suite names what a new backend most often does wrong."""

import re
from dataclasses import replace
from functools import partial
from itertools import combinations

import pytest
import torch

from mipmap_plugin.backends import reference, register_backend
from mipmap_plugin.backends.base import Capabilities, Rendered
from mipmap_plugin.backends.conformance import check_backend
from mipmap_plugin.backends.conformance.cases import CASES, random_scene
from mipmap_plugin.backends.conformance.tolerance import TOLERANCE, differing_images
from mipmap_plugin.backends.conformance.usual_faults import EPS2D, FAULTS, usual_fault
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.evaluation import backends as tables
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting import harmonics


class Wrong(ReferenceBackend):
    """Wrong in one thing: what it is given, or what it returns."""

    def __init__(self, given=lambda *parts: parts, returned=lambda rendered, effects: rendered):
        self.given, self.returned = given, returned

    def render(self, gaussians, camera, effects):
        return self.returned(super().render(*self.given(gaussians, camera, effects)), effects)


def without_background(rendered, effects):
    behind = (1 - rendered.alpha)[..., None] * rendered.image.new_tensor(effects.background)
    return Rendered(rendered.image - behind, rendered.alpha)


def with_scales(gradient):
    """A backend whose gradient of the scales is a multiple of the right one."""
    return Wrong(lambda g, *rest: (replace(g, scales=gradient * g.scales + (1 - gradient) * g.scales.detach()), *rest))


def turned(g, *rest):
    return replace(g, quats=g.quats[:, [3, 0, 1, 2]]), *rest


def shifted(by, g, camera, effects):
    """What is seen lies so many px farther to the right and down."""
    return g, replace(camera, cx=camera.cx + by, cy=camera.cy + by), effects


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("backend", "said"),
    [
        (ReferenceBackend(), "^$"),
        (Wrong(returned=without_background), "leaves the background out"),
        (Wrong(partial(shifted, 0.5)), "pixel centers lie at whole numbers"),
        (Wrong(partial(shifted, -0.5)), "shifted by half a pixel to the left and up"),
        (Wrong(lambda g, camera, effects: (g, camera, replace(effects, eps2d=0.3))), "dilates by 0.3 px² always"),
        (Wrong(turned), "reads quaternions as xyzw"),
        (Wrong(returned=lambda rendered, effects: Rendered(rendered.image.flip(0), rendered.alpha.flip(0))), "is upside down"),
        (Wrong(returned=lambda rendered, effects: Rendered(rendered.image.flip(2), rendered.alpha)), "in the order blue, green, red"),
        (Wrong(returned=lambda rendered, effects: Rendered(rendered.image, 1 - rendered.alpha)), "its alpha is the transmittance"),
        (Wrong(lambda g, camera, effects: (g, replace(camera, fy=camera.fx), effects)), "takes fx for fy"),
        (Wrong(lambda g, camera, effects: (g, camera, replace(effects, settings=RenderSettings(radius=3.0)))), "end at three standard deviations"),
        (with_scales(2), "^the gradient of scales is 2 times the right one$"),
        (with_scales(-1), "^the gradient of scales is -1 times the right one$"),
        (with_scales(1.004), "^$"),  # as much as a pixel on a cut-off may do to a right one
        (with_scales(0), "^the gradient of scales is 0 everywhere$"),
        (Wrong(returned=lambda rendered, effects: Rendered(rendered.image.sqrt(), rendered.alpha)), "^$"),  # nothing usual
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(backend, said, dtype):
    assert re.search(said, usual_fault(backend, dtype=dtype))


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_principal_point_taken_for_the_center_is_found(axis):
    def centered(g, camera, effects):
        middle = {"x": dict(cx=camera.width / 2), "y": dict(cy=camera.height / 2)}[axis]
        return g, replace(camera, **middle), effects

    few = {name: CASES[name] for name in ("image-not-of-whole-tiles-classic", "principal-point-off-center-classic")}
    assert [outcome.passed for outcome in check_backend(Wrong(centered), few)] == [True, False]


def test_colors_below_0_are_named(monkeypatch):
    def colors(sh, means, eye, degree):
        rays = torch.nn.functional.normalize(means - eye, dim=-1)
        return (harmonics.basis(rays.to(sh), degree)[..., None] * sh[:, : (degree + 1) ** 2]).sum(1) + 0.5

    class Unclamped(ReferenceBackend):
        def render(self, gaussians, camera, effects):
            with monkeypatch.context() as patched:
                patched.setattr(reference, "colors", colors)
                return super().render(gaussians, camera, effects)

    assert "does not clamp colors" in usual_fault(Unclamped())


@pytest.mark.parametrize("degree", [0, 1])
def test_a_backend_of_float32_and_few_bands_is_judged_by_these(degree):
    class Young(Wrong):
        def lacking(self, needs):
            return Capabilities(None, frozenset({torch.float32}), frozenset({"classic"}), max_sh_degree=degree).lacking(needs)

    assert usual_fault(Young()) == "" and "whole numbers" in usual_fault(Young(partial(shifted, 0.5)))


def test_a_backend_that_has_none_of_the_filters_is_not_judged():
    class Narrow(ReferenceBackend):
        def lacking(self, needs):
            return Capabilities(None, frozenset({torch.float32}), frozenset({"box"})).lacking(needs)

    assert usual_fault(Narrow()) == ""


def test_no_two_faults_look_alike_and_none_looks_right():
    case = random_scene(1, "classic", EPS2D)
    images = [ReferenceBackend().render(case.gaussians, case.camera, case.effects).image, *(mistaken(case) for mistaken in FAULTS.values())]
    assert all(differing_images("image", one, other, TOLERANCE[torch.float32]) for one, other in combinations(images, 2))


def test_the_command_ends_with_what_is_most_likely_wrong(capsys, monkeypatch):
    monkeypatch.setattr(tables, "CASES", {"no-splat": CASES["no-splat"]})
    backend = Wrong(returned=without_background)
    backend.name = "pale"
    register_backend("pale", lambda: backend)
    assert main(["backends", "--check", "pale"]) == 2
    assert capsys.readouterr().err.strip().endswith("; most likely it leaves the background out; add (1 - alpha) * effects.background")
