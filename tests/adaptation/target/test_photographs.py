"""Real images as the truth of a zoom-in, for the views that have one."""

import json
import math
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.photographs import Photographs, at_density_of
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.cli import main
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.recipes import DEFAULT_IN, recipe
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.scenes.training_options import trained_size
from mipmap_plugin.wrap import Interrupted, wrap_model

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photographs at twice the density of the base, of another model than the one that is adapted."""
    train = tiny.cameras(3, width=2 * tiny.WIDTH, height=2 * tiny.HEIGHT)
    return tiny.scene(tmp_path_factory.mktemp("scene"), train=train, seed=5)


@pytest.fixture
def scene(folder):
    return load_scene(folder)


def test_images_are_brought_to_the_density_of_the_base(scene):
    real = Photographs(scene, tiny.cameras(), BLACK)
    assert [camera.size for camera in real.cameras] == [(24, 32)] * 3
    photograph = scene.image(scene.split("train")[1], BLACK)
    torch.testing.assert_close(real(real.cameras[1]), resize(photograph, (24, 32), "pil-bicubic").clamp(0, 1))
    assert real(tiny.cameras()[0]) is None


def test_images_of_several_sizes_are_brought_to_the_density_of_their_own_views():
    """Trainings shrink upright and wide images of one lens to the same width."""
    wide, upright = (Camera(*size, 3000, 3000, size[0] / 2, size[1] / 2, torch.eye(4)) for size in ((4000, 3000), (3000, 4000)))
    base = [wide.resized(1600, 1200), upright.resized(1600, 2133)]
    assert [camera.size for camera in at_density_of([upright, wide], base)] == [(2133, 1600), (1200, 1600)]
    by_name = [replace(base[0], name="a"), replace(base[0].resized(400, 300), name="b")]
    photographs = [replace(wide, name=name) for name in ("images/b.jpg", "a.png", "c")]
    assert [camera.width for camera in at_density_of(photographs, by_name)] == [400, 1600, 1600]
    for alike in ("frame.1", "frame.2.png"), ("left/a", "right/a"):  # which differ behind a dot, or by their folder
        views, photographs = ([replace(each, name=name) for each, name in zip(those, alike, strict=True)] for those in (by_name, (wide, wide)))
        assert [camera.width for camera in at_density_of(photographs, views)] == [1600, 400]


def test_a_photograph_has_the_size_of_its_view_in_the_training():
    """3DGS truncates both sides if `-r` is a width: 301.6 px are 301 px there."""
    photograph = Camera(1000, 754, 900, 910, 500, 377, torch.eye(4))
    base = photograph.resized(*trained_size(1000, 754, {"resolution": 400}))
    assert base.size == (301, 400)
    [view] = at_density_of([photograph], [base])
    assert view.size == base.size and (view.fx, view.fy) == pytest.approx((base.fx, base.fy))


def test_the_principal_point_is_where_the_base_has_it():
    """3DGS takes it to be in the middle, whatever COLMAP found: a base that was trained so would be compared with a shifted picture."""
    found = Camera(4000, 3000, 3000, 3000, 1900, 1550, torch.eye(4), name="images/a.jpg")
    off_center = replace(found.resized(1000, 750), name="a")
    centered = replace(off_center, cx=500, cy=375)
    assert [(camera.cx, camera.cy) for base in (centered, off_center) for camera in at_density_of([found], [base])] == [(500, 375), (475, 387.5)]


def test_a_photograph_of_training_keeps_its_own_appearance():
    """Scaffold-GS has an embedding for each training view; without its number a view is shown with the mean of all."""
    base = [replace(view, name=name, index=number) for number, (name, view) in enumerate(zip("ab", tiny.cameras(2), strict=True))]
    photographs = [replace(view, name=f"images/{name}.png") for name, view in zip("bac", tiny.cameras(3), strict=True)]
    assert [camera.index for camera in at_density_of(photographs, base)] == [1, 0, None]
    assert at_density_of([replace(photographs[0], split="test")], base)[0].index is None  # another view of the same name, as in Blender's scenes


@pytest.mark.parametrize("names", ["{}/image.png", "{}.png"], ids=["all alike", "others"])
def test_pixel_densities_are_found_without_a_calculation_for_each_pair_of_cameras(monkeypatch, names):
    """Where 10,000 photographs have one name, or names and lenses of their own, that took two minutes."""
    base = [replace(view, fx=view.fx * (1 + number / 100), name=names.format(number)) for number, view in enumerate(tiny.cameras(50))]
    photographs, log, count = [replace(view.resized(64, 48), name=f"x/{view.name}" if "/" in names else "x") for view in base], math.log, []
    monkeypatch.setattr(math, "log", lambda number: count.append(number) or log(number))
    assert [view.fx for view in at_density_of(photographs, base)] == pytest.approx([view.fx for view in base])
    assert len(count) < 50 * 20


def test_the_truth_is_the_image_where_there_is_one_and_the_bases_elsewhere(scene):
    real, other = Photographs(scene, tiny.cameras(), BLACK), tiny.cameras(1)[0]
    truth = PseudoTruth(BaseImages(tiny.model(), ReferenceBackend(), Effects(1)), 2, recipe("default", 2), real)
    torch.testing.assert_close(truth(real.cameras[0]), real(real.cameras[0]), atol=1e-4, rtol=0)
    base = ReferenceBackend().render(tiny.gaussians(), other, Effects(1)).image.clamp(0, 1)
    torch.testing.assert_close(truth(other), base, atol=1e-4, rtol=0)


def test_adapting_to_images_says_so_and_leads_elsewhere(scene):
    model = wrap_model(tiny.model(), cameras=tiny.cameras())
    settings = dict(steps=3, extra_views=1)
    adapted, alone = model.adapt(2, images=scene, **settings), model.adapt(2, **settings)
    assert adapted.report.views == "3 train views and 1 around them, 3 of them real images"
    assert not torch.equal(adapted.model.parameters()["sh0"], alone.model.parameters()["sh0"])


def test_photographs_are_learned_from_at_any_zoom_in(scene, monkeypatch):
    """Also where the base's own image has nothing to teach."""
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_IN", DEFAULT_IN | {"steps": 2})
    assert wrap_model(tiny.model(), cameras=tiny.cameras()).adapt(1.05, images=scene).report.curve[-1].step == 2


