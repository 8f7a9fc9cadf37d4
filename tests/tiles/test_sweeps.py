"""What a run in tiles begins with, and its sweeps: no start is worse than the base, and what does harm is undone."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import tiny
import torch
from cut_scenes import config, cut_in_three

from mipmap_plugin.adaptation.optimization.validation import HARM_DB, TIE_DB, Quality
from mipmap_plugin.adaptation.start.blend_weights import PARTS
from mipmap_plugin.adaptation.start.strength import Merger
from mipmap_plugin.adaptation.views.pixel_size import LEAST_VIEWS
from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.tiles import steering
from mipmap_plugin.tiles.folder import start_file
from mipmap_plugin.tiles.run import adapt_in_tiles
from mipmap_plugin.tiles.start import StartSearch, errors_of
from mipmap_plugin.tiles.steering import Steered, sweep_of
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep, sweeps, views_of


def equal(psnr):
    """The quality of a state whose differences are all visible."""
    return Quality(psnr, psnr)


def chosen(scene, monkeypatch, psnrs):
    """The name of the start that is chosen where these PSNRs are measured, one after the other, and no more."""
    measured = iter(psnrs)
    monkeypatch.setattr("mipmap_plugin.tiles.start.quality", lambda *_: equal(next(measured)))
    StartSearch(scene).run()
    assert not list(measured)
    return torch.load(scene.folder / "start.pt")["name"]


@pytest.mark.parametrize(
    ("psnrs", "name"),
    [
        ((30.0, 20.0, 25.0, 32.0), "the closed form of merged splats"),  # the base, the closed form, what is merged least, and most
        ((30.0, 31.0, 30.5, 25.0, 26.0), "the closed form of merged splats"),
        ((30.0, 31.0, 25.0), "the closed form"),  # of which most would lose more
        ((30.0, 20.0, 25.0, 26.0, 27.0), "the base as it is"),
    ],
)
def test_no_start_is_worse_than_the_base_and_none_is_tried_in_vain(job, monkeypatch, psnrs, name):
    scene = cut_in_three(job, merge_to=0.5, merging_costs=20.0)
    assert chosen(scene, monkeypatch, psnrs) == name
    assert sorted(file.name for file in scene.folder.glob("*.splats")) == ["base.splats", "start_0.splats", "start_1.splats", "start_2.splats"]


@pytest.mark.parametrize(("eps2d", "name"), [(0.1, "the closed form of merged splats"), (DILATION, "the closed form")])
def test_the_mildest_merging_may_cost_more_before_steps_for_another_renderer(job, monkeypatch, eps2d, name):
    scene = cut_in_three(job, merge_to=0.5)
    scene.target = replace(scene.target, eps2d=eps2d)
    monkeypatch.setattr("mipmap_plugin.tiles.start.draws_alike", lambda *_: False)
    psnrs = 20.0, 30.0, 29.5, *((29.5, 29.5) if eps2d < DILATION else ())  # the base, the closed form, what is merged least, and more
    assert chosen(scene, monkeypatch, psnrs) == name


@pytest.mark.parametrize(
    ("psnrs", "settings", "name"),
    [
        ((30.0, 31.0), {"steps": 0}, "the closed form"),  # the base and the closed form
        ((30.0, 31.0), {"steps": 4}, "the closed form"),
        ((30.0, 29.0), {"steps": 4}, "the base as it is"),
        ((30.0, 29.0, 30.0, 30.0), {"steps": 4, "merge_to": 0.5}, "merged splats"),
    ],
)
def test_a_base_that_compensates_has_a_closed_form_where_that_is_better(job, monkeypatch, psnrs, settings, name):
    """As without tiles."""
    folder = tiny.folder(job.base.checkpoint.with_name("compensated"), tiny.cameras(3, width=20, height=16), trained=TrainedScale("antialiased", 0.3))
    scene = cut_in_three(replace(job, base=Base(folder)), **settings)
    assert chosen(scene, monkeypatch, psnrs) == name


def test_what_is_in_the_picture_but_not_seen_is_weighed_in_more_views(job):
    """As without tiles, where twice as much of lego was merged: half of it is hidden in each view."""
    splats = tiny.gaussians(80)
    splats.opacities[::2] = 0.005
    folder = job.base.checkpoint.with_name("pale")
    VanillaModel.from_gaussians(splats, TrainedScale()).save(folder, provenance={})
    write_cameras(folder / "cameras.json", tiny.cameras(30, width=20, height=16))
    search = StartSearch(cut_in_three(replace(job, base=Base(folder))))
    search.run()
    assert len(search.views) == 2 * LEAST_VIEWS
    parts = [place % PARTS for place in range(len(search.views))]
    whole, _ = search.scene.painter(search.scene.base_effects).weighed(search.scene.base, search.views, parts)
    torch.testing.assert_close(search._measured(), whole * search.scene.scale**2)


def test_splats_that_no_view_shows_are_told_of(job):
    """As without tiles: half of them lie far behind all cameras."""
    shown = tiny.gaussians(80)
    folder = job.base.checkpoint.with_name("hidden")
    VanillaModel.from_gaussians(shown.joined(replace(shown, means=shown.means + 1000.0)), TrainedScale()).save(folder, provenance={})
    write_cameras(folder / "cameras.json", tiny.cameras(3, width=20, height=16))
    with pytest.warns(UserWarning, match="no view shows 5[0-9]% of the splats"):
        report = adapt_in_tiles(replace(job, base=Base(folder)), 2).report
    assert any("no view shows" in note for note in report.notes)


def test_without_a_closed_form_merged_splats_keep_their_opacities(job, monkeypatch):
    """As without tiles, where they are matched in the closed form."""
    scene = cut_in_three(job, merge_to=0.5, closed_form=False)
    monkeypatch.setattr(StartSearch, "_match", None)
    monkeypatch.setattr("mipmap_plugin.tiles.start.quality", lambda scene, splats, *_: equal(-float(len(splats))))
    StartSearch(scene).run()
    assert torch.load(scene.folder / "start.pt")["name"] == "merged splats"


@pytest.mark.parametrize(("steps", "psnrs"), [(0, (20.0, 30.0, 31.0, 30.5, 30.6)), (4, (20.0, 30.0, 31.0, 30.5))])
def test_without_steps_a_stronger_merging_is_hardly_worse_than_a_milder_one(job, monkeypatch, steps, psnrs):
    """As without tiles: what it costs beside the mildest, the third that is measured, no step regains."""
    scene = cut_in_three(job, merge_to=0.5, steps=steps)
    monkeypatch.setattr(Merger, "_further", lambda merger, found, bounds: found)
    assert chosen(scene, monkeypatch, psnrs) == "the closed form of merged splats"


@pytest.mark.parametrize(("steps", "splats"), [(0, 3 * 2), (4, 66)])
def test_where_merging_gains_and_no_step_follows_cores_are_merged_beyond_the_limits(job, monkeypatch, steps, splats):
    """As without tiles: within the limits 66 splats are left, where 2 of each core's 27 are wanted."""
    scene = cut_in_three(job, merge_to=0.05, steps=steps)
    monkeypatch.setattr("mipmap_plugin.tiles.start.quality", lambda scene, splats, *_: equal(-float(len(splats))))
    StartSearch(scene).run()
    assert sum(len(Store(start_file(scene.folder, number))) for number in range(3)) == splats
    assert not [*scene.folder.glob("merged_*")]


