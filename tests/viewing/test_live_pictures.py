"""Cameras and pictures of the live view: what is drawn at which zoom, how fine, from files and levels."""

import json
import math
from dataclasses import replace

import anchor_checkpoints
import mip_checkpoints
import moving
import numpy as np
import pytest
import tiny
import torch
from live_screen import SIZE

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import of_base_scale
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SceneError
from mipmap_plugin.models.base import why_no_viewer
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.viewing.around import NEAR, views_for_screen
from mipmap_plugin.viewing.pace import COARSEST, MOVING_S, Pace
from mipmap_plugin.viewing.screen import LARGEST_FOV, Sampling, by_distance, by_lens, inside, pose_of, up_of, zoomed
from mipmap_plugin.viewing.sources import File, Levels, Request, Supersampled, of_adapted, open_source
from mipmap_plugin.viewing.stage import AMPLIFIED, Look, Stage


@pytest.fixture
def sampling(base):
    return Sampling(base.model.parameters()["means"], base.views(), NEAR_PLANE)


# Cameras


def test_a_pose_gives_back_its_camera(base):
    view = base.cameras[1]
    pose = pose_of(view, depth=2.0)
    camera = pose.camera(view.width, view.height)
    assert torch.allclose(camera.viewmat, view.viewmat) and camera.fy == pytest.approx(view.fy)
    middle = camera.to_camera(torch.tensor([pose.look_at], dtype=torch.float64))[0]
    assert torch.allclose(middle, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))


def test_a_view_of_the_training_is_at_zoom_1_and_fewer_pixels_at_less(base, sampling):
    zooms = [sampling.of(view).zoom for view in base.cameras]
    assert min(zooms) == pytest.approx(1, abs=0.25) and max(zooms) == pytest.approx(1, abs=0.25)
    view = base.cameras[0]
    assert sampling.of(view.zoomed(1 / 4)).zoom == pytest.approx(sampling.of(view).zoom / 4)
    assert sampling.of(view).splats == int(inside(sampling.means, view, NEAR_PLANE).sum()) > 0


def test_a_camera_that_sees_nothing_has_a_zoom(sampling, base):
    away = pose_of(base.cameras[0], 1.0)
    away = replace(away, position=(100.0, 100.0, 100.0))
    assert sampling.of(away.camera(8, 8)).splats == 0 and sampling.of(away.camera(8, 8)).zoom == 1
    assert zoomed(away, 0.25, sampling, (8, 8), by_distance) == away


@pytest.mark.parametrize("zoom", [1 / 8, 1 / 2, 1.5])
def test_zooming_by_distance_moves_the_eye_to_that_zoom(base, sampling, zoom):
    before = pose_of(base.cameras[0], sampling.of(base.cameras[0]).depth)
    after = zoomed(before, zoom, sampling, SIZE, by_distance)
    assert sampling.of(after.camera(SIZE[1], SIZE[0])).zoom == pytest.approx(zoom, rel=0.05)
    assert (after.look_at, after.wxyz, after.fov) == (before.look_at, before.wxyz, before.fov)


@pytest.mark.parametrize("zoom", [3 / 4, 3.0])
def test_zooming_by_focal_length_changes_the_lens_alone(base, sampling, zoom):
    before = pose_of(base.cameras[0], 2.0)
    after = zoomed(before, zoom, sampling, SIZE, by_lens)
    assert sampling.of(after.camera(SIZE[1], SIZE[0])).zoom == pytest.approx(zoom, rel=0.05)
    assert replace(after, fov=before.fov) == before


def test_the_field_of_view_stays_below_a_half_circle(base):
    assert by_lens(pose_of(base.cameras[0], 2.0), 1e-3).fov == LARGEST_FOV


def test_up_is_what_the_views_have_in_common(base):
    assert torch.tensor(up_of(base.cameras)).dot(torch.tensor([0.0, 0.0, 1.0])) > 0.8


# Pictures


def test_the_base_is_drawn_as_render_draws_it(stage, base, screen):
    assert torch.equal(stage.draw(Look("base"), screen).image, base.render(screen).image.clamp(0, 1))
    spark = stage.draw(Look("base", viewer="spark"), screen)
    assert torch.equal(spark.image, base.render(screen, viewer="spark").image.clamp(0, 1))
    assert spark.splats == (int(inside(base.model.parameters()["means"], screen, NEAR_PLANE).sum()), 60) and spark.psnr_db is None


