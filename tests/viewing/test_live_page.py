"""The page of the live view, with something in the place of viser's server."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import moving
import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.moments import at_moments
from mipmap_plugin.viewing import adapting
from mipmap_plugin.viewing import page as live_page
from mipmap_plugin.viewing.adapting import Progress
from mipmap_plugin.viewing.around import NEAR, views_for_screen
from mipmap_plugin.viewing.controls import plain
from mipmap_plugin.viewing.screen import pose_of
from mipmap_plugin.viewing.stage import Look


def client(**camera):
    """A browser with a camera."""
    pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -3.0), "look_at": (0.0, 0.0, 0.0), "fov": 0.8, "image_width": 64, "image_height": 48}
    return MagicMock(camera=SimpleNamespace(**pose | camera))


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
    assert page._controls.save.disabled and page._controls.told.content == plain(f"saved: {tmp_path / 'new.ply'}")
    page._save(None)
    assert page._controls.told.content.startswith("saved: ")  # and not that there is such a file
