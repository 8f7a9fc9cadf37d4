"""Photographs of another scene than the checkpoint: `evaluate` says so."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch
from PIL import Image

from mipmap_plugin import wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.evaluation.judged import JudgedView, photographed_views
from mipmap_plugin.evaluation.other_scene import of_another_scene, of_another_size
from mipmap_plugin.evaluation.tradeoff.truth import photographs
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import Scene, load_scene

pytestmark = pytest.mark.usefixtures("few_views")

DOUBT = "they may be of another scene, or their cameras in another frame; check --images"


@pytest.fixture
def base():
    return wrap_model(tiny.model(), cameras=tiny.cameras(3))


def seen(base, cameras, noise=0.0):
    """Judged views whose photograph is the base's own picture, less well the more noise there is."""
    rng = torch.Generator().manual_seed(0)
    images = [base.render(camera).image for camera in cameras]
    truths = [(image + noise * torch.rand(image.shape, generator=rng)).clamp(0, 1) for image in images]
    return [JudgedView(camera, own, Path("photograph.png")) for camera, own in zip(cameras, truths, strict=True)]


@pytest.mark.parametrize(("seed", "told"), [(0, False), (5, True)], ids=["its own scene", "another"])
def test_evaluate_tells_of_photographs_of_another_scene(tmp_path, capsys, seed, told):
    base, images = tiny.folder(tmp_path / "base"), tiny.scene(tmp_path / "scene", tiny.cameras(4, seed=9, split="test"), seed=seed)
    assert main(["evaluate", str(base), "--images", str(images), "--scale", "1/2", "--no-report"]) == 0
    assert (DOUBT in capsys.readouterr().err) == told


@pytest.mark.parametrize("words", ["evaluate --scale 1/2 --no-report", "adapt --scale 2 --steps 1"])
def test_photographs_whose_cameras_are_given_too_are_told_of_once(tmp_path, capsys, words):
    command, *more = words.split()
    images = str(tiny.scene(tmp_path / "scene", tiny.cameras(4, seed=9, split="test"), tiny.cameras(4), seed=5))
    assert main([command, str(tiny.ply(tmp_path / "base.ply")), "--images", images, "--cameras", images, *more]) == 0
    assert "".join(capsys.readouterr().err.split()).count("theymaybeofanotherscene") == 1


def test_photographs_of_one_color_are_no_other_scene():
    """The mean of the others shows it exactly, and the base as well as 8 bits can tell."""
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3))
    blank = [JudgedView(camera, torch.zeros(24, 32, 3), Path("photograph.png")) for camera in base.cameras]
    base.model.parameters()["opacities"][:] = -9.0  # below 1/255
    assert of_another_scene(base, blank) == ""
    base.model.parameters()["opacities"][:] = -4.0
    assert of_another_scene(base, blank).endswith("check --images")


def test_a_base_is_compared_with_the_same_photographs_once(tmp_path, recwarn):
    """Not for their cameras, and again at every scale."""
    images = tiny.scene(tmp_path / "scene", tiny.cameras(4, seed=9, split="test"), tiny.cameras(4), seed=5)
    base = wrap_model(tiny.ply(tmp_path / "base.ply"), cameras=images)
    for scale in (2, 4):
        base.adapt(scale, images=images, steps=1)
    others = tiny.scene(tmp_path / "others", tiny.cameras(4, seed=9, split="test"), tiny.cameras(4), seed=6)
    base.adapt(2, images=others, steps=1)
    told = [str(warning.message) for warning in recwarn if "they may be of another scene" in str(warning.message)]
    assert ["check --cameras" in text for text in told] == [True, False]


@pytest.mark.parametrize("command", ["evaluate", "tradeoff"])
def test_all_photographs_whose_cameras_are_given_are_looked_at(tmp_path, capsys, command):
    """Not the judged ones alone, of which one has no others to be compared with."""
    images = str(tiny.scene(tmp_path / "scene", tiny.cameras(1, split="test"), tiny.cameras(5, seed=9), seed=5))
    quick = {"evaluate": ["--no-report", "--recipe", "instant"],
             "tradeoff": ["--output", str(tmp_path / "out"), "--recipe", "instant", "--no-picture", "--no-renderers", "--repeats", "1"]}  # fmt: skip
    assert main([command, str(tiny.ply(tmp_path / "base.ply")), "--images", images, "--cameras", images, "--scale", "1/2", *quick[command]]) == 0
    assert "check --cameras" in " ".join(capsys.readouterr().err.split())


def test_an_adapted_file_is_not_doubted_for_what_it_shows_at_another_scale(tmp_path, capsys):
    base, images = tiny.folder(tmp_path / "base"), tiny.scene(tmp_path / "scene", tiny.cameras(4, seed=9, split="test"))
    assert main(["adapt", str(base), "--scale", "1/4", "--recipe", "instant", "--output", str(tmp_path / "adapted")]) == 0
    assert main(["evaluate", str(tmp_path / "adapted"), "--images", str(images), "--scale", "1/4", "--no-report"]) == 0
    assert DOUBT not in capsys.readouterr().err


@pytest.mark.parametrize(("seed", "told"), [(0, False), (5, True)], ids=["its own scene", "another"])
def test_a_tradeoff_tells_of_them_too(tmp_path, base, recwarn, seed, told):
    scene = load_scene(tiny.scene(tmp_path / "scene", tiny.cameras(4, seed=9, split="test"), seed=seed))
    for scale in (1 / 2, 1 / 8):  # once, and of its own scene not even where all pictures of a few pixels are alike
        photographs(base, scene, scale, None)
    assert sum(DOUBT in str(warning.message) for warning in recwarn) == told


