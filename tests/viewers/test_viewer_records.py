"""A viewer is one record: its effects, what backends and commands make of it, and what is refused."""

from dataclasses import replace

import pytest
import tiny
import torch
from one_splat import BACKENDS, splat

from mipmap_plugin import cli, register_viewer, wrap_model
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.gsplat import GsplatBackend
from mipmap_plugin.backends.inria import InriaBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import TritonBackend
from mipmap_plugin.effects import Effects, explain
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.splatting.viewer import EDGE
from mipmap_plugin.splatting.viewers import BUILT_IN, Viewer, find_viewer, viewers_for
from mipmap_plugin.wrap import Wrapped

# Records


def test_a_viewer_without_a_record_is_refused_with_what_to_take_instead():
    with pytest.raises(SettingsError, match=r"^viewer polycam: .*take portable"):
        find_viewer("polycam")
    assert find_viewer("nerfstudio") is find_viewer("gsplat") and find_viewer("inria") is find_viewer("classic")


@pytest.mark.parametrize("screen_filter", ["classic", "antialiased"])
def test_gsplat_draws_with_both_filters_from_nearer_on_than_inria_s_viewer(screen_filter):
    base = wrap_model(tiny.model(trained=TrainedScale(screen_filter, near_plane=0.01)), cameras=tiny.cameras(1))
    name = {"classic": "gsplat"}.get(screen_filter, "gsplat-antialiased")
    assert base.effects(viewer=name) == base.effects() == replace(base.effects(viewer=screen_filter), near_plane=0.01)
    assert base.effects(viewer=screen_filter).near_plane == 0.2
    assert find_viewer(name.replace("gsplat", "nerfstudio")) is find_viewer(name) and name not in viewers_for("portable")


def test_effects_of_a_viewer_are_on_and_the_rest_is_off():
    active = {}
    for viewer in (record.name for record in BUILT_IN):
        active[viewer] = {part.name for part in explain(find_viewer(viewer).effects(Effects(0)), splat(1.0, 1.0)) if part.on}
    assert active["classic"] == {"screen filter"}
    web = {"screen filter", "edge", "size limit", "packing", "rounded picture"}
    assert active["spark"] == web | {"compensation", "frame", "color limit", "order by distance"}
    assert active["playcanvas"] == web | {"size cull", "color limit", "coarse order"}
    assert active["playcanvas-webgpu"] == active["playcanvas"] - {"coarse order"} | {"contribution cull"}
    assert active["gaussian-splats-3d"] == web | {"frame", "stretching", "coarse order"}


def test_the_usual_viewers_have_the_usual_settings():
    assert all(find_viewer(name).settings == USUAL for name in ("classic", "antialiased", "mip"))
    assert find_viewer("classic").effects(Effects(2)) == Effects(2)


def test_supersplats_editor_is_playcanvas_and_every_record_is_under_its_name():
    assert find_viewer("supersplat") is find_viewer("playcanvas") is not find_viewer("supersplat-viewer")
    assert all(find_viewer(viewer.name) is viewer and viewer.source and viewer.title for viewer in BUILT_IN)


def test_a_new_viewer_is_one_record():
    register_viewer("blurry", Viewer("blurry", "A blurry one", "nowhere", "classic", 2.0))
    model = wrap_model(tiny.model(), cameras=tiny.cameras(1), backend="reference")
    rendered = model.render(tiny.cameras(1)[0], viewer="blurry").image
    expected = model.render(tiny.cameras(1)[0]).image
    assert not torch.allclose(rendered, expected)
    register_viewer("wrong", 3)
    with pytest.raises(PluginError, match=r"viewer 'wrong' must be a .*, got int"):
        find_viewer("wrong")


@pytest.mark.parametrize(("name", "guess"), [("antialised", "; did you mean antialiased"), (None, "$")])
def test_a_screen_filter_that_there_is_not_is_told_with_what_was_probably_meant(name, guess):
    with pytest.raises(SettingsError, match=f"viewer 'a': there is no screen filter '{name}'; choose from classic, .*, window{guess}"):
        Viewer("a", "A", "nowhere", name, 2.0)


