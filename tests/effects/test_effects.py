"""Effects are data: derived from model, camera and request, each with a reason and a cost."""

import json
from dataclasses import replace

import anchor_checkpoints
import moving
import numpy as np
import ply_files
import pytest
import tiny
import torch
from anchor_checkpoints import Layout
from tiny import with_bands, wrapped

from mipmap_plugin import cli
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.effects import MODEL_EFFECTS, Effect, Effects, explain
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.mip import MipModel, load_mip
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.render_settings import EvenBuckets, Packing, RenderSettings
from mipmap_plugin.wrap import wrap_model


def states(effects: Effects, splats: Gaussians) -> dict:
    return {effect.name: (effect.on, effect.reason) for effect in explain(effects, splats)}


def test_a_plain_scene_calls_for_the_screen_filter_only():
    told = states(Effects(sh_degree=0), with_bands(0, 3))
    assert {name: reason for name, (on, reason) in told.items() if on} == {"screen filter": "classic, 0.3 px²"}
    assert told["view-dependent color"][1] == "SH up to degree 0 of 3: above it every coefficient is 0"
    assert states(Effects(sh_degree=3), with_bands(3, 3))["view-dependent color"][1] == "SH up to degree 3 of 3"


def test_everything_on():
    splats = tiny.gaussians(4)
    splats_with_covariances = Gaussians(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, torch.eye(3).expand(4, 3, 3))
    of_model = [replace(effect, on=True) for effect in MODEL_EFFECTS]
    everything = RenderSettings(
        radius=3.0, min_variance=1.0, min_contribution=1.0, least_spread=1.0, max_color=1.0, radial=True, packing=Packing(), picture_step=0.1,
        frame=1.0, max_half_axis=1.0,
    )  # fmt: skip
    requested = Effects(1, "antialiased", 0.1, supersampling=4, settings=everything, outputs=("depth", "normals"))
    effects = explain(requested, splats_with_covariances, of_model, recipe("paper", 4), 4)
    assert [effect.name for effect in effects if not effect.on] == ["coarse order", "linear light"]  # there are another order and a limit
    assert states(Effects(settings=RenderSettings(linear_light=2.2)), splats)["linear light"] == (True, "splats are blended in linear light")
    assert states(Effects(settings=RenderSettings(bucketed=True)), splats)["coarse order"][0]
    assert states(Effects(settings=RenderSettings(even_buckets=EvenBuckets())), splats)["coarse order"][0]
    rooted = states(Effects(settings=RenderSettings(min_contribution=0.5, rooted=True)), splats)["contribution cull"]
    assert rooted == (True, "a splat is not rendered if its sqrt(opacity · det) is below 0.5 px²")
    reasons = {effect.name: effect.reason for effect in effects}
    assert [reasons[name] for name in ("supersampling", "covariances")] == ["16 samples per pixel", "the model provides them"]
    assert reasons["upsampler"] == "bicubic enlarges the base's image to the truth"
    assert reasons["densification statistics"] == "splats with gradients above 0.0002 are cloned or split"
    assert not states(Effects(eps2d=0.0), splats)["screen filter"][0]