def test_photographs_of_other_views_are_told_of(base):
    views = seen(base, tiny.cameras(4))
    assert not of_another_scene(base, views)
    swapped = [replace(view, source=other.source) for view, other in zip(views, views[1:] + views[:1], strict=True)]
    assert DOUBT in of_another_scene(base, swapped)


def test_a_base_of_low_quality_is_not_doubted(base):
    assert not of_another_scene(base, seen(base, tiny.cameras(4), noise=0.1))


def test_nothing_is_said_of_one_view_nor_of_a_camera_that_stands_still(base):
    [view] = tiny.cameras(1)
    still = [replace(view, name=f"at_{time}", time=time) for time in (0.0, 0.5, 1.0)]
    for cameras in ([view], still):
        dark = [JudgedView(camera, torch.zeros(24, 32, 3), Path("photograph.png")) for camera in cameras]
        assert of_another_scene(base, dark) == ""


def test_photographs_of_several_sizes_are_compared(base):
    cameras = tiny.cameras(4)
    square = [camera.window(24, 24) if number % 2 else camera for number, camera in enumerate(cameras)]
    assert not of_another_scene(base, seen(base, square)) and {camera.size for camera in square} == {(24, 32), (24, 24)}


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_world_that_is_turned_by_half_a_turn_is_told_of(base, axis):
    """LichtFeld Studio turns that of a transforms file about y."""
    turn = torch.diag(torch.tensor([*(1.0 if each == axis else -1.0 for each in "xyz"), 1.0], dtype=torch.float64))
    views = seen(base, tiny.cameras(6))
    turned = [replace(view, camera=view.camera.moved(turn)) for view in views]
    told, angles = of_another_scene(base, turned), {"x": "180,0,0", "y": "0,180,0", "z": "0,0,180"}[axis]
    assert f"turned by half a turn about {axis}" in told and f"(splat-transform -r {angles})" in told


def test_transparent_photographs_that_do_not_fit_are_told_to_count_as_background(tmp_path, base):
    folder = tiny.scene(tmp_path / "scene", tiny.cameras(4, split="test"), seed=5)
    for image in folder.glob("test/*.png"):
        Image.open(image).convert("RGBA").save(image)
    views = photographed_views(base, base.place(load_scene(folder)))
    assert of_another_scene(base, views).endswith("check --images, whose transparent parts count as background")


def test_what_a_base_leaves_empty_does_not_count():
    """Of a capture that was cut down to one object, photographs show much else."""
    whole, cameras = tiny.model(), tiny.cameras(6)
    left = whole.parameters()["means"].norm(dim=1) < 0.6
    assert 10 < left.sum() < 40
    cut = wrap_model(VanillaModel.from_gaussians(tiny.gaussians()[left], whole.trained), cameras=cameras)
    assert not of_another_scene(cut, seen(wrap_model(whole, cameras=cameras), cameras))


def test_photographs_are_compared_as_they_were_exposed(tmp_path, recwarn):
    """3DGS learns an exposure of each photograph (--train_test_exp), which a picture of the base is without."""
    views = tiny.cameras(4)
    folder, model = tiny.folder(tmp_path / "base", views), tiny.model()
    dark = [[0.1, 0.0, 0.0, 0.5], [0.0, 0.1, 0.0, 0.5], [0.0, 0.0, 0.1, 0.5]]
    (folder / "exposure.json").write_text(json.dumps({f"{view.name}.png": dark for view in views}))
    draw = wrap_model(model, cameras=views).render
    tiny.write_photographs(tmp_path / "scene", "train", views, lambda view: 0.5 + 0.1 * draw(view).image)
    wrap_model(folder, cameras=tmp_path / "scene")
    assert not recwarn


def test_cameras_of_a_capture_that_does_not_show_the_splats_are_warned_of(tmp_path, recwarn):
    scene = tiny.scene(tmp_path / "scene", tiny.cameras(4))
    for seed in (0, 5):
        wrap_model(tiny.ply(tmp_path / f"{seed}.ply", seed=seed), cameras=scene)
        assert any("check --cameras" in str(warning.message) for warning in recwarn) == (seed == 5)


def test_a_damaged_photograph_does_not_matter_to_cameras(tmp_path, recwarn):
    scene = tiny.scene(tmp_path / "scene", tiny.cameras(4))
    image = sorted(scene.glob("test/*.png"))[0]
    image.write_bytes(image.read_bytes()[:-40])
    assert len(wrap_model(tiny.ply(tmp_path / "base.ply"), cameras=scene).cameras) == 4 and not recwarn


@pytest.mark.parametrize(
    ("size", "resolution", "told"),
    [
        ((32, 24), -1, ""),
        ((16, 12), -1, "the base's cameras are of 32 x 24 px, but a training on the photographs (of 16 x 12 px) has pictures of 16 x 12 px"),
        ((16, 12), 2, "the base's cameras are of 16 x 12 px, but a training on the photographs (of 16 x 12 px) has pictures of 8 x 6 px"),
        ((64, 48), 1, ""),
        ((64, 48), 32, ""),
    ],
)
def test_photographs_smaller_than_the_cameras_state_are_told_of(tmp_path, size, resolution, told):
    """As in 3DGS's download of Tanks and Temples: COLMAP, and so cameras.json, has twice the size of the photographs."""
    folder, view = tiny.folder(tmp_path / "base"), tiny.cameras(1)[0]
    (folder / "cfg_args").write_text(f"Namespace(images='images', resolution={resolution}, eval=False)")
    (tmp_path / "images").mkdir()
    image = write_image(tmp_path / "images" / f"{view.name}.png", torch.zeros(size[1], size[0], 3))
    doubted = of_another_size(wrap_model(folder, backend="reference"), Scene((view,), {view: image}, tmp_path))
    assert doubted.partition(":")[0] == told
