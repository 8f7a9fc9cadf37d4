"""Pictures of a pixel or two, of which a bicubic filter would show the middle alone: what comes back looks like all of the base's picture."""

from statistics import fmean

import pytest
import tiny
import torch
from orbiting import orbit

from mipmap_plugin.adaptation.target.resize import fitting, resize
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.wrap import wrap_model

FITTING = AdaptConfig(resize="fitting")


def unseen(side: int) -> list:
    """Views that nothing is adapted or validated on."""
    return orbit(tiny.gaussians(), (side, side), 12, torch.Generator().manual_seed(99), up=(0, 0, 1))


@pytest.mark.parametrize("pixels", [1, 2])
def test_steps_lose_nothing_of_the_start(pixels):
    side, scale = 8 * pixels, 1 / 8
    base = wrap_model(tiny.model(), cameras=tiny.cameras(4, width=side, height=side))
    start, end = base.adapt(scale, recipe="instant"), base.adapt(scale, steps=60, validation_views=8)

    def db(model) -> float:
        gaps = [model.render(view.zoomed(scale)).image - resize(base.render(view).image, (pixels, pixels), "area") for view in unseen(side)]
        return fmean(-10 * float(gap.square().mean().log10()) for gap in gaps)

    assert db(end) > db(start) - 0.1


@pytest.mark.parametrize(("size", "scale", "method"), [
    ((24, 24), 1 / 8, "pil-bicubic"), ((24, 16), 1 / 8, "area"), ((800, 2), 1, "area"), ((2, 2), 4, "area"), ((3, 3), 4, "pil-bicubic")
])  # fmt: skip
def test_the_filter_fits_the_picture(size, scale, method):
    views = tiny.cameras(3, width=size[0], height=size[1])
    assert fitting(FITTING, Effects(), views, scale).resize == method
    assert fitting(AdaptConfig(resize="lanczos"), Effects(), views, scale).resize == "lanczos"
    assert fitting(FITTING, Effects(screen_filter="antialiased"), views, scale).resize == (method if scale <= 1 else "area")


def test_one_narrow_picture_among_wide_ones_changes_nothing():
    views = [*tiny.cameras(2, width=8, height=8), *tiny.cameras(2)]
    assert fitting(FITTING, Effects(), views, 1 / 8).resize == "pil-bicubic"
    assert fitting(FITTING, Effects(), [], 1 / 8).resize == "pil-bicubic"
