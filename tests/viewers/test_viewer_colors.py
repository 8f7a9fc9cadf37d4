"""Colors as a viewer shows, limits and blends them: in steps, in 8 bits and in linear light."""

from dataclasses import replace

import pytest
import tiny
import torch
from one_splat import BOTH, C0, MIDDLE, camera, differentiable, splat

from mipmap_plugin.adaptation.renderers import SteppingRenderer, unrounded
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import wrap_model


@BOTH
def test_spark_clips_colors_and_shows_them_in_steps(backend):
    effects = find_viewer("spark").effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))

    def color(value):
        rendered = backend.render(splat(40.0, 40.0, 1.0, value), camera(), effects)
        return (rendered.image[MIDDLE, MIDDLE, 0] / rendered.alpha[MIDDLE, MIDDLE]).item()

    assert color(1.7) == pytest.approx(1.0, abs=1e-6)
    assert color(100.4 / 255) == pytest.approx(100 / 255, abs=1e-6)
    assert color(100.6 / 255) == pytest.approx(101 / 255, abs=1e-6)


@BOTH
def test_a_color_in_steps_keeps_its_gradient(backend):
    leaves, splats = differentiable(splat(40.0, 40.0, 1.0, 0.2 / 255))  # shown as black, and not black
    effects = find_viewer("spark").effects(Effects(0))
    effects = replace(effects, settings=replace(effects.settings, packing=None, picture_step=None))
    rendered = backend.render(splats, camera(), effects)
    rendered.image[MIDDLE, MIDDLE, 0].backward()
    assert leaves["sh"].grad[0, 0, 0] == pytest.approx(C0 * rendered.alpha[MIDDLE, MIDDLE].item(), rel=1e-4)


@BOTH
@pytest.mark.parametrize(("viewer", "color"), [("antimatter15", 0.2 / 255), ("antimatter15", -0.3), ("spark", 254.9 / 255), ("babylon", 1.2)])
def test_a_color_packed_as_black_or_white_keeps_its_gradient(backend, viewer, color):
    leaves, splats = differentiable(splat(40.0, 40.0, 1.0, color))
    rendered = backend.render(splats, camera(), find_viewer(viewer).effects(Effects(0)))
    rendered.image[MIDDLE, MIDDLE, 0].backward()
    assert rendered.image[MIDDLE, MIDDLE, 0].item() == pytest.approx(round(color), abs=1.1 / 255)
    assert leaves["sh"].grad[0, 0, 0] == pytest.approx(C0 * rendered.alpha[MIDDLE, MIDDLE].item(), rel=1e-4)


@BOTH
@pytest.mark.parametrize("viewer", ["antimatter15", "gaussian-splats-3d", "babylon", "cesium", "spark", "playcanvas"])
def test_steps_see_colors_as_bright_as_the_viewer_shows_them(backend, viewer):
    """Of a scene without view-dependent color."""
    effects = find_viewer(viewer).effects(Effects(0))
    shown, seen = (backend.render(splat(40.0, 40.0, 0.5, 1.7), camera(), each).image.max().item() for each in (effects, unrounded(effects)))
    assert seen == pytest.approx(shown, abs=4 / 255)


@pytest.mark.parametrize(("viewer", "limited"), [("cesium", True), ("playcanvas", False)])
@BOTH
def test_steps_leave_colors_within_those_that_the_file_holds(backend, viewer, limited):
    splats = tiny.gaussians(20)
    splats.sh[:, 0] *= 4
    base = wrap_model(VanillaModel.from_gaussians(splats), cameras=tiny.cameras(2, width=8, height=6), backend=backend.name)
    adapted = base.adapt(1 / 2, viewer=viewer, steps=2, views="given", returns="last").model.gaussians()
    color = 0.5 + C0 * adapted.sh[:, 0].detach()
    assert (color.max().item() <= 1 + 1e-6) == limited


@BOTH
@pytest.mark.parametrize(("viewer", "shown"), [("babylon", 0.5), ("kiri", 0.5), ("classic", 1.5)])
def test_some_viewers_limit_colors_to_those_of_the_frame_buffer(backend, viewer, shown):
    drawn = backend.render(splat(900.0, 900.0, 0.5, 3.0), camera(), find_viewer(viewer).effects(Effects(0)))
    assert drawn.image[MIDDLE, MIDDLE, 0].item() == pytest.approx(shown, abs=0.01)


# Pictures of 8 bits


