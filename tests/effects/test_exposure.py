"""Exposure: applied only on request, and looked up by the name of the photograph."""

import json
from dataclasses import replace
from os.path import splitext
from types import SimpleNamespace

import pytest
import tiny
import torch

from mipmap_plugin import cli
from mipmap_plugin.adaptation import adapted
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models import exposure
from mipmap_plugin.models.exposure import exposed
from mipmap_plugin.models.mip import MipModel
from mipmap_plugin.models.moving.model import MovingModel
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

IDENTITY = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
WARM = [[0.5, 0.2, 0.0, 0.01], [0.0, 0.25, 0.0, 0.02], [0.1, 0.0, 2.0, -0.03]]  # no two entries can change places


def base(path, exposures=None):
    """A checkpoint with four views, view_0 to view_3; `exposures`: what its exposure.json says."""
    folder = tiny.folder(path)
    if exposures is not None:
        (folder / "exposure.json").write_text(exposures if isinstance(exposures, str) else json.dumps(exposures))
    return wrap_model(folder)


def line(result) -> tuple[bool, str]:
    [effect] = [effect for effect in result.effects if effect.name == "exposure"]
    return effect.on, effect.reason


def test_each_color_is_a_row_times_the_matrix_plus_the_last_column():
    red, green, blue = (exposed(torch.eye(3)[k].expand(2, 4, 3), torch.tensor(WARM))[0, 0].tolist() for k in range(3))
    assert red == pytest.approx([0.5 + 0.01, 0.2 + 0.02, 0.0 - 0.03])
    assert green == pytest.approx([0.0 + 0.01, 0.25 + 0.02, 0.0 - 0.03])
    assert blue == pytest.approx([0.1 + 0.01, 0.0 + 0.02, 2.0 - 0.03])


def test_a_view_is_rendered_with_the_exposure_of_its_name(tmp_path):
    model = base(tmp_path / "a", {"view_0": IDENTITY, "view_1": WARM})
    first, second = model.cameras[:2]
    plain = model.render(second, supersampling=2)
    rendered = model.render(second, supersampling=2, exposure=True)
    torch.testing.assert_close(rendered.image, exposed(plain.image, torch.tensor(WARM)))
    assert not torch.equal(rendered.image, plain.image) and torch.equal(rendered.alpha, plain.alpha)
    assert torch.equal(model.render(first, exposure=True).image, model.render(first).image)


@pytest.mark.parametrize(("written", "view_name"), [("view_1.JPG", "view_1"), ("a/view.1.png", "a/view.1"), ("view.1", "view.1")])
def test_a_name_may_lack_its_suffix(tmp_path, written, view_name):
    model = base(tmp_path / "a", {"other.png": IDENTITY, written: WARM})
    assert model.model.traits.exposures.of(replace(model.cameras[0], name=view_name)).tolist() == WARM


def test_a_view_of_another_name_is_refused(tmp_path):
    model = base(tmp_path / "a", {"view_1": WARM})
    with pytest.raises(SettingsError, match="view 'view_0' has no exposure; the first of 1 that have one are view_1"):
        model.render(model.cameras[0], exposure=True)


@pytest.mark.parametrize("exposures", [None, IDENTITY, WARM])
def test_off_it_is_not_computed_and_forced_on_an_identity_changes_nothing(tmp_path, monkeypatch, exposures):
    model, calls = base(tmp_path / "a", exposures and {"view_0": exposures}), []
    monkeypatch.setattr(adapted, "exposed", lambda *arguments: calls.append(arguments) or exposed(*arguments))
    image = model.render(model.cameras[0]).image
    model.adapt(1 / 4, steps=1, extra_views=0).render(model.cameras[0].zoomed(1 / 4))
    assert calls == []
    if exposures:
        same = torch.equal(model.render(model.cameras[0], exposure=True).image, image)
        assert (len(calls), same) == (1, exposures is IDENTITY)