def test_a_truth_brighter_than_white_is_judged_as_it_is_displayed():
    """As without tiles: a bicubic filter makes it so beside edges."""
    filled = lambda level: torch.full((2, 2, 3), level)  # noqa: E731
    painter = SimpleNamespace(image=lambda splats, view: filled(1.0))
    scene, [view] = SimpleNamespace(painter=lambda target: painter, target=None, scale=0.5), tiny.cameras(1)
    assert errors_of(scene, None, {view.name: filled(1.1)}, [view]) == errors_of(scene, None, {view.name: filled(1.0)}, [view])


def test_a_run_is_cut_into_a_warm_up_and_sweeps():
    found = sweeps(config(steps=600))
    assert [(sweep.first, sweep.end) for sweep in found] == [(0, 60), (60, 330), (330, 600)]
    assert found[0].checks == (10, 20, 30, 40, 50, 60) and found[1].checks == (195, 330)
    assert [sweep.checks for sweep in sweeps(config(steps=4))] == [(1,), (2, 4)]
    assert sweeps(config(steps=0)) == []
    assert [sweep.end for sweep in sweeps(config(steps=30, warm_up=0.0))] == [15, 30]


def test_only_views_that_steps_use_are_drawn():
    views = tiny.cameras(40)
    settings = config(steps=12)
    first, both = views_of(views, settings, 0, 6), views_of(views, settings, 0, 12)
    schedule = ViewSchedule(views, settings)
    assert set(first) == {view for step in range(6) for view in schedule(step, step / 12)}
    assert len(first) < len(both) < 40
    assert views_of(views, config(steps=12, time_budget_s=1.0), 0, 6) == views


@pytest.fixture
def measured(halved, monkeypatch):
    """Give the scene a start of 30 dB, and the PSNRs that its states are then measured to have."""

    def give(*psnrs):
        each = iter(psnrs)
        torch.save({"name": "the start", "quality": [30.0, 30.0]}, halved.folder / "start.pt")
        monkeypatch.setattr(steering, "quality", lambda *_: equal(next(each)))
        monkeypatch.setattr(steering, "open_state", lambda *_: None)

    return give


