"""An adaptation in the live view, which is watched and stopped."""

import hashlib
import threading
import time

import pytest
import torch
from live_screen import wish

from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.viewing import adapting
from mipmap_plugin.viewing.adapting import Adapter, Live
from mipmap_plugin.viewing.around import BASE_PIXELS, NEAR, PIXELS, views_for_screen
from mipmap_plugin.viewing.controls import words
from mipmap_plugin.viewing.screen import inside
from mipmap_plugin.viewing.sources import File, Request, Supersampled


@pytest.fixture
def adapter(base):
    return Adapter(base, Supersampled("supersampled", base))


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
    means = base.model.parameters()["means"]
    assert all(inside(means, view, NEAR_PLANE).sum() > 2 for view in shown) and len({view.cx for view in shown}) > NEAR / 2
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
    live, start = Live(adapter), File("base", base).render(Request(request.screen, request.zoom))
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


def test_what_cannot_be_adapted_is_told(base, adapter):
    progress = ended(adapter, wish(base, recipe="nonsense"))
    assert progress.adapted is None and "there is no recipe 'nonsense'" in progress.trouble
    assert "there is no recipe 'nonsense'" in words(progress)


def test_only_one_run_at_a_time(base, adapter):
    over = threading.Event()
    adapter.start(wish(base, recipe="instant"), over.set)
    with pytest.raises(SettingsError, match="stop it first"):
        adapter.start(wish(base))
    assert over.wait(120) and adapter.progress.adapted is not None


def test_of_two_that_start_at_once_one_is_refused(base, adapter, monkeypatch):
    refused, others, over = [], [], threading.Event()
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


def test_a_run_that_is_preparing_ends_with_the_program(base, adapter, monkeypatch):
    monkeypatch.setattr(adapting, "GRACE_S", 0.1)
    preparing = threading.Event()

    def forever(*_, **__):
        preparing.set()
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(base, "adapt", forever)
    adapter.start(wish(base))
    assert preparing.wait(60) and adapter.picture(base.cameras[0]) is None
    adapter.close()
    assert not adapter.progress.running and adapter.progress.adapted is None and not adapter._thread.is_alive()


def test_a_zoom_is_rounded_to_the_scale_of_a_file(base):
    assert [wish(base, zoom=zoom).scale for zoom in (0.98, 1.02, 0.26789, 3.14159)] == [1.0, 1.0, 0.268, 3.14]


def digest(base):
    return [hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest() for tensor in base.model.parameters().values()]
