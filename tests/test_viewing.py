"""The live view without a browser: cameras, pictures, and an adaptation that is watched and stopped."""

import hashlib
import json
import math
import socket
import sys
import threading
import time
import warnings
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import MagicMock

import anchor_checkpoints
import mip_checkpoints
import moving
import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.moments import at_moments
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.cli import main
from mipmap_plugin.commands.view import _choices, _free, has_display
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.models.base import why_no_viewer
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.viewing import adapting
from mipmap_plugin.viewing import page as live_page
from mipmap_plugin.viewing import server as viewing_server
from mipmap_plugin.viewing.adapting import Adapter, Live, Progress, Wish
from mipmap_plugin.viewing.around import BASE_PIXELS, NEAR, PIXELS, views_for_screen
from mipmap_plugin.viewing.controls import MARKS, STOPS, figures, words
from mipmap_plugin.viewing.pace import COARSEST, MOVING_S, Pace
from mipmap_plugin.viewing.page import Page, PageSettings
from mipmap_plugin.viewing.screen import LARGEST_FOV, Sampling, by_distance, by_lens, inside, pose_of, up_of, zoomed
from mipmap_plugin.viewing.server import NO_VISER, check_address, foreign_page, served, without_words
from mipmap_plugin.viewing.sources import File, Levels, Request, Supersampled, of_adapted, open_source
from mipmap_plugin.viewing.stage import AMPLIFIED, Look, Stage

SIZE = (48, 64)  # height, width


@pytest.fixture
def base():
    return wrap_model(tiny.model(), cameras=tiny.cameras(4))


@pytest.fixture
def stage(base):
    return Stage(base, [File("base", base)], Supersampled("supersampled", base))


@pytest.fixture
def sampling(base):
    return Sampling(base.model.parameters()["means"], base.views())


@pytest.fixture
def screen(base):
    return base.cameras[0].resized(SIZE[1], SIZE[0])


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
    assert sampling.of(view).splats == int(inside(sampling.means, view).sum()) > 0


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
    assert spark.splats == (int(inside(base.model.parameters()["means"], screen).sum()), 60) and spark.psnr_db is None


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


def test_a_ladder_by_distance_is_refused(tmp_path, base):
    """A picture of it has a level for each distance."""
    (tmp_path / "levels.json").write_text('{"by": "distance", "levels": [{"file": "level_0.ply", "distance_from": 0}]}')
    with pytest.raises(SceneError, match=r"by distance.* give a file of it"):
        open_source(tmp_path, base, "reference")


@pytest.mark.parametrize("text", ['{"levels": []}', "[]", '{"levels": [{"file": "level_0.ply"}]}', '{"levels": [{"file": "a", "shown_from": "b"}]}'])
def test_a_damaged_ladder_is_refused(tmp_path, base, text):
    (tmp_path / "levels.json").write_text(text)
    with pytest.raises(SceneError, match="lists no levels, or is damaged"):
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


# Adapting


def wish(base, scale=1 / 2, **changes):
    screen = base.cameras[0].zoomed(scale)
    return Wish(**{"screen": screen, "look_at": (0.0, 0.0, 0.0), "zoom": scale, "viewer": None, "seconds": 30.0, "recipe": "default", **changes})


def ended(adapter, wish):
    """What a run has come to when it has ended."""
    over = threading.Event()
    adapter.start(wish, over.set)
    assert over.wait(120)
    return adapter.progress


def test_views_lie_around_the_screen_and_show_its_splats_but_are_not_its_own(base):
    screen = base.cameras[0].resized(1600, 1200).zoomed(1 / 2)
    views = views_for_screen(base, screen, torch.zeros(3, dtype=torch.float64), 1 / 2)
    near = views[:NEAR]
    distances = [float((view.center - screen.center).norm()) for view in near]
    assert min(distances) > 0 and max(distances) < 0.3 * float(screen.center.norm())
    assert all(float(view.center.norm()) == pytest.approx(float(screen.center.norm())) for view in near)
    shown = [view.zoomed(1 / 2) for view in near]
    assert all(view.width * view.height <= 1.01 * PIXELS and view.fx == pytest.approx(screen.fx, rel=0.01) for view in shown)
    assert all(view.width * view.height <= 1.01 * BASE_PIXELS for view in near)
    assert all(inside(base.model.parameters()["means"], view).sum() > 2 for view in shown) and len({view.cx for view in shown}) > NEAR / 2
    assert views[NEAR:] and all(torch.equal(view.viewmat, base.cameras[number].viewmat) for number, view in enumerate(views[NEAR:]))