def test_a_run_is_not_resumed_with_other_images(scene, tmp_path, monkeypatch):
    model, state = wrap_model(tiny.model(), cameras=tiny.cameras()), tmp_path / "state"
    train = tiny.cameras(3, width=2 * tiny.WIDTH, height=2 * tiny.HEIGHT)
    others = load_scene(tiny.scene(tmp_path / "others", train=train, seed=6))
    with monkeypatch.context() as patched:
        patched.setattr("mipmap_plugin.adaptation.session.adapt", lambda run, task, config, stop, observe: stop(run))
        with pytest.raises(Interrupted):
            model.adapt(2, images=scene, resume=state, steps=2)
    with pytest.raises(SettingsError, match="belongs to another base, settings or views"):
        model.adapt(2, images=others, resume=state, steps=2)
    model.adapt(2, images=scene, resume=state, steps=2)


def test_images_that_cannot_take_part_are_refused(scene):
    model = wrap_model(tiny.model(), cameras=tiny.cameras())
    for scale, settings in ((1 / 2, {}), (2, dict(compare_at="target"))):
        with pytest.raises(SettingsError, match="real images can be used only for a zoom-in"):
            model.adapt(scale, images=scene, **settings)
    with pytest.raises(SettingsError, match="the checkpoint has no cameras, so that the scale of the images is not known"):
        wrap_model(tiny.model()).adapt(2, images=scene)


def test_images_of_which_none_is_adapted_to_are_refused(scene):
    """The report would count them all the same."""
    model = wrap_model(tiny.model(), cameras=tiny.cameras())
    with pytest.raises(SettingsError, match="none of the views that are adapted to has a photograph"):
        model.adapt(2, images=scene, steps=1, views="orbit")


def test_images_that_are_smaller_than_the_training_s_are_refused(scene):
    with pytest.raises(SettingsError, match=r"has 64 x 48 px, but the base was trained at 128 x 96 px: .* give larger photographs"):
        Photographs(scene, tiny.cameras(3, width=128, height=96), BLACK)
    first, *others = tiny.cameras(3, width=128, height=96)  # of which each is the base's view of that name
    with pytest.raises(SettingsError, match=r"view_1.png has 64 x 48 px, but the base was trained at 128 x 96 px"):
        Photographs(scene, [first.resized(64, 48), *others], BLACK)


def test_a_scene_without_training_images_is_refused(tmp_path):
    model = wrap_model(tiny.model(), cameras=tiny.cameras())
    with pytest.raises(SettingsError, match="there are no training images to adapt to"):
        model.adapt(2, images=load_scene(tiny.scene(tmp_path / "tests_only")))


def test_the_command_takes_a_folder_of_images(folder, tmp_path, capsys):
    base = tiny.folder(tmp_path / "base")
    words = ["adapt", base, "--scale", "2", "--images", folder, "--steps", "1", "--json"]
    assert main([str(word) for word in words]) == 0
    assert "3 of them real images" in json.loads(capsys.readouterr().out)[0]["views"]
