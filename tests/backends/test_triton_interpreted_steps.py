"""The Triton kernels in Triton's interpreter: several views in one call, and steps."""

from dataclasses import replace

import pytest
import torch
from samples import camera, gaussians
from triton_drawing import MARKS, WIDE, assert_equal, draw

from mipmap_plugin.adaptation.renderers import unrounded
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.conformance import CASES
from mipmap_plugin.backends.conformance.cases import HardCase
from mipmap_plugin.backends.conformance.checks import check_steps, check_views
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import TritonBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.viewers import find_viewer

pytestmark = MARKS

# Of two sizes and two degrees of SH, in two orders of buckets, and with most of the rules of viewers.
OF_VIEWERS = [
    (view, unrounded(find_viewer(name).effects(Effects(1)))) for view, name in ((WIDE, "playcanvas"), (camera(16, 24), "gaussian-splats-3d"))
]
ROUNDED = replace(OF_VIEWERS[1][1], settings=replace(OF_VIEWERS[1][1].settings, picture_step=1 / 255))

RATES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def raw_of(g: Gaussians) -> dict[str, torch.Tensor]:
    """The numbers of splats, as if they were raw parameters."""
    return {name: getattr(g, name).clone() for name in ("means", "quats", "scales", "opacities", "sh")}


def side_by_side(render):
    """What `draw` takes for several views: all of their pixels in one row."""

    def images(splats, _view, _effects):
        drawn = render(splats)
        return torch.cat([each.image.flatten(0, 1) for each in drawn])[None], torch.cat([each.alpha.flatten() for each in drawn])[None]

    return images


@pytest.mark.parametrize("in_order", [False, True])
@pytest.mark.parametrize(
    "shots",
    [[(camera(12, 10), Effects(1)), (camera(8, 9), Effects(1, "antialiased"))], [(camera(12, 10), OF_VIEWERS[0][1]), (camera(8, 9), ROUNDED)]],
    ids=["usual", "viewers"],
)
def test_where_lists_take_too_much_memory_strips_are_drawn_one_after_the_other(shots, in_order, monkeypatch):
    from mipmap_plugin.backends.triton_kernels import lists

    g, strips, listed, made = gaussians(5, dtype=torch.float32), [], [], lists.Lists._strip
    g = replace(g, scales=4 * g.scales)  # most are as wide as the picture

    def strip(self, *args):
        part = made(self, *args)
        strips.append(part.pixels)
        listed.append(len(part.listed))
        return part

    draw_all = side_by_side(lambda splats: TritonBackend().render_views(splats, shots))
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: in_order)
    whole, weights = draw(draw_all, g, None, None), TritonBackend().weigh_views(g, shots)
    monkeypatch.setattr(lists, "most_pairs", lambda device: 12)
    monkeypatch.setattr(lists.Lists, "_strip", strip)
    in_strips, weights_in_strips = draw(draw_all, g, None, None), TritonBackend().weigh_views(g, shots)
    assert len({(view.start, view.stop) for view in strips}) > 3 and max(listed) <= 12
    assert torch.equal(in_strips[0], whole[0]) and torch.equal(in_strips[1], whole[1])
    for name, gradient in in_strips[2].items():
        torch.testing.assert_close(gradient, whole[2][name], atol=2e-6 * float(gradient.abs().max()), rtol=1e-4)
    torch.testing.assert_close(weights_in_strips, weights, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("check", [check_views, check_steps])
@pytest.mark.parametrize("case", ["sh-degree-3", "sh-bands-left-out"])
def test_views_in_one_call_and_steps_are_right(check, case):
    outcome = check(TritonBackend(), CASES[case])
    assert outcome.passed, outcome.message


@pytest.mark.parametrize("shots", [[(WIDE, Effects(1)), (camera(16, 24), Effects(1, "antialiased"))], OF_VIEWERS], ids=["usual", "viewers"])
def test_views_of_a_step_are_summed_in_any_grouping(shots):
    """Views of two sizes, drawn in one call and one by one."""
    g = gaussians(20, dtype=torch.float32)
    moments = []
    for groups in ([shots], [shots[:1], shots[1:]]):
        raw = {"means": g.means.clone(), "quats": 2 * g.quats, "scales": g.scales.log(), "opacities": g.opacities.logit(), "sh": g.sh.clone()}
        first, second = ({name: torch.zeros_like(tensor) for name, tensor in raw.items()} for _ in range(2))
        stepper = TritonBackend().stepper(raw)
        for number, group in enumerate(groups):
            stepper.differentiate_all([2 * rendered.image for rendered in stepper.render_all(group, number)], number=number)
        rates = dict.fromkeys(RATES, 1e-3)
        stepper.step(AdamStep(raw, first, second, rates, betas=(0.9, 0.999), correction=1.0, eps=1e-8, nesterov=True))
        moments.append((raw, first))
    for together, alone in zip(*moments, strict=True):
        for name, tensor in together.items():
            torch.testing.assert_close(tensor, alone[name], atol=1e-6, rtol=1e-4)


def test_views_of_several_viewers_in_one_call_equal_the_reference():
    """Settings, and degrees of SH, are those of each view; one is rounded, the other not."""
    g = gaussians(20, dtype=torch.float32)
    shots = [OF_VIEWERS[0], (OF_VIEWERS[1][0], ROUNDED)]
    right = draw(side_by_side(lambda splats: [ReferenceBackend().render(splats, *shot) for shot in shots]), g.to(dtype=torch.float64), None, None)
    assert_equal(draw(side_by_side(lambda splats: TritonBackend().render_views(splats, shots)), g, None, None), right, 1e-4)


def test_steps_follow_the_gradients_in_a_viewer():
    outcome = check_steps(TritonBackend(), lambda: HardCase(gaussians(20), *OF_VIEWERS[0]))
    assert outcome.passed, outcome.message


def test_a_step_moves_all_numbers_of_splats_without_bands():
    """Their quaternions have more numbers than their colors."""
    from mipmap_plugin.backends.triton_kernels import NUMBERS_MOVED

    g, view = gaussians(NUMBERS_MOVED, 0, dtype=torch.float32), camera(4, 4)
    raw = raw_of(g)
    before = {name: tensor.clone() for name, tensor in raw.items()}
    first, second = ({name: torch.ones_like(tensor) for name, tensor in raw.items()} for _ in range(2))
    stepper = TritonBackend().stepper(raw)
    stepper.differentiate(0, stepper.render(0, view, Effects(0)).image)
    rates = dict.fromkeys(RATES, 1.0)
    stepper.step(AdamStep(raw, first, second, rates, betas=(0.9, 0.9), correction=1.0, eps=1e-8))
    assert all((raw[name] != before[name]).all() for name in raw)


@pytest.mark.parametrize("size", [0.0, 1e-38, 1e-29, 1e-22, 1e-15])
def test_steps_of_very_short_quaternions_are_finite(size):
    """The squares of their gradients would overflow float32."""
    g, view = gaussians(4, 0, dtype=torch.float32), camera(4, 4)
    raw = raw_of(g)
    raw["quats"] *= size
    first, second = ({name: torch.zeros_like(tensor) for name, tensor in raw.items()} for _ in range(2))
    stepper, rates = TritonBackend().stepper(raw), dict.fromkeys(RATES, 1e-3)
    for _ in range(3):
        stepper.differentiate(0, stepper.render(0, view, Effects(0)).image)
        stepper.step(AdamStep(raw, first, second, rates, betas=(0.9, 0.9), correction=1.0, eps=1e-8))
    assert all(tensor.isfinite().all() for tensor in raw.values())