def test_of_large_views_of_the_scene_the_middle_is_adapted_to(base):
    screen = base.cameras[0].zoomed(40)
    views = views_for_screen(base, screen, torch.zeros(3, dtype=torch.float64), 40.0)
    own = [view.zoomed(40) for view in views[NEAR:]]
    assert all(0.8 * PIXELS < view.width * view.height <= PIXELS and abs(view.cx - view.width / 2) < 40 for view in own)


def test_a_run_shows_its_states_and_stopped_it_returns_the_best_and_the_base_stays(base, monkeypatch):
    monkeypatch.setattr(adapting, "MEASURED_EVERY_S", 0.0)
    before, request = digest(base), wish(base)
    seen, over = threading.Event(), threading.Event()  # the run goes on until a state was seen, however slow this machine is
    adapter = Adapter(base, Supersampled("supersampled", base), lambda: seen.is_set() and len(adapter.progress.curve) > 3 and adapter.stop())
    live, start = Live(adapter, File("base", base)), File("base", base).render(Request(request.screen, request.zoom))
    adapter.start(request, over.set)
    while not over.is_set():
        if not torch.equal(live.render(Request(request.screen, request.zoom)), start):
            seen.set()
    progress = adapter.progress
    assert progress.trouble == "" and not progress.running and digest(base) == before
    report = progress.adapted.report
    assert (report.scale, report.ended_by) == (0.5, "its observer") and report.curve[-1].step >= 3
    returned = next(db for name, db in report.validation.items() if report.returned.startswith(name))
    assert returned > max(report.validation.values()) - 0.02  # of equals the last
    assert seen.is_set() and len(progress.curve) >= 4 and progress.curve[0][0] < progress.curve[-1][0]
    assert live.shown(0.5) == f"adapting, step {report.curve[-1].step}" and live.splats(Request(request.screen, 0.5)) is None


def test_what_cannot_be_adapted_is_told(base):
    progress = ended(Adapter(base, Supersampled("supersampled", base)), wish(base, recipe="nonsense"))
    assert progress.adapted is None and "there is no recipe 'nonsense'" in progress.trouble
    assert "there is no recipe 'nonsense'" in words(progress)


def test_only_one_run_at_a_time(base):
    adapter, over = Adapter(base, Supersampled("supersampled", base)), threading.Event()
    adapter.start(wish(base, recipe="instant"), over.set)
    with pytest.raises(SettingsError, match="stop it first"):
        adapter.start(wish(base))
    assert over.wait(120) and adapter.progress.adapted is not None


def test_of_two_that_start_at_once_one_is_refused(base, monkeypatch):
    adapter, refused, others, over = Adapter(base, Supersampled("supersampled", base)), [], [], threading.Event()
    clear = adapter._stopping.clear

    def another():
        try:
            adapter.start(wish(base, recipe="instant"), over.set)
        except SettingsError:
            refused.append(True)

    def slow():
        if not others:
            others.append(threading.Thread(target=another))
            others[0].start()
            others[0].join(0.3)
        clear()

    monkeypatch.setattr(adapter._stopping, "clear", slow)
    adapter.start(wish(base, recipe="instant"), over.set)
    others[0].join(60)
    assert refused == [True] and over.wait(120)


def test_a_run_that_is_preparing_ends_with_the_program(base, monkeypatch):
    monkeypatch.setattr(adapting, "GRACE_S", 0.1)
    preparing = threading.Event()

    def forever(*_, **__):
        preparing.set()
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(base, "adapt", forever)
    adapter = Adapter(base, Supersampled("supersampled", base))
    adapter.start(wish(base))
    assert preparing.wait(60) and adapter.picture(base.cameras[0]) is None
    adapter.close()
    assert not adapter.progress.running and adapter.progress.adapted is None and not adapter._thread.is_alive()