def test_a_loss_that_nobody_sees_is_no_harm(halved, measured, monkeypatch):
    """As without tiles: a plain sky that falls from 54 dB to 45 takes no steps back that sharpen what is in front of it."""
    measured()
    monkeypatch.setattr(steering, "quality", lambda *_: Quality(visible=30.1, psnr=28.0))
    steering.steer(halved, Sweep(0, 0, (1,), 0, 0))
    after = Steered.before(halved.folder, 1)
    assert (after.step, after.quality.psnr) == (1, 28.0)


@pytest.mark.parametrize(
    ("psnrs", "kept", "ceiling"),
    [((31.0, 32.0), 2, 1.0), ((31.0, 30.95), 2, 1.0), ((31.0, 30.0), 1, 0.5), ((29.0,), 0, 0.5),
     ((31.0, 31.0 - TIE_DB / 2, 31.0 - HARM_DB - TIE_DB / 4), 2, 0.5)],  # of the best, though a tie is gone on with
)  # fmt: skip
def test_what_does_harm_to_the_whole_is_undone(halved, measured, monkeypatch, psnrs, kept, ceiling):
    measured(*psnrs)
    monkeypatch.setattr(steering, "warmed_up", lambda *_: 1.0)
    steering.steer(halved, Sweep(0, 0, tuple(range(1, max(2, len(psnrs)) + 1)), 0, 0))
    after = Steered.before(halved.folder, 1)
    assert (max(after.step, 0), after.ceiling, tuple(after.checked)) == (kept, ceiling, psnrs)


def test_a_little_loss_in_the_warm_up_is_no_harm_and_it_is_not_repeated(halved, measured, monkeypatch):
    measured(32.0, 31.0, 29.0, 29.0)
    monkeypatch.setattr(halved, "config", halved.config.model_copy(update={"warm_up": 0.75}))
    steering.steer(halved, Sweep(0, 0, (1, 2, 3), 0, 0))
    after = Steered.before(halved.folder, 1)
    assert (after.step, after.ceiling < 1) == (1, True)
    assert after.following is None or not after.following.repeats
    steering.steer(halved, Sweep(1, 3, (4,), 1, 1))
    again = Steered.before(halved.folder, 2).following
    assert (again.first, again.checks, again.repeats) == (3, (4,), 1)  # none of the warm-up's steps


def test_what_did_harm_is_done_again_in_front_of_the_same_halos_but_not_for_ever(halved, measured, monkeypatch):
    measured(31.0, 29.0, 29.0, 29.0, 32.0, 29.0, 33.0)
    monkeypatch.setattr(steering, "warmed_up", lambda *_: 1.0)
    monkeypatch.setitem(halved.__dict__, "sweeps", [Sweep(0, 0, (1, 2, 3), 0, 0), Sweep(1, 3, (4,), 1, 1)])
    made, sweep = [], sweep_of(halved, 0)
    while sweep is not None:
        steering.steer(halved, sweep)
        after = Steered.before(halved.folder, sweep.number + 1)
        made.append((sweep.first, sweep.checks, sweep.halos, sweep.repeats, after.step, after.ceiling))
        sweep = sweep_of(halved, sweep.number + 1)
    assert made == [
        (0, (1, 2, 3), 0, 0, 1, 0.5),
        (1, (2, 3), 0, 1, 1, 0.25),
        (1, (2, 3), 0, 2, 1, 0.125),
        (1, (2, 3), 0, 3, 2, 0.0625),
        (3, (4,), 4, 0, 4, 0.0625),
    ]


def test_what_a_sweep_is_measured_by_is_what_it_began_with(halved, measured):
    """A warm-up may lose a little, and what comes after it need not be better than the best of it."""
    measured(32.0, 31.0, 31.5, 31.45)
    halved.config = halved.config.model_copy(update={"warm_up": 0.5})
    steering.steer(halved, Sweep(0, 0, (1, 2), 0, 0))
    assert Steered.before(halved.folder, 1).quality.psnr == 31.0
    steering.steer(halved, Sweep(1, 2, (3, 4), 1, 1))
    after = Steered.before(halved.folder, 2)
    assert (after.sweep, after.step, after.ceiling, after.quality.psnr) == (1, 4, 1.0, 31.45)


def test_a_run_ends_with_the_sweep_that_reaches_the_target(job):
    joined = adapt_in_tiles(replace(job, settings=job.settings | {"target_db": 5.0}), 2)
    assert {tile["sweep"] for tile in joined.tiles} == {0}