def test_without_dilation_nothing_is_compensated():
    assert states(Effects(screen_filter="mip", eps2d=0.0), tiny.gaussians(2))["compensation"] == (
        False, "the dilation is 0, so there is nothing to compensate",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "sentence"), [(dict(screen_filter=["mip"]), "screen_filter must be a str, got list"), (dict(outputs=[["depth"]]), "there is no output")]
)
def test_names_of_another_type_are_refused(wrong, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrapped(tiny.gaussians(2)).render(tiny.cameras(1)[0], **wrong)


def test_a_mistyped_screen_filter_is_told_which_there_are():
    there_are = "there is no screen filter 'antialised'; choose from scaled, classic, antialiased, mip, analytic, window; did you mean antialiased"
    with pytest.raises(SettingsError, match=there_are):
        wrapped(tiny.gaussians(2)).render(tiny.cameras(1)[0], screen_filter="antialised")


def test_the_line_of_an_effect_names_its_cost():
    on = explain(Effects(2, supersampling=3), with_bands(2, 3))
    off = explain(Effects(0), with_bands(0, 3))
    lines = {effect.name: str(effect) for effect in on}
    assert lines["supersampling"] == "supersampling: on, 9 samples per pixel (costs 9 times the pixels)"
    assert lines["view-dependent color"].endswith("(costs a direction and 9 of 16 coefficients per splat)")
    assert str(off[6]).endswith("(saves a direction and 15 of 16 coefficients per splat)")
    assert all(effect.reason and effect.cost for effect in (*on, *off))


@pytest.mark.parametrize(
    ("scale", "settings", "reason"),
    [
        (1 / 4, {}, "no image is enlarged"),
        (4, {}, "images are shrunk and compared with the base's own"),
        (4, dict(steps=0), "nothing is optimized"),
    ],
)
def test_why_no_upsampler_is_called_for(scale, settings, reason):
    effects = explain(Effects(), tiny.gaussians(2), config=recipe("default", scale, **settings), scale=scale)
    assert [(effect.on, effect.reason) for effect in effects if effect.name == "upsampler"] == [(False, reason)]


# Effects of the families


def on(path) -> dict[str, Effect]:
    """The effects of a family that are on, beside what rendering calls for."""
    known = {effect.name for effect in MODEL_EFFECTS}
    model = wrap_model(path, cameras=tiny.cameras(1), backend="reference")
    return {effect.name: effect for effect in model.render(tiny.cameras(1)[0]).effects if effect.on and effect.name in known}


def test_a_plain_checkpoint_needs_nothing_before_it_is_drawn(tmp_path):
    assert on(tiny.folder(tmp_path / "plain")) == {}


def test_anchors_are_decoded_for_each_camera(tmp_path):
    anchor_checkpoints.write(tmp_path / "plain", Layout())
    anchor_checkpoints.write(tmp_path / "dressed", Layout(appearance=(5, 8)))
    assert list(on(tmp_path / "plain")) == ["view-dependent geometry"]
    dressed = on(tmp_path / "dressed")
    assert list(dressed) == ["view-dependent geometry", "appearance embedding"]
    assert dressed["appearance embedding"].cost == "8 more inputs of the color network"


def test_the_cost_of_decoding_is_counted(tmp_path):
    anchor_checkpoints.write(tmp_path, Layout())
    weights = sum(held.size for state in anchor_checkpoints.weights(Layout()).values() for key, held in state.items() if key.endswith("weight"))
    assert on(tmp_path)["view-dependent geometry"].cost == f"{weights:,} multiplications an anchor in view, of 40, for each image"


def test_levels_of_detail_are_chosen(tmp_path):
    anchor_checkpoints.write(tmp_path, Layout(family="octree"))
    assert on(tmp_path)["levels of detail"].reason.startswith("4 of them")


def test_a_field_moves_the_splats(tmp_path):
    moved = on(moving.write_deformable(tmp_path / "deformable")), on(moving.write_hexplane(tmp_path / "hexplane"))
    assert [list(effects) for effects in moved] == [["time"], ["time"]]
    weights = sum(held.numel() for name, held in moving.deform_state().items() if name.endswith("weight"))
    assert moved[0]["time"].cost == f"{weights:,} multiplications a splat and moment"
    assert moved[1]["time"].cost.startswith("12 look-ups and ")


def test_a_3d_filter_is_applied_where_its_project_does(tmp_path):
    columns = ply_files.splat_columns(5, 0) | {"filter_3D": np.full(5, 0.01, np.float32)}
    files = {family: ply_files.write(tmp_path / f"{family}.ply", columns) for family in ("mip", "analytic")}
    models = {family: MipModel(family, load_mip(file).splats, torch.full((5,), 0.01)) for family, file in files.items()}
    assert {family: [effect.on for effect in model.traits.effects] for family, model in models.items()} == {"mip": [True], "analytic": [False]}


# Who carries them


def test_images_and_reports_list_effects():
    model = wrapped(with_bands(1, 3))
    adapted = model.adapt(1 / 4, steps=1, extra_views=0)
    camera = tiny.cameras(1)[0].zoomed(1 / 4)
    expected = explain(adapted.effects, adapted.model.gaussians(camera))
    assert adapted.render(camera).effects == expected
    assert model.render(camera, screen_filter="analytic").effects == explain(model.effects(screen_filter="analytic"), model.model.gaussians(camera))
    report = adapted.report
    assert report.effects == list(explain(adapted.effects, adapted.model.gaussians(camera), config=report.settings, scale=1 / 4))
    assert Report(**json.loads(json.dumps(report.model_dump()))) == report


def test_a_render_does_not_look_for_the_bands_in_use_again(monkeypatch):
    """Of a million splats that takes as long as drawing a small picture."""
    model = wrapped(with_bands(0, 3))
    model.render(tiny.cameras(1)[0])
    monkeypatch.setattr(Gaussians, "used_sh_degree", None)
    assert model.render(tiny.cameras(1)[0]).effects


def test_inspect_prints_effects(tmp_path, capsys):
    assert cli.main(["inspect", str(tiny.folder(tmp_path / "plain")), "--all", "--no-viewers"]) == 0
    out = capsys.readouterr().out
    assert all(f"{effect.name}: " in out for effect in explain(Effects(), tiny.gaussians(1)))
    assert "time: off, the scene does not move (saves a pass through a deformation field per image)" in out


# From a request to effects


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