def test_a_zoom_is_rounded_to_the_scale_of_a_file(base):
    assert [wish(base, zoom=zoom).scale for zoom in (0.98, 1.02, 0.26789, 3.14159)] == [1.0, 1.0, 0.268, 3.14]


def digest(base):
    return [hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest() for tensor in base.model.parameters().values()]


# The page, with something in the place of viser's server


def client(**camera):
    """A browser with a camera."""
    pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -3.0), "look_at": (0.0, 0.0, 0.0), "fov": 0.8, "image_width": 64, "image_height": 48}
    return MagicMock(camera=SimpleNamespace(**pose | camera))


@pytest.fixture
def page(stage, base, monkeypatch, tmp_path):
    element = lambda *_, initial_value=None, **__: MagicMock(value=initial_value)  # noqa: E731
    server = MagicMock(**{f"gui.add_{kind}.side_effect": element for kind in ("dropdown", "slider", "number")})
    monkeypatch.setattr(live_page, "served", lambda *_: server)
    base.cameras = [replace(view, name="r_0") for view in base.cameras]
    return Page(stage, File("base", base), PageSettings("127.0.0.1", 8080, "scene", [None], ["default"], lambda *_: tmp_path / "new.ply"))


class TestMoving:
    """A slider of moments, for what moves alone."""

    @pytest.fixture
    def base(self, tmp_path):
        moments = [replace(view, time=time) for view, time in zip(tiny.cameras(4), (0.3, 0.7, None, 0.1), strict=True)]
        return wrap_model(moving.write_deformable(tmp_path / "moving"), cameras=moments)

    def test_the_moment_of_the_slider_is_drawn(self, page, base, screen):
        assert page._controls.look().time == 0.3  # that of the view that is shown first
        page._controls.time.value = 0.9
        shown = page._stage.draw(page._controls.look(), screen).image
        assert torch.equal(shown, base.render(replace(screen, time=0.9)).image.clamp(0, 1))
        assert not torch.equal(shown, base.render(replace(screen, time=0.3)).image.clamp(0, 1))

    def test_a_view_that_is_gone_to_brings_its_moment(self, page, monkeypatch):
        monkeypatch.setattr(live_page, "_move", lambda *_: None)
        for name, moment in (("r_0 (2)", 0.7), ("r_0 (3)", 0.7), ("r_0 (4)", 0.1)):  # the third has none
            page._controls.view.value = name
            page._go(MagicMock())
            assert page._controls.look().time == moment

    def test_the_moment_on_the_screen_is_adapted_for(self, page, base, screen, monkeypatch):
        wishes = []
        monkeypatch.setattr(live_page, "_view", lambda _: (pose_of(screen, 2.0), 64, 48))
        monkeypatch.setattr(page.adapter, "start", lambda wish, then: wishes.append(wish))
        page._controls.time.value = 0.5
        page._adapt(MagicMock())
        assert wishes[0].screen.time == 0.5
        views = views_for_screen(base, wishes[0].screen, torch.zeros(3, dtype=torch.float64), 1 / 2)
        assert {view.time for view in views[:NEAR]} == {0.5} and [view.time for view in views[NEAR:]] == [view.time for view in base.views()]

    @pytest.mark.parametrize("most", [2, 6])
    def test_it_stays_one_of_the_moments_however_few_there_are(self, base, screen, most):
        base.cameras = [replace(view, time=number / 39) for number, view in enumerate(tiny.cameras(40))]
        views = views_for_screen(base, replace(screen, time=0.51), torch.zeros(3, dtype=torch.float64), 1 / 2)
        taken = at_moments([*views, *base.cameras[:5]], most)
        assert {view.time for view in taken[:NEAR]} == {0.51} and len({view.time for view in taken}) == most

    def test_a_picture_of_another_moment_is_another_one(self, screen):
        assert adapting.alike(replace(screen, time=0.5), replace(screen, time=0.5)) and not adapting.alike(replace(screen, time=0.5), screen)


