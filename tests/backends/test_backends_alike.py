"""The same run ends alike whether a backend moves the splats itself (cpu) or leaves that to autograd and Adam (reference)."""

import pytest
import tiny

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.wrap import wrap_model

BRIEF = dict(steps=8, extra_views=4, check_every=4, validation_views=4)
GROWING = dict(densify_gradient=1e-7, prune_every=3)
RUNS = {
    "zoom-out": (1 / 4, {}),
    "zoom-in": (2, {}),
    "one view a step": (1 / 4, dict(views_per_step=1)),
    "paper, growing": (1 / 4, dict(recipe="paper", **GROWING)),
    "paper": (1 / 4, dict(recipe="paper")),
    "growing on trial": (2, dict(recipe="thorough", upsampler="mine", **GROWING)),
    "pruning": (1 / 4, dict(prune_every=3, min_opacity=0.3, merge_to=1.0, returns="last")),
    "a band": (1 / 4, dict(band=(0.5, 1.0))),
    "another viewer": (1 / 4, dict(viewer="spark")),
    "several viewers": (1 / 4, dict(viewer="portable")),
}

# dB: forty times what the backends' rounding makes of so few steps.
ALIKE_DB = 0.02


@pytest.mark.parametrize("run", RUNS)
def test_a_run_ends_alike(run):
    pytest.importorskip("numba")
    register_upsampler("mine", lambda image, size: resize(image, size, "lanczos"))
    scale, settings = RUNS[run]
    base = tiny.model(40, TrainedScale(background=(1.0, 1.0, 1.0)))  # on white, `paper` resets opacities
    bases = (wrap_model(base, cameras=tiny.cameras(), backend=backend) for backend in ("reference", "cpu"))
    expected, found = (each.adapt(scale, **BRIEF, **settings).report for each in bases)
    assert (found.gaussians_after, found.ended_by, [*found.validation]) == (expected.gaussians_after, expected.ended_by, [*expected.validation])
    assert list(found.validation.values()) == pytest.approx(list(expected.validation.values()), abs=ALIKE_DB)