def test_a_viewer_draws_no_more_bands_than_it_has():
    effects = find_viewer("gaussian-splats-3d").effects(Effects(3, background=(1.0, 1.0, 1.0), near_plane=0.5))
    assert (effects.sh_degree, effects.background, effects.near_plane) == (0, (1.0, 1.0, 1.0), 0.5)
    assert find_viewer("spark").effects(Effects(2)).sh_degree == 2


@pytest.mark.parametrize("backend", [GsplatBackend(), InriaBackend()], ids=lambda backend: backend.name)
def test_backends_on_a_gpu_report_what_they_do_not_support(backend):
    needs = Needs.of(splat(1.0, 1.0), find_viewer("gaussian-splats-3d").effects(Effects(0)), gradients=True)
    [reason] = [reason for reason in backend.lacking(needs) if "reference backend does" in reason]
    assert "stretching of round splats" in reason and "packing" in reason and "splats that end at a radius" in reason
    assert not [reason for reason in backend.lacking(replace(needs, settings=USUAL)) if "reference backend does" in reason]


def test_triton_draws_every_viewer():
    needs = [Needs.of(splat(1.0, 1.0), viewer.effects(Effects(0)), gradients=True) for viewer in BUILT_IN]
    capabilities = TritonBackend().capabilities
    assert not [reason for need in needs for reason in capabilities.lacking(replace(need, device=next(iter(capabilities.devices))))]


def test_filters_that_integrate_are_no_viewers():
    needs = Needs.of(splat(1.0, 1.0), Effects(0, "analytic", settings=RenderSettings(min_variance=1.0)), gradients=True)
    for backend in BACKENDS:
        assert "the screen filter analytic does not support culling by size" in backend.lacking(needs)


@pytest.mark.parametrize("settings", [{"fades": True}, {"max_half_axis": 512.0}, {"fits_picture": True}])
def test_a_splat_that_fades_or_whose_half_axes_are_limited_needs_an_end(settings):
    with pytest.raises(SettingsError, match="give radius"):
        RenderSettings(**settings)


def test_sizes_keep_their_meaning_under_supersampling():
    assert find_viewer("spark").settings.finer(2).max_half_axis == 1024
    usual, culled = Effects(0, supersampling=3), find_viewer("playcanvas").effects(Effects(0, supersampling=3))
    assert culled.settings.finer(3).min_variance == pytest.approx(9 / 8)
    assert usual.settings.finer(3) is usual.settings
    assert culled.settings.radius == EDGE


# A model, and the command


def wrapped() -> Wrapped:
    return wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="reference")


def test_a_model_is_rendered_as_in_the_viewer():
    model, view = wrapped(), tiny.cameras(1)[0]
    rendered = model.render(view, viewer="playcanvas")
    expected = ReferenceBackend().render(model.model.gaussians(view), view, find_viewer("playcanvas").effects(model.effects()))
    assert torch.equal(rendered.image, expected.image)
    assert not torch.allclose(rendered.image, model.render(view).image)


def test_depth_is_no_color():
    model, view = wrapped(), tiny.cameras(1)[0]
    assert model.render(view, outputs=("depth",), viewer="spark").depth.max() > 1.5


def test_a_viewer_has_its_own_screen_filter():
    with pytest.raises(SettingsError, match="viewer spark has a screen filter of its own"):
        wrapped().render(tiny.cameras(1)[0], screen_filter="mip", viewer="spark")


def test_the_command_renders_as_in_a_viewer(tmp_path, capsys):
    folder = tiny.folder(tmp_path / "model")
    words = ["render", str(folder), "--output", str(tmp_path / "out"), "--viewer", "supersplat"]
    assert cli.main(words) == 0
    assert list((tmp_path / "out").glob("*.png"))
    words[-1] = "superspalt"
    assert cli.main([*words, "--overwrite"]) == 2
    assert "there is no viewer 'superspalt'; choose from" in capsys.readouterr().err


def test_an_option_that_is_not_there_is_refused():
    with pytest.raises(TypeError, match=r"unknown options: filter3d; there are scale, .*, viewer, filter_3d, outputs, clamped, exposure"):
        wrap_model(tiny.model(4), cameras=tiny.cameras(), backend="reference").render(tiny.cameras()[0], filter3d=True)