class TestWithoutCameras:
    """A base of which only is said what is up."""

    @pytest.fixture
    def base(self):
        return wrap_model(tiny.model(), up="-x")

    def test_it_stands_upright_from_the_beginning(self, page):
        server = page._server
        assert server.scene.set_up_direction.call_args.args == ((-1.0, 0.0, 0.0),)
        position, target = server.initial_camera.position, server.initial_camera.look_at
        assert 0.2 < (target[0] - position[0]) / math.dist(position, target) < 0.7  # neither from the horizon nor from high above


def test_a_scene_in_which_nothing_moves_has_no_slider_of_moments(page):
    assert page._controls.time is None and page._controls.look().time is None


def test_every_view_can_be_gone_to_again_and_again_whatever_its_name(page, base, monkeypatch):
    poses = []
    monkeypatch.setattr(live_page, "_move", lambda _, pose: poses.append(pose.position))
    menu = page._controls.view
    for name in ("r_0", "r_0 (4)", "r_0"):
        assert menu.value not in page._views  # viser tells of a choice only if it is another one than what stands there
        menu.value = name
        page._go(MagicMock())
    assert poses == [tuple(base.cameras[number].center.tolist()) for number in (0, 3, 0)]


def test_the_slider_goes_on_from_where_it_moved_the_camera_to(page, screen, monkeypatch):
    """A browser reports a movement later, when the slider may have been moved again."""
    reported, browser, begun = pose_of(screen, 2.0), MagicMock(client=MagicMock(client_id=7)), []
    monkeypatch.setattr(live_page, "_view", lambda _: (reported, 64, 48))
    monkeypatch.setattr(live_page, "zoomed", lambda pose, zoom, *_: begun.append(pose) or replace(pose, fov=pose.fov / 2))
    page._zoom(browser)
    page._zoom(browser)
    assert begun == [reported, replace(reported, fov=reported.fov / 2)]
    monkeypatch.setattr(live_page, "HANDS_OFF_S", 0.0)
    page._zoom(browser)
    assert begun[2] == reported


def test_a_camera_that_missed_the_sliders_zoom_is_moved_once_more_and_then_the_slider_follows(page, screen, monkeypatch):
    moved = []
    monkeypatch.setattr(live_page, "_view", lambda _: (pose_of(screen, 2.0), 64, 48))
    monkeypatch.setattr(live_page, "zoomed", lambda pose, zoom, *_: moved.append(zoom) or pose)
    page._controls.zoom.value = 1.0
    page._zoom(MagicMock())
    page._controls._stops = 0.7, 1.0  # the picture's zoom, and where the slider was then
    page._settle()
    assert moved == [2.0, 2.0] and page._controls.zoom.value == 1.0
    page._settle()
    assert len(moved) == 2 and page._controls.zoom.value == 0.7


@pytest.mark.parametrize("error", [MemoryError(), torch.OutOfMemoryError("CUDA out of memory"), RuntimeError("can't allocate memory")])
def test_a_picture_that_does_not_fit_into_the_memory_does_not_end_the_page(page, screen, monkeypatch, error):
    monkeypatch.setattr(page._stage, "draw", MagicMock(side_effect=error))
    page._tried(page._draw, MagicMock(), Look("base"), (pose_of(screen, 2.0), 64, 48), 1.0)
    assert page._controls.figures.content == live_page.OUT_OF_MEMORY


@pytest.mark.parametrize("broken", [{"fov": 0.0}, {"fov": math.nan}, {"fov": math.pi}, {"position": (math.nan, 0.0, 0.0)}])
def test_a_browser_whose_camera_is_none_does_not_end_the_page_for_all(page, screen, monkeypatch, broken):
    browser = MagicMock()
    monkeypatch.setattr(live_page, "_view", lambda _: (replace(pose_of(screen, 2.0), **broken), 64, 48))
    assert not page._tried(page._serve, 1, browser)
    assert not browser.scene.set_background_image.called and page._controls.figures.content.startswith(("the field of view", "camera 'screen'"))


