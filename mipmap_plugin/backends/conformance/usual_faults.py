"""What is most often wrong with a new backend, in a sentence: its image is one that the reference draws of a scene changed accordingly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.backends.conformance.cases import HardCase, random_scene
from mipmap_plugin.backends.conformance.checks import Answer, draw, lowered
from mipmap_plugin.backends.conformance.tolerance import Tolerance, differing_images, tolerance_for
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.harmonics import C0

# Screen filters to look with, of which the first that the backend has is taken; and a dilation other than the usual one, px².
FILTERS, EPS2D = ("classic", "antialiased", "mip"), 0.1

# What is added to colors, so that none is negative, and taken from the image again.
ABOVE_ALL_COLORS = 100.0

# By how much the cosine of a multiple of a gradient may differ from 1: rounding in float32.
ALONG = 1e-3


def usual_fault(backend: Backend, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> str:
    """What seems to be wrong with a backend's image of ordinary splats, or else with its gradients; "" if nothing is, or nothing usual."""
    for screen_filter in FILTERS:
        exact = random_scene(1, screen_filter, EPS2D)
        case = lowered(backend, exact, dtype=dtype, device=device)
        if not backend.lacking(Needs.of(case.gaussians, case.effects, gradients=False)):
            break
    else:
        return ""
    differentiate = not backend.lacking(Needs.of(case.gaussians, case.effects, gradients=True))
    exact = exact._replace(effects=case.effects)
    actual, expected = draw(backend, case, differentiate=differentiate), draw(ReferenceBackend(), exact)
    tolerance = tolerance_for(dtype)
    if not differing_images("image", actual.image, expected.image, tolerance):
        opposite = not differing_images("alpha", actual.alpha, 1 - expected.alpha, tolerance)
        return "its alpha is the transmittance; return 1 - transmittance" if opposite else _of_gradients(actual, expected, tolerance)
    alike = (said for said, mistaken in FAULTS.items() if not differing_images("image", actual.image, mistaken(exact), tolerance))
    return next(alike, "")


def _of_gradients(actual: Answer, expected: Answer, tolerance: Tolerance) -> str:
    """Which field's gradient is missing, or a multiple of the right one."""
    for field, gradient in actual.gradients.items():
        right = expected.gradients[field].flatten()
        length, cosine = float(gradient.norm() / right.norm()), float(torch.cosine_similarity(gradient.flatten(), right, dim=0))
        if length == 0:
            return f"the gradient of {field} is 0 everywhere"
        if abs(cosine) > 1 - ALONG and abs(cosine * length - 1) > tolerance.length:
            return f"the gradient of {field} is {cosine * length:.3g} times the right one"
    return ""


def _drawn(case: HardCase) -> Tensor:
    return draw(ReferenceBackend(), case, differentiate=False).image


def _with_effects(case: HardCase, **changes: Any) -> Tensor:
    return _drawn(case._replace(effects=replace(case.effects, **changes)))


def _with_field(case: HardCase, field: str, change: Callable[[Tensor], Tensor]) -> Tensor:
    return _drawn(case._replace(gaussians=replace(case.gaussians, **{field: change(getattr(case.gaussians, field))})))


def _with_settings(case: HardCase, **settings: Any) -> Tensor:
    return _with_effects(case, settings=replace(case.effects.settings, **settings))


def _flipped(case: HardCase, dimension: int) -> Tensor:
    return _drawn(case).flip(dimension)


def _of_one_focal_length(case: HardCase) -> Tensor:
    return _drawn(case._replace(camera=replace(case.camera, fy=case.camera.fx)))


def _shifted(case: HardCase, pixels: float) -> Tensor:
    camera = case.camera
    return _drawn(case._replace(camera=replace(camera, cx=camera.cx + pixels, cy=camera.cy + pixels)))


def _brighter(sh: Tensor, by: float) -> Tensor:
    return torch.cat([sh[:, :1] + by / C0, sh[:, 1:]], 1)


def _not_clamped(case: HardCase) -> Tensor:
    """Blending is linear in the colors, and the weights of a pixel add up to its alpha."""
    brighter = replace(case.gaussians, sh=_brighter(case.gaussians.sh, ABOVE_ALL_COLORS))
    answer = draw(ReferenceBackend(), case._replace(gaussians=brighter), differentiate=False)
    return answer.image - ABOVE_ALL_COLORS * answer.alpha


def _negated(sh: Tensor, *functions: int) -> Tensor:
    signs = torch.ones(sh.shape[1], 1, dtype=sh.dtype)
    signs[[function for function in functions if function < len(signs)]] = -1
    return sh * signs


def _sh_negated(*functions: int) -> Callable[[HardCase], Tensor]:
    return partial(_with_field, field="sh", change=lambda sh: _negated(sh, *functions))


# Sentence -> the image in which a scene is drawn so.
FAULTS: dict[str, Callable[[HardCase], Tensor]] = {
    "pixel centers lie at whole numbers in it, and have to lie at +0.5": partial(_shifted, pixels=0.5),
    "its image is shifted by half a pixel to the left and up; pixel centers lie at +0.5, once": partial(_shifted, pixels=-0.5),
    "it leaves the background out; add (1 - alpha) * effects.background": partial(_with_effects, background=(0.0, 0.0, 0.0)),
    "it dilates by 0.3 px² always, and not by effects.eps2d": partial(_with_effects, eps2d=DILATION),
    "it does not dilate by effects.eps2d": partial(_with_effects, eps2d=0.0),
    "it leaves out the bands of SH above degree 0": partial(_with_effects, sh_degree=0),
    "it evaluates SH in the opposite direction; directions go from the eye to the splat": _sh_negated(1, 2, 3, *range(9, 16)),
    "its functions of SH degree 1 have the wrong sign; they are C1 times -y, z, -x": _sh_negated(1, 2, 3),
    "the first function of its SH degree 1 has the wrong sign; it is -C1 * y": _sh_negated(1),
    "the second function of its SH degree 1 has the wrong sign; it is C1 * z": _sh_negated(2),
    "the third function of its SH degree 1 has the wrong sign; it is -C1 * x": _sh_negated(3),
    "it does not clamp colors to 0 and more, after 0.5 is added": _not_clamped,
    "it does not add 0.5 to the colors of SH": partial(_with_field, field="sh", change=partial(_brighter, by=-0.5)),
    "it reads quaternions as xyzw; they are wxyz": partial(_with_field, field="quats", change=lambda quats: quats.roll(1, 1)),
    "its rotations are the transposed ones": partial(_with_field, field="quats", change=lambda quats: quats * quats.new_tensor([1, -1, -1, -1])),
    "it takes scales for variances; they are standard deviations": partial(_with_field, field="scales", change=torch.sqrt),
    "its image is upside down; y points down": partial(_flipped, dimension=0),
    "its image is mirrored; x points right": partial(_flipped, dimension=1),
    "its colors are in the order blue, green, red": partial(_flipped, dimension=2),
    "it takes fx for fy": _of_one_focal_length,
    "its splats end at three standard deviations; they end where alpha is 1/255": partial(_with_settings, radius=3.0),
    "it sorts splats by their distance from the eye, and not by their depth": partial(_with_settings, radial=True),
}
