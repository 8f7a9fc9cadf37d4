"""Families with a `filter_3D` column in viewers, which ignore it: how they render the file, and files written for them."""

import numpy as np
import pytest
import tiny
import torch
from mip_checkpoints import folder, splats

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.errors import BackendUnavailable, OutputExists, SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats import splat_transform as exchange
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import Wrapped, wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

FAMILIES = ("mip", "gof", "analytic")
BRIEF = dict(steps=2, extra_views=2, merge_to=1.0, warm_up=0)


def wrapped(path, family: str = "mip") -> Wrapped:
    return wrap_model(folder(path / "model", family), cameras=tiny.cameras())


@pytest.mark.parametrize("family", FAMILIES)
def test_fused_splats_look_as_the_base_does(tmp_path, family):
    base = wrapped(tmp_path, family)
    fused = base.model.fused()
    assert fused.family == "3dgs" and not fused.trained.keeps_filter
    assert not any(tensor.requires_grad for tensor in fused.parameters().values())
    fused_model = wrap_model(fused, cameras=tiny.cameras())
    for view in tiny.cameras(2):
        image = base.render(view).image
        assert image.max() > 0.2
        torch.testing.assert_close(fused_model.render(view).image, image, atol=1e-5, rtol=0)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_a_viewer_shows_the_file_without_its_filter(tmp_path, family, viewer):
    base, view = wrapped(tmp_path, family), tiny.cameras(1)[0]
    bare = base.model.splats.gaussians()
    expected = ReferenceBackend().render(bare, view, find_viewer(viewer).effects(base.effects())).image
    assert torch.equal(base.render(view, viewer=viewer).image, expected)


def test_mip_splatting_itself_smooths(tmp_path):
    base, view = wrapped(tmp_path), tiny.cameras(1)[0]
    assert torch.equal(base.render(view, viewer="mip").image, base.render(view).image)


@pytest.mark.parametrize(
    ("family", "viewer"), [("mip", "spark"), ("mip", "playcanvas"), ("gof", "spark"), ("gof", "playcanvas"), ("analytic", "playcanvas")]
)
def test_at_scale_one_adapting_brings_a_viewer_closer_to_the_bases_own_image(tmp_path, family, viewer):
    base = wrapped(tmp_path, family)
    adapted = base.adapt(1, viewer=viewer, recipe="instant")
    assert adapted.effects == base.effects(viewer=viewer)
    for view in tiny.cameras(3, seed=9):  # that nothing was adapted to
        own = base.render(view).image
        assert psnr(adapted.render(view).image, own) > psnr(base.render(view, viewer=viewer).image, own) + 3


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("viewer", "tag"), [("spark", "mip"), ("playcanvas", "classic")])
def test_what_is_made_for_a_viewer_is_a_checkpoint_of_3dgs(tmp_path, family, viewer, tag):
    base = wrapped(tmp_path, family)
    write_cameras(base.model.folder / "cameras.json", tiny.cameras())
    adapted = base.adapt(1 / 4, viewer=viewer, **BRIEF)
    saved = adapted.save(tmp_path / "made")
    header = read_ply(saved)
    assert "filter_3D" not in header.columns and provenance_of(header.comments)["base"] == sha256(base.model.source)
    assert not {"kernel_size", "load_allres"} & read_cfg_args(tmp_path / "made" / "cfg_args").keys()  # of a filter that it has no more
    again = load_model(tmp_path / "made")
    assert (again.family, again.trained.screen_filter, again.trained.eps2d) == ("3dgs", tag, 0.3)
    assert len(wrap_model(again).cameras) == 4
    view = tiny.cameras(1)[0].zoomed(1 / 4)
    loaded = wrap_model(again, background=(0.0, 0.0, 0.0))
    torch.testing.assert_close(loaded.render(view, viewer=viewer).image, adapted.render(view).image, atol=1e-5, rtol=0)


def of_mip_splatting(columns):
    """Scales and opacities as Mip-Splatting takes them from a file, whose loader requires filter_3D."""
    scales = np.exp(np.stack([columns[f"scale_{axis}"] for axis in range(3)], 1).astype(np.float64))
    smoothed = np.sqrt(scales**2 + columns["filter_3D"][:, None] ** 2)
    return smoothed, np.sqrt((scales**2).prod(1) / (smoothed**2).prod(1)) / (1 + np.exp(-columns["opacity"]))