@pytest.mark.parametrize("sent", [{"position": (0.0, 0.0)}, {"image_width": None}])
def test_a_browser_that_sends_nonsense_does_not_end_the_page_for_others(page, monkeypatch, sent):
    odd, other = client(**sent), client()
    page._server.get_clients.return_value = {1: odd, 2: other}
    monkeypatch.setattr(page._changed, "wait", MagicMock(side_effect=[None, KeyboardInterrupt]))
    with pytest.raises(KeyboardInterrupt):
        page.run()
    assert other.scene.set_background_image.called and not odd.scene.set_background_image.called


@pytest.mark.parametrize(("element", "value", "told"), [("source", "nothing", "KeyError: 'nothing'"), ("pixel", "0", "ZeroDivisionError")])
def test_what_goes_wrong_in_a_picture_is_told_and_the_next_one_is_drawn(page, element, value, told):
    getattr(page._controls, element).value, browser = value, client()
    page._tried(page._serve, 1, browser)
    assert told in page._controls.figures.content and not browser.scene.set_background_image.called
    getattr(page._controls, element).value = {"source": "base", "pixel": "1"}[element]
    page._tried(page._serve, 1, browser)
    assert browser.scene.set_background_image.called


@pytest.mark.parametrize(("size", "drawn"), [
    ((1280, 800), (1280, 800)), ((0, 0), (1, 1)), ((10**6, 1), (2**14, 1)), ((10**6, 10**6), (2**12, 2**12)), ((15360, 8640), (5461, 3072)),
])  # fmt: skip
def test_of_a_canvas_larger_than_any_screen_fewer_pixels_are_drawn(size, drawn):
    _, width, height = live_page._view(client(image_width=size[0], image_height=size[1]))
    assert (width, height) == drawn


def test_a_window_of_no_size_is_drawn_with_enlarged_pixels(page):
    """A window that is hidden has none."""
    hidden = client(image_width=0, image_height=0)
    page._controls.pixel.value = "8"
    for number in range(2):  # the second is paced by the first
        page._serve(number, hidden)
    assert hidden.scene.set_background_image.call_count == 2


def test_what_is_saved_is_not_saved_again(page, base, tmp_path):
    """Two browsers may press the button at once."""
    page.adapter.progress = Progress(adapted=base.adapt(1 / 2, recipe="instant"))
    page._controls.save.disabled = False
    page._save(None)
    assert page._controls.save.disabled and page._controls.told.content == f"saved: {tmp_path / 'new.ply'}"
    page._save(None)
    assert page._controls.told.content.startswith("saved: ")  # and not that there is such a file


# Words


def test_the_figures_are_told(stage, screen):
    text = figures(stage.draw(Look("base", against="supersampled"), screen))
    assert "64 × 48 px" in text and "of 60 splats" in text and "dB apart" in text and "· base" in text


def test_a_run_is_told_from_its_beginning_to_its_end(base):
    request = wish(base, viewer="spark")
    assert words(Progress()) == "" and words(Progress(request)) == "×0.5 for spark: preparing ..."
    assert words(Progress(request, step=7, curve=((0.0, 20.0),))) == "×0.5 for spark: step 7"
    done = words(Progress(request, adapted=base.adapt(1 / 2, recipe="instant", viewer="spark")))
    assert "dB on views that nothing was adapted to" in done and "60 → 60 splats" in done


# The command


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("viser", reason="viser is not installed")
    server = served("127.0.0.1", 0)
    yield server
    with without_words():
        server.stop()


def test_without_viser_the_command_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(tiny.ply(tmp_path / "base.ply")), "--no-browser"]) == 2
    assert capsys.readouterr().err.strip() == f"mipmap-plugin: {NO_VISER}"
    assert "pip install 'mipmap-plugin[view]'" in NO_VISER and "pip install '.[view]'" in NO_VISER


def test_a_viewer_is_listed_once_under_the_name_that_was_asked_for(base):
    viewers, _ = _choices(base, "supersplat")
    assert viewers[:2] == ["supersplat", None] and "playcanvas" not in viewers
    assert {"classic", "spark", "aframe"} < {*viewers} and not {"inria", "kiri", "drei", "threejs"} & {*viewers}
    assert find_viewer("drei") is find_viewer("aframe")  # whose shader it has