@pytest.mark.filterwarnings("ignore:no cameras", "ignore:the scene is")
def test_a_small_scene_without_cameras_is_seen_nearer_than_the_near_plane_of_3dgs():
    """And so is what is adapted of it, which was drawn as nothing."""
    splats = tiny.gaussians()
    base = wrap_model(VanillaModel.from_gaussians(replace(splats, means=0.02 * splats.means, scales=0.02 * splats.scales)))
    stage, screen = Stage(base, [File("base", base)], Supersampled("supersampled", base)), base.views()[0]
    drawn = stage.draw(Look("base"), screen)
    assert drawn.zoom == pytest.approx(1, abs=0.1) and drawn.splats[0] > 50
    adapted = base.adapt(1 / 2, recipe="instant", extra_views=4)
    assert torch.equal(of_adapted("new", adapted, base).render(Request(screen, 1.0)), adapted.render(screen).image)
    assert len({view.cx for view in views_for_screen(base, screen.resized(1600, 1200), torch.zeros(3), 1.0)[:NEAR]}) > NEAR / 2


@pytest.mark.parametrize("viewer", [None, "classic", "playcanvas"])
def test_a_coarse_picture_looks_like_the_whole_one(stage, base, screen, viewer):
    """Fewer pixels alone would show thicker splats."""
    whole, coarse = (stage.draw(Look("base", viewer=viewer), screen, fraction).image for fraction in (1.0, 0.25))
    small = screen.resized(SIZE[1] // 4, SIZE[0] // 4)
    assert coarse.shape[:2] == small.size
    shrunk, plain = resize(whole, small.size, "box"), base.render(small, viewer=viewer).image.clamp(0, 1)
    assert (coarse - shrunk).square().mean() < 0.6 * (plain - shrunk).square().mean()


def test_pixels_are_enlarged_whole(stage, base, screen):
    odd = screen.resized(67, 50)
    picture = stage.draw(Look("base", pixel=4), odd)
    assert picture.image.shape == (50, 67, 3) and (picture.drawn.height, picture.drawn.width) == (12, 17)
    assert torch.equal(picture.image[0:4, 0:4], picture.image[:1, :1].expand(4, 4, 3))
    assert picture.zoom == pytest.approx(stage.draw(Look("base"), odd).zoom / 4, rel=0.05)


def test_a_picture_is_timed_until_the_device_has_drawn_it(stage, screen, monkeypatch):
    """On a GPU the host is done long before."""
    waited = []
    monkeypatch.setattr(stage, "_device", torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    stage.draw(Look("base"), screen)
    assert waited == [torch.device("cuda")] * 2


def test_a_difference_is_amplified_and_measured(stage, screen):
    same = stage.draw(Look("base", against="base"), screen)
    assert same.image.abs().max() == 0 and same.psnr_db > 100
    base, supersampled = (stage.draw(Look(name), screen).image for name in ("base", "supersampled"))
    apart = stage.draw(Look("base", against="supersampled"), screen)
    assert torch.allclose(apart.image, (AMPLIFIED * (base - supersampled).abs()).clamp(0, 1))
    assert apart.psnr_db == pytest.approx(-10 * math.log10((base - supersampled).square().mean()), abs=0.01)


def test_the_supersampled_base_is_the_mean_of_the_look_that_was_trained(base, screen):
    small = screen.zoomed(1 / 8)
    image = Supersampled("s", base).render(Request(small, 1 / 4))
    fine = base.render(small.resized(small.width * 4, small.height * 4), 1.0, "scaled").image.clamp(0, 1)
    assert torch.allclose(image, resize(fine, small.size, "box"))


@pytest.mark.parametrize("write", [anchor_checkpoints.write, moving.write_deformable, mip_checkpoints.folder], ids=["anchors", "moving", "filtered"])
def test_every_kind_of_family_is_drawn(tmp_path, write, screen):
    write(tmp_path / "base")
    base = wrap_model(tmp_path / "base", cameras=tiny.cameras(4))
    stage = Stage(base, [File("base", base)], Supersampled("supersampled", base))
    for look in (Look("base"), Look("supersampled"), Look("base", pixel=2)):
        picture = stage.draw(look, screen)
        assert picture.image.shape == (*SIZE, 3) and picture.splats[0] <= picture.splats[1] > 0
    if not why_no_viewer(base.model):
        assert torch.equal(stage.draw(Look("base", viewer="classic"), screen).image, base.render(screen, viewer="classic").image.clamp(0, 1))


def test_sources_of_the_same_name_are_told_apart(stage, base):
    assert [stage.add(File("base", base)) for _ in range(2)] == ["base (2)", "base (3)"]


# Files and levels


def ladder(folder, shown_from=(0.7, None)):
    levels = []
    for number, least in enumerate(shown_from):
        tiny.ply(folder / f"level_{number}.ply", count=60 - 20 * number)
        levels.append({"file": f"level_{number}.ply", "shown_from": least})
    (folder / "levels.json").write_text(json.dumps({"levels": levels}))
    return folder


def test_a_ladder_shows_the_level_of_the_zoom(tmp_path, base, screen):
    (tmp_path / "ladder").mkdir()
    levels = open_source(ladder(tmp_path / "ladder"), base, "auto")
    assert isinstance(levels, Levels) and levels.name == "ladder"
    assert [levels.shown(zoom) for zoom in (4.0, 0.7, 0.69, 0.01)] == ["ladder, level_0.ply"] * 2 + ["ladder, level_1.ply"] * 2
    assert [levels.splats(Request(screen, zoom))[1] for zoom in (1.0, 0.5)] == [60, 40]
    alone = File("level_1", wrap_model(tmp_path / "ladder/level_1.ply", cameras=base.cameras))
    assert torch.equal(levels.render(Request(screen, 0.5)), alone.render(Request(screen, 0.5)))


DAMAGED = ['{"levels": []}', "[]", '{"levels": [{"file": "level_0.ply"}]}', '{"levels": [{"file": "a", "shown_from": "b"}]}']
DAMAGED += [f'{{"levels": [{{"file": "level_0.ply", "shown_from": {"9" * 400}}}]}}']  # more than a float holds
BY_DISTANCE = '{"by": "distance", "levels": [{"file": "level_0.ply", "distance_from": 0}]}'  # whose picture has a level for each distance


NO_LEVELS = "lists no levels, or is damaged"


@pytest.mark.parametrize(("text", "told"), [*((text, NO_LEVELS) for text in DAMAGED), (BY_DISTANCE, "by distance.* give a file of it")])
def test_a_ladder_that_is_damaged_or_by_distance_is_refused(tmp_path, base, text, told):
    (tmp_path / "levels.json").write_text(text)
    with pytest.raises(SceneError, match=told):
        open_source(tmp_path, base, "reference")


def test_an_adapted_file_is_shown_on_the_background_of_the_base(tmp_path, screen):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(4), background=(1.0, 1.0, 1.0))
    adapted = base.adapt(1 / 2, recipe="instant")
    shown = of_adapted("new", adapted, base).render(Request(screen, 0.5))
    assert torch.equal(shown, adapted.render(screen).image) and shown[0, 0].min() == 1
    saved = open_source(adapted.save(tmp_path / "new.ply"), base, "reference")
    assert torch.allclose(saved.render(Request(screen, 0.5)), shown, atol=1e-3)


# While the camera moves


def test_a_first_moving_picture_is_coarse_and_later_ones_are_as_fine_as_time_allows():
    pace = Pace()
    assert pace.fraction(1000) == COARSEST
    for _ in range(20):
        pace.learn(pixels=1000, seconds=MOVING_S)
    assert pace.fraction(1000) == pytest.approx(1) and pace.fraction(4000) == pytest.approx(1 / 2) and pace.fraction(10**9) == COARSEST


# Levels of detail of Octree-GS


@pytest.fixture
def octree(tmp_path):
    """Octree-GS's scene on a stage, from which one walks away: four times as far, through the lens of the training."""
    info = np.zeros(200)
    info[:2] = anchor_checkpoints.VOXEL, 40.0  # the distance of level 0, which is beyond that of the walk
    ply = anchor_checkpoints.write(tmp_path / "octree", anchor_checkpoints.Layout("octree"), count=200, info=info)
    base = wrap_model(ply, cameras=tiny.cameras(4))
    stage = Stage(base, [File("base", base)], Supersampled("supersampled", base))
    view = base.cameras[0]
    far = by_distance(pose_of(view, float(view.center.norm())), 1 / 4).camera(view.width, view.height)
    return base, stage, far


def test_octree_gs_counts_a_distance_once(octree):
    """Its own rule is of distances and of the lens."""
    base, stage, far = octree
    drawn = stage.draw(Look("base"), far).image
    assert torch.equal(drawn, base.render(far).image.clamp(0, 1))
    assert not torch.equal(drawn, base.render(replace(far, zoom=1 / 4)).image.clamp(0, 1))
    assert stage.draw(Look("base"), far.zoomed(1 / 2)).drawn.zoom == pytest.approx(1 / 2, rel=1e-3)


def test_views_for_a_distant_screen_show_its_levels_and_their_truth_those_of_the_training(octree):
    base, stage, far = octree
    levels = base.model.wanted_levels
    screen = stage.camera(Look("base"), far)
    view = views_for_screen(base, screen, torch.zeros(3, dtype=torch.float64), 1 / 4)[0].looking_from(far.viewmat, "in its place")
    assert torch.equal(levels(view.zoomed(1 / 4)), levels(screen)) and levels(screen).max() > 0
    truth, _ = BaseImages(base.model, base.backend()[0], base.effects())._shot(of_base_scale([view])[0], 1 / 2)
    assert torch.equal(levels(truth), levels(replace(far, zoom=4.0))) and truth.size == view.resized(view.width // 2, view.height // 2).size