@pytest.mark.parametrize(
    ("exposures", "reason"),
    [
        (None, "the checkpoint has none"),
        ({"view_0": IDENTITY}, "exposure.json holds only identities: no exposure was trained"),
        ({"view_0": IDENTITY, "view_1": WARM}, "exposure.json changes 1 of 2 images, not asked for"),
        ({}, "exposure.json names no image"),
        ("[]", "exposure.json cannot be read ('list' object has no attribute 'items')"),
        ({"view_0": WARM[:2]}, "exposure.json cannot be read ('view_0' is not three rows of four numbers)"),
        ('{"view_0": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, NaN]]}', "exposure.json cannot be read ('view_0' is not three rows of four numbers)"),
    ],
)
def test_the_line_says_on_or_off_and_why(tmp_path, exposures, reason):
    model = base(tmp_path / "a", exposures)
    assert line(model.render(model.cameras[0])) == (False, reason)
    assert line(model.adapt(1 / 4, recipe="instant").report) == (False, reason)
    if isinstance(exposures, dict) and "view_1" in exposures:
        assert line(model.render(model.cameras[1], exposure=True)) == (True, "requested; exposure.json has an entry for this view")


def test_exposure_cannot_be_requested_without_one(tmp_path):
    model = base(tmp_path / "a")
    with pytest.raises(SettingsError, match="exposure: the checkpoint has none; leave it out"):
        model.render(model.cameras[0], exposure=True)


def test_an_adapted_model_and_its_folder_keep_exposures(tmp_path):
    model = base(tmp_path / "a", {"view_1": WARM})
    adapted, small = model.adapt(1 / 4, recipe="instant"), model.cameras[1].zoomed(1 / 4)
    rendered = adapted.render(small, exposure=True).image
    torch.testing.assert_close(rendered, exposed(adapted.render(small).image, torch.tensor(WARM)))
    adapted.save(tmp_path / "b")
    again = wrap_model(tmp_path / "b", backend="reference").render(small, exposure=True)
    torch.testing.assert_close(again.image, rendered, atol=1e-5, rtol=0)


def test_families_built_on_3dgs_have_exposures_too(tmp_path):
    splats = base(tmp_path / "a", {"view_1": WARM}).model
    field = SimpleNamespace(slopes=None, is_still=True, cost="")
    around = [MipModel("mip", splats, torch.ones(len(splats))), MovingModel("deformable", splats, field)]
    assert [model.traits.exposures is splats.traits.exposures for model in around] == [True, True]


def test_images_that_were_exposed_differently_are_not_adapted_to(tmp_path):
    scene = load_scene(tiny.scene(tmp_path / "scene", train=tiny.cameras(2)))
    with pytest.raises(SettingsError, match=r"exposed differently, .* \(exposure.json\); leave them out"):
        base(tmp_path / "a", {"view_1": WARM}).adapt(2, images=scene, steps=1)
    base(tmp_path / "b", {"view_1": IDENTITY}).adapt(2, images=scene, steps=1)


def test_the_command_has_an_option_for_exposure(tmp_path, capsys):
    base(tmp_path / "a", {"view_0": WARM})
    words = ["render", str(tmp_path / "a"), "--output", str(tmp_path / "out"), "--backend", "reference"]
    assert cli.main([*words, "--exposure"]) == 2
    assert "view 'view_1' has no exposure" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert cli.main([*words, "--view", "view_0"]) == 0
    plain = (tmp_path / "out/train_view_0.png").read_bytes()
    assert cli.main([*words, "--view", "view_0", "--exposure", "--overwrite"]) == 0
    assert (tmp_path / "out/train_view_0.png").read_bytes() != plain


def test_the_names_of_all_photographs_are_read_once_and_not_for_each_view(tmp_path, monkeypatch):
    """Of 10,000 views they took longer than drawing."""
    model, read = base(tmp_path / "base", {f"view_{number}.png": WARM for number in range(4)}), []
    monkeypatch.setattr(exposure, "splitext", lambda name: read.append(name) or splitext(name))
    for camera in model.cameras:
        assert model.model.traits.exposures.of(camera).tolist() == WARM
    assert len(read) == 4