@pytest.mark.parametrize(("options", "message"), [
    (["--port", "70000"], "port: must be from 0 to 65535"),
    (["--output", __file__], "give --output a folder"),
    (["--viewer", "portable"], "portable"),
    (["--viewer", "nonsense"], "there is no viewer 'nonsense'"),
    (["--threads", "0"], "threads must be at least 1"),
])  # fmt: skip
def test_wrong_options_are_told(tmp_path, capsys, options, message):
    words = ["view", str(tiny.ply(tmp_path / "base.ply")), "--no-browser"]
    assert main([*words, *options]) == 2 and message in capsys.readouterr().err


def test_an_address_that_cannot_be_served_is_told():
    with pytest.raises(SettingsError, match="nothing can be served at"):
        check_address("192.0.2.1", 8080)  # an address for documentation, which no machine has
    check_address("127.0.0.1", 0)


@pytest.mark.parametrize(("page", "host", "taken"), [
    (None, "", True),  # no browser
    ("http://127.0.0.1:{port}", "", True),
    ("http://localhost:{port}", "localhost:{port}", True),  # through ssh -L
    ("https://scenes.example", "scenes.example", True),  # behind a proxy
    ("http://evil.example", "", False),
    ("http://127.0.0.1:1", "", False),
    ("null", "", False),  # a file
])  # fmt: skip
def test_only_its_own_page_sees_the_scene(server, page, host, taken):
    """A browser lets every page talk to this machine, and says which one does."""
    headers = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
    headers += ["Host: " + (host or "127.0.0.1:{port}"), *([] if page is None else [f"Origin: {page}"])]
    port = server.get_port()
    with warnings.catch_warnings(record=True) as told, socket.create_connection(("127.0.0.1", port)) as connection:
        warnings.simplefilter("always")
        connection.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).format(port=port).encode())
        assert connection.recv(99).split()[1] == (b"101" if taken else b"403")
    ours = [str(each.message) for each in told if each.filename == viewing_server.__file__]
    assert len(ours) == (not taken) and all(f"a page of '{page}' asked".format(port=port) in each for each in ours)


@pytest.mark.parametrize(("page", "foreign"), [("https://scenes.example", False), ("https://inner", False), ("https://evil", True), ("null", True)])
def test_several_proxies_name_their_hosts_in_a_list(page, foreign):
    headers = {"Origin": page, "Host": "127.0.0.1:8080", "X-Forwarded-Host": "scenes.example, inner", "Upgrade": "websocket"}
    assert foreign_page(headers) == foreign and foreign_page(headers | {"X-Forwarded-Host": ""})


def test_a_browser_that_is_closed_while_its_picture_is_drawn_is_nothing_to_warn_of(monkeypatch):
    pytest.importorskip("websockets", reason="viser is not installed")
    monkeypatch.setitem(sys.modules, "viser", MagicMock())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        served("127.0.0.1", 0)
        warnings.warn("Queued a BackgroundImageMessage on a closed connection (e.g. ...); it will never be delivered.", stacklevel=1)
    assert told == []


def test_what_is_saved_takes_a_free_name(tmp_path):
    (tmp_path / "bicycle").mkdir()
    free = _free(tmp_path / "bicycle", None)
    assert free(0.25, "spark") == tmp_path / "bicycle_x0.25_spark"
    (tmp_path / "bicycle_x0.25_spark").mkdir()
    assert free(0.25, "spark") == tmp_path / "bicycle_x0.25_spark_2"
    (tmp_path / "base.ply").touch()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "base_x0.5.ply").touch()
    assert _free(tmp_path / "base.ply", tmp_path / "out")(0.5, None) == tmp_path / "out" / "base_x0.5_2.ply"


def test_a_display_is_known_by_the_environment(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert not has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()


def test_the_names_on_the_slider_have_room_on_a_phone():
    """On a screen of 360 px the slider of viser has 88 px, and a letter 4."""
    low, high, _ = STOPS
    ends = [(88 * (stop - low) / (high - low), 4 * len(name) / 2) for stop, name in MARKS]
    assert all(left[0] + left[1] < right[0] - right[1] for left, right in pairwise(ends))