@BOTH
def test_an_8_bit_image_is_rounded_after_every_splat_from_the_back(backend):
    settings = RenderSettings(min_alpha=0.5 / 255, max_alpha=0.999, min_transmittance=1e-6, picture_step=1 / 255)
    parts = [splat(30.0, 30.0, opacity, color, means=(0.0, 0.0, depth)) for opacity, color, depth in ((0.01, 0.3, 9.0), (0.3, 0.9, 10.0))]
    both = parts[0].joined(parts[1])
    rendered = backend.render(both, camera(), Effects(0, settings=settings, background=(0.2, 0.2, 0.2)))
    behind = round(255 * (0.3 * 0.9 + 0.7 * 0.2)) / 255
    assert rendered.image[MIDDLE, MIDDLE, 0].item() == pytest.approx(round(255 * (0.01 * 0.3 + 0.99 * behind)) / 255, abs=1e-6)


@BOTH
def test_a_splat_of_less_than_half_a_step_is_not_seen_and_has_its_gradient(backend):
    leaves, splats = differentiable(splat(30.0, 30.0, 0.01, 0.5))
    settings = [RenderSettings(picture_step=step) for step in (1 / 255, None)]
    images = [backend.render(splats, camera(), Effects(0, settings=choice, background=(0.6, 0.6, 0.6))).image for choice in settings]
    assert (images[0] == images[0][0, 0]).all() and not (images[1] == images[1][0, 0]).all()
    gradients = [torch.autograd.grad(image.sum(), list(leaves.values()), retain_graph=True) for image in images]
    for rounded, exact in zip(*gradients, strict=True):
        torch.testing.assert_close(rounded, exact)


# Linear light


@BOTH
def test_metalsplatter_blends_in_linear_light(backend):
    """Half of a splat of 0.2 over white: in linear light, 0.5 · 0.2^2.2 + 0.5, which sRGB shows as 0.747, where others show 0.6."""
    effects = replace(find_viewer("metalsplatter").effects(Effects(0)), background=(1.0, 1.0, 1.0))
    image = backend.render(splat(400.0, 400.0, 0.5, 0.2), camera(), effects).image
    light = 0.5 * 0.2**2.2 + 0.5
    assert image[MIDDLE, MIDDLE].tolist() == pytest.approx([1.055 * light ** (1 / 2.4) - 0.055] * 3, abs=1e-5)
    others = replace(effects, settings=replace(effects.settings, linear_light=None))
    assert backend.render(splat(400.0, 400.0, 0.5, 0.2), camera(), others).image[MIDDLE, MIDDLE, 0] == pytest.approx(0.6, abs=1e-5)


@BOTH
def test_a_background_is_shown_as_it_is_in_linear_light(backend):
    behind = (0.02, 0.4, 1.0)  # on the line of sRGB, on its curve, and white
    effects = Effects(0, background=behind, settings=RenderSettings(linear_light=2.2))
    image = backend.render(splat(1.0, 1.0), camera(), effects).image
    assert image[0, 0].tolist() == pytest.approx(behind, abs=1e-6)


@BOTH
def test_black_has_finite_gradients_in_linear_light(backend):
    leaves, black = differentiable(splat(9.0, 9.0, color=-0.5))
    backend.render(black, camera(), Effects(0, settings=RenderSettings(linear_light=2.2))).image.sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


def test_all_views_of_a_step_are_blended_in_linear_light():
    light, plain = Effects(0, settings=RenderSettings(linear_light=2.2)), Effects(0)
    splats, backend = splat(9.0, 9.0), CpuBackend()
    views = [view.image for view in backend.render_views(splats, [(camera(), plain), (camera(), light)])]
    assert all(torch.equal(view, backend.render(splats, camera(), effects).image) for view, effects in zip(views, (plain, light), strict=True))


def test_steps_by_rows_are_not_taken_in_linear_light():
    light = find_viewer("metalsplatter").effects(Effects(0))
    assert SteppingRenderer.of(CpuBackend(), [Effects(0)]) and not SteppingRenderer.of(CpuBackend(), [Effects(0), light])


@pytest.mark.parametrize("also", [{"max_color": 1.0}, {"picture_step": 1 / 255}, {"packing": find_viewer("spark").settings.packing}])
def test_linear_light_goes_with_no_rounding(also):
    with pytest.raises(SettingsError, match="leave those out"):
        RenderSettings(linear_light=2.2, **also)