@pytest.mark.parametrize("base", ["3dgs", "mip"])
@pytest.mark.parametrize("name", ["made.ply", "made"])
def test_what_is_made_for_mip_splatting_has_the_filter_that_its_loader_requires(tmp_path, base, name):
    own = wrapped(tmp_path) if base == "mip" else wrap_model(tiny.folder(tmp_path / "base", tiny.cameras()))
    adapted = own.adapt(1 / 4, viewer="mip", **BRIEF)
    columns = read_ply(adapted.save(tmp_path / name)).columns
    assert [*columns][-1] == "filter_3D" and not columns["filter_3D"].any()
    splats, (scales, opacities) = adapted.model.gaussians(None).detach(), of_mip_splatting(columns)
    np.testing.assert_allclose(scales, splats.scales, rtol=1e-5)
    np.testing.assert_allclose(opacities, splats.opacities, rtol=1e-5)
    again, view = wrap_model(tmp_path / name, background=(0.0, 0.0, 0.0)), tiny.cameras(1)[0].zoomed(1 / 4)
    assert (again.model.family, again.trained.eps2d) == ("mip", 0.1)
    torch.testing.assert_close(again.render(view, viewer="mip").image, adapted.render(view).image, atol=1e-5, rtol=0)


def test_the_base_is_neither_changed_nor_overwritten(tmp_path):
    base = wrapped(tmp_path)
    before = {name: tensor.clone() for name, tensor in base.model.parameters().items()}
    adapted = base.adapt(1, viewer="spark", **BRIEF)
    assert all(torch.equal(base.model.parameters()[name], tensor) for name, tensor in before.items())
    for path in (tmp_path / "model", base.model.source):
        with pytest.raises(OutputExists):
            adapted.save(path, overwrite=True)


def test_an_exchange_format_is_refused_for_its_own_project_only(tmp_path, monkeypatch):
    monkeypatch.setattr(exchange, "find_tool", lambda: ["splat-transform"])
    base = wrapped(tmp_path)
    base.refuse_output(tmp_path / "small.spz", overwrite=False, viewer="spark")
    with pytest.raises(SettingsError, match="these splats need the filter of their own project"):
        base.refuse_output(tmp_path / "small.spz", overwrite=False)


@pytest.mark.parametrize("viewer", ["spark", "mip"])
def test_the_base_as_it_is_is_what_the_viewer_shows_of_its_file(tmp_path, viewer):
    """The base is returned where it scores better than every state of the run."""
    base = wrapped(tmp_path, "gof")
    adapted = base.adapt(1, viewer=viewer, recipe="instant", validation_views=2)
    view = adapted.adapted_to[-1]  # which alone has chosen
    expected = psnr(base.render(view, viewer=viewer).image, base.render(view).image)
    assert adapted.report.validation["the base as it is"] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("viewer", ["playcanvas", None])
def test_splats_with_a_filter_may_be_merged(tmp_path, viewer):
    twins = {name: np.repeat(column, 2) for name, column in splats().items()}
    base = wrap_model(folder(tmp_path / "model", columns=twins), cameras=tiny.cameras())
    assert len(base.adapt(1 / 4, viewer=viewer, steps=0, most_splats=48).model) <= 48 < len(base.model)


def test_splats_that_were_fused_elsewhere_leave_the_kernel_size_behind_too(tmp_path):
    plain = {name: column for name, column in splats().items() if name != "filter_3D"}
    base = wrap_model(folder(tmp_path / "model", columns=plain), cameras=tiny.cameras())
    base.adapt(1, viewer="spark", **BRIEF).save(tmp_path / "made")
    assert (load_model(tmp_path / "made").trained.screen_filter, load_model(tmp_path / "made").trained.eps2d) == ("mip", 0.3)


def test_who_draws_the_base_has_its_filter_too(tmp_path, monkeypatch):
    """A renderer that has the viewer's filter but not that of training would draw another truth."""
    lacking = ReferenceBackend.lacking
    no_analytic = ["it does not integrate"]
    monkeypatch.setattr(ReferenceBackend, "lacking", lambda self, needs: no_analytic if needs.screen_filter == "analytic" else lacking(self, needs))
    with pytest.raises(BackendUnavailable, match="it does not integrate"):
        wrap_model(folder(tmp_path / "model", "analytic"), cameras=tiny.cameras(), backend="reference").adapt(1, viewer="classic", **BRIEF)


def test_the_command_says_that_a_file_without_a_viewer_is_for_its_own_project(tmp_path, capsys):
    words = ["adapt", folder(tmp_path / "model"), "--scale", "1/4", "--recipe", "instant"]
    assert main([str(word) for word in words]) == 0
    assert "made for its own project, whose filter it keeps; for others give --viewer spark, supersplat, ..." in capsys.readouterr().out
