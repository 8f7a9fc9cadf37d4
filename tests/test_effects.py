"""Effects are data with reasons, and one that is off is not computed."""

import pytest
import tiny
import torch

from mipmap_plugin.backends import harmonics, reference
from mipmap_plugin.effects import Effects, explain
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model


def with_bands(used: int, room: int) -> Gaussians:
    """Splats with room for SH of degree `room`, of which the bands above `used` are zero."""
    splats = tiny.gaussians(10, degree=room)
    splats.sh[:, (used + 1) ** 2 :] = 0
    return splats


def wrapped(splats, **trained):
    return wrap_model(VanillaModel.from_gaussians(splats, TrainedScale(**trained)), cameras=tiny.cameras(1), backend="reference")


def told(effects: Effects, splats: Gaussians) -> dict:
    return {effect.name: (effect.on, effect.reason) for effect in explain(effects, splats)}


def test_a_plain_scene_calls_for_the_screen_filter_only():
    assert told(Effects(sh_degree=0), with_bands(0, 3)) == {
        "view-dependent color": (False, "SH up to degree 0 of 3: above it every coefficient is 0"),
        "screen filter": (True, "classic, 0.3 px²"),
        "compensation": (False, "the screen filter is classic"),
        "supersampling": (False, "1 sample a pixel"),
        "covariances": (False, "quaternions and scales suffice"),
    }


def test_everything_on():
    splats = tiny.gaussians(4)
    given = Gaussians(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, torch.eye(3).expand(4, 3, 3))
    reasons = told(Effects(1, "antialiased", 0.1, supersampling=4), given)
    assert all(on for on, _ in reasons.values())
    assert [reasons[name][1] for name in ("supersampling", "covariances")] == ["16 samples a pixel", "the model gives them"]
    assert not told(Effects(eps2d=0.0), splats)["screen filter"][0]


@pytest.mark.parametrize("used", [0, 1, 2, 3])
def test_bands_above_the_last_lit_one_are_not_evaluated(monkeypatch, used):
    asked = []
    monkeypatch.setattr(reference, "colors", lambda *given: asked.append(given[-1]) or harmonics.colors(*given))
    splats = with_bands(used, 3)
    model = wrapped(splats)
    image = model.render(tiny.cameras(1)[0]).image
    assert asked == [used]
    forced = reference.ReferenceBackend().render(splats, tiny.cameras(1)[0], Effects(3)).image
    torch.testing.assert_close(image, forced, atol=1e-6, rtol=0)


def test_bands_that_are_off_stay_off_while_adapting(monkeypatch):
    asked = set()
    monkeypatch.setattr(reference, "colors", lambda *given: asked.add(given[-1]) or harmonics.colors(*given))
    adapted = wrapped(with_bands(1, 3)).adapt(1 / 4, steps=2, extra_views=0)
    assert asked == {1}
    assert (adapted.model.parameters()["shN"][:, 3:] == 0).all()


def test_a_request_becomes_effects():
    model = wrapped(with_bands(2, 3), screen_filter="antialiased", eps2d=0.1, background=(1.0, 1.0, 1.0))
    white = (1.0, 1.0, 1.0)
    assert model.effects() == Effects(2, "antialiased", 0.1, white)
    assert model.effects(0.5, "scaled", 3) == Effects(2, "antialiased", 0.1 / 4, white, 3)
    assert model.effects(0.5, "classic") == Effects(2, "classic", 0.3, white)


def test_the_background_is_the_callers_then_the_checkpoints_then_black():
    splats = tiny.gaussians(3)
    model = VanillaModel.from_gaussians(splats, TrainedScale(background=(1.0, 1.0, 1.0)))
    assert wrap_model(model, cameras=[], background=(0.0, 0.0, 0.0)).background == (0.0, 0.0, 0.0)
    assert wrap_model(model, cameras=[]).background == (1.0, 1.0, 1.0)
    assert wrap_model(VanillaModel.from_gaussians(splats), cameras=[]).background == (0.0, 0.0, 0.0)
