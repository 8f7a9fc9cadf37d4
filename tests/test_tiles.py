"""One scene in tiles: every splat in one core, exact pictures from the disk, a halo that stays as it is, whole results, resumed runs."""

from __future__ import annotations

import importlib.util
import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import anchor_checkpoints
import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization import loop
from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.loop import adapt as real_adapt
from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.views import ViewSchedule
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import CheckpointError, JobsFailed, OutputError, OutputExists, SceneError, SettingsError
from mipmap_plugin.formats.magic import SPLAT_RECORD
from mipmap_plugin.formats.ply import read_header, read_ply, write_ply
from mipmap_plugin.formats.ply_rows import PlyRows, concatenate
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.engines import in_this_process
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.health import ACTIVATED
from mipmap_plugin.models.mip import MipModel
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.tiles import plan, run, slabs, steering, tile, truth
from mipmap_plugin.tiles.cut import cut, front_to_back
from mipmap_plugin.tiles.folder import truth_file, work_folder
from mipmap_plugin.tiles.halo import draw_halos
from mipmap_plugin.tiles.layers import draw_layers
from mipmap_plugin.tiles.pictures import Album, write_pictures
from mipmap_plugin.tiles.reading import find_splats, make_cut
from mipmap_plugin.tiles.report import make_report
from mipmap_plugin.tiles.run import adapt_all_in_tiles, adapt_in_tiles
from mipmap_plugin.tiles.scene import opened
from mipmap_plugin.tiles.slabs import Painter
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.start import StartSearch
from mipmap_plugin.tiles.steering import Steered, open_state, sweep_of
from mipmap_plugin.tiles.store import Store, write_store
from mipmap_plugin.tiles.surroundings import Surroundings, nothing
from mipmap_plugin.tiles.sweeps import Sweep, sweeps, views_of
from mipmap_plugin.tiles.tile import Tile
from mipmap_plugin.tiles.truth import Truths, draw_truths, parts

needs_numba = pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="numba is not installed")

EFFECTS = Effects(1, background=(0.2, 0.4, 0.6))


def stored(path, model):
    write_store(path, model.parameters())
    return Store(path)


@pytest.fixture
def on_disk(tmp_path):
    """300 splats in two files, and the same splats in memory."""
    models = [tiny.model(150, seed=seed) for seed in (0, 1)]
    parts = [stored(tmp_path / f"part_{number}.splats", model) for number, model in enumerate(models)]
    parameters = {name: torch.cat([model.parameters()[name].detach() for model in models]) for name in models[0].parameters()}
    return Splats.of(VanillaModel, parts), VanillaModel(parameters).gaussians().detach()


@pytest.fixture
def job(tmp_path):
    """A scene that is adapted in tiles in a moment."""
    folder = tiny.folder(tmp_path / "scene", tiny.cameras(3, width=20, height=16), count=80)
    settings = {"steps": 4, "seed": 0, "views": "given", "validation_views": 2, "views_per_step": 1, "merge_to": 1.0}
    return Job(Base(folder), tmp_path / "out.ply", 0.5, settings=settings)


# Cuts


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_every_splat_lies_in_exactly_one_core_of_equal_size(count):
    means = torch.randn(1003, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([3.0, 1.0, 2.0])
    rows = torch.arange(1003)[torch.arange(1003) % 7 != 0]
    cores, _ = cut(means, rows, count)
    assert torch.equal(torch.cat(cores).sort().values, rows)
    assert max(map(len, cores)) - min(map(len, cores)) <= 1
    assert all(torch.equal(core, core.sort().values) for core in cores)


def test_a_cut_is_a_plane_across_the_longest_axis():
    means = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 9.0, 1.0])
    (low, high), _ = cut(means, torch.arange(500), 2)
    assert means[low, 1].max() <= means[high, 1].min()


def test_far_strays_do_not_decide_the_axis():
    means = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 9.0, 1.0])
    means[:5, 0] += 1e4
    (low, high), _ = cut(means, torch.arange(500), 2)
    assert means[low, 1].max() <= means[high, 1].min()


@pytest.mark.parametrize("count", [2, 5, 8])
def test_a_core_is_before_all_that_it_may_hide(count):
    """Every line of sight meets the cores in their order."""
    generator = torch.Generator().manual_seed(0)
    _, tree = cut(torch.randn(800, 3, generator=generator), torch.arange(800), count)
    center = torch.tensor([0.3, -0.2, 0.1])
    order = front_to_back(tree, center.tolist())
    assert sorted(order) == list(range(count))

    def core_at(point, node=tree):
        return node if isinstance(node, int) else core_at(point, node[2] if point[node[0]] <= node[1] else node[3])

    for sight in torch.randn(50, 3, generator=generator):
        met = [order.index(core_at(center + distance * sight)) for distance in torch.linspace(0, 3, 40)]
        assert met == sorted(met)


# Splats on the disk


def test_rows_are_read_in_any_order(on_disk):
    splats, in_memory = on_disk
    rows = torch.tensor([299, 3, 150, 149, 3])
    assert torch.equal(splats.gaussians(rows).sh, in_memory[rows].sh)
    assert torch.equal(splats.places[:, :3], in_memory.means)
    assert len(splats.gaussians(rows[:0])) == 0


def test_splats_come_back_from_a_file_as_they_were(tmp_path):
    model = tiny.model(50, degree=2)
    for name, read in stored(tmp_path / "a.splats", model).parameters().items():
        assert torch.equal(read, model.parameters()[name])


def test_reading_in_pieces_makes_no_difference(on_disk, monkeypatch):
    splats, in_memory = on_disk
    monkeypatch.setattr("mipmap_plugin.tiles.splats.CHUNK", 7)
    rows = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    assert torch.equal(splats.gaussians(rows).means, in_memory[rows].means) and torch.equal(splats.gaussians(rows).sh, in_memory[rows].sh)
    assert torch.equal(splats.gaussians(rows, colored=False).opacities, in_memory[rows].opacities)
    camera = tiny.cameras(1)[0]
    rows, depths = Splats.of(VanillaModel, splats.parts).seen_by(camera, 0.01)
    monkeypatch.undo()
    whole, whole_depths = splats.seen_by(camera, 0.01)
    assert torch.equal(rows, whole)
    torch.testing.assert_close(depths, whole_depths)  # on some processors torch multiplies few rows in another order


def test_slabs_are_cut_by_depth():
    depths = torch.tensor([5.0, 1.0, 4.0, 2.0, 3.0])
    assert [part.tolist() for part in slabs.slabs(torch.arange(5), depths, 2)] == [[1], [3, 4], [0, 2]]
    assert slabs.slabs(torch.arange(0), depths[:0], 2) == []


def test_pictures_come_back_one_by_one(tmp_path):
    small = torch.full((1, 1, 5), 7).to(torch.uint8)
    pictures = {"1": torch.rand(3, 4, 3).half(), "2": torch.randint(-9, 9, (2, 5, 3), dtype=torch.int16), "2/0": small}
    write_pictures(tmp_path / "a", ((name, picture, (1, 2, 3, 4) if "/" in name else None) for name, picture in pictures.items()))
    album = Album([tmp_path / "a"])
    assert all(torch.equal(album[name], picture) for name, picture in pictures.items())
    assert album.box("2/0") == (1, 2, 3, 4) and album.box("1") is None and "3" not in album


def test_slabs_give_the_picture_of_all_splats(on_disk, monkeypatch):
    splats, in_memory = on_disk
    camera, backend = tiny.cameras(1)[0], ReferenceBackend()
    whole = backend.render(in_memory, camera, EFFECTS)
    monkeypatch.setattr(slabs, "SLAB", 37)
    assert torch.allclose(Painter(backend, EFFECTS).image(splats, camera), whole.image, atol=2e-4)
    assert torch.allclose(1 - Painter(backend, EFFECTS).draw(splats, camera).transmittance[..., 0], whole.alpha, atol=2e-4)


def test_slabs_give_the_blend_weights_of_all_splats(on_disk, monkeypatch):
    splats, in_memory = on_disk
    views, backend = tiny.cameras(3), ReferenceBackend()
    monkeypatch.setattr(slabs, "COLORLESS_SLAB", 37)
    expected = blend_weights(in_memory, views, backend, EFFECTS)
    assert torch.allclose(Painter(backend, EFFECTS).blend_weights(splats, views), expected, atol=1e-3, rtol=1e-3)


def test_strips_give_the_blend_weights_of_their_view(on_disk, monkeypatch):
    splats, _ = on_disk
    view, painter = tiny.cameras(1), Painter(ReferenceBackend(), EFFECTS)
    whole = painter.blend_weights(splats, view)
    monkeypatch.setattr(slabs, "MOST_PIXELS", 300)
    assert [strip.height for strip in slabs.strips(view[0])] == [8, 8, 8]
    assert torch.allclose(painter.blend_weights(splats, view), whole, atol=0.02, rtol=0.01)  # the frame limits how oblique a splat may be drawn


def test_a_plain_text_file_is_refused(tmp_path):
    path = tmp_path / "text.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with pytest.raises(CheckpointError, match="only a binary PLY is read part by part"):
        PlyRows(path)


# The concatenation


def test_a_concatenation_has_the_bytes_of_its_parts_in_their_order(tmp_path):
    parts = [tiny.model(150, seed=seed).save(tmp_path / f"part_{seed}.ply", provenance={}) for seed in (0, 1)]
    with (tmp_path / "whole.ply").open("wb") as out:
        assert concatenate(parts, ["of two parts"], out) == 300
    bodies = b"".join(part.read_bytes()[read_header(part).body :] for part in parts)
    header = read_header(tmp_path / "whole.ply")
    assert (tmp_path / "whole.ply").read_bytes()[header.body :] == bodies
    assert header.vertex.count == 300 and header.comments == ("of two parts",) and not header.notes


def test_parts_of_other_columns_are_refused(tmp_path):
    first = tiny.model(degree=1).save(tmp_path / "first.ply", provenance={})
    other = tiny.model(degree=2).save(tmp_path / "other.ply", provenance={})
    with (tmp_path / "whole.ply").open("wb") as out, pytest.raises(CheckpointError, match="has other columns than"):
        concatenate([first, other], [], out)


# The halo


def cut_in_three(job, **settings):
    """A scene in three tiles with its truths."""
    job = replace(job, settings=job.settings | settings)
    folder = work_folder(job.target)
    folder.mkdir()
    make_cut(job.base.checkpoint, 3, folder)
    scene = opened(job.base, job.scale, None, job.config(), folder)
    for part in range(parts(scene.used_views)):
        draw_truths(scene, part)
    return scene


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
    measured = iter(psnrs)
    monkeypatch.setattr("mipmap_plugin.tiles.start.psnr", lambda *_: next(measured))
    StartSearch(scene).run()
    assert torch.load(scene.folder / "start.pt")["name"] == name and not list(measured)
    assert sorted(file.name for file in scene.folder.glob("*.splats")) == ["base.splats", "start_0.splats", "start_1.splats", "start_2.splats"]


@pytest.mark.parametrize(("eps2d", "name"), [(0.1, "the closed form of merged splats"), (DILATION, "the closed form")])
def test_the_mildest_merging_may_cost_more_before_steps_for_another_renderer(job, monkeypatch, eps2d, name):
    scene = cut_in_three(job, merge_to=0.5)
    scene.target = replace(scene.target, eps2d=eps2d)
    measured = iter((20.0, 30.0, 29.5, *((29.5, 29.5) if eps2d < DILATION else ())))  # the base, the closed form, what is merged least, and more
    monkeypatch.setattr("mipmap_plugin.tiles.start.psnr", lambda *_: next(measured))
    monkeypatch.setattr("mipmap_plugin.tiles.start.draws_alike", lambda *_: False)
    StartSearch(scene).run()
    assert torch.load(scene.folder / "start.pt")["name"] == name and not list(measured)


def test_without_a_closed_form_merged_splats_keep_their_opacities(job, monkeypatch):
    """As without tiles, where they are matched in the closed form."""
    scene = cut_in_three(job, merge_to=0.5, closed_form=False)
    monkeypatch.setattr(StartSearch, "_match", None)
    monkeypatch.setattr("mipmap_plugin.tiles.start.psnr", lambda scene, splats, *_: -float(len(splats)))
    StartSearch(scene).run()
    assert torch.load(scene.folder / "start.pt")["name"] == "merged splats"


@pytest.fixture
def halved(job):
    """A scene in three tiles that begins with the base, and has the layers and halos of its first sweep."""
    scene = cut_in_three(job, closed_form=False)
    StartSearch(scene).run()
    for number in range(3):
        draw_layers(scene, number, scene.sweeps[0])
    draw_halos(scene, 0, scene.sweeps[0])
    return scene


def test_columns_that_tiles_do_not_hold_are_told_of(job):
    [file] = job.base.checkpoint.rglob("*.ply")
    columns = read_ply(file).columns
    columns["nz"][-1] = 1  # normals, which 3DGS does not have
    write_ply(file, columns | {"label": columns["x"]}, overwrite=True)
    scene = cut_in_three(job)
    with pytest.warns(UserWarning, match="the extra columns nx, ny, nz, label are dropped, since tiles hold none"):
        assert make_report(scene, [file], {"total": 1.0}, {}, "the start").notes


def test_places_that_float32_does_not_hold_are_told_of(job):
    [file] = job.base.checkpoint.rglob("*.ply")
    columns = read_ply(file).columns
    write_ply(file, columns | {"x": columns["x"].astype(float) + 5e6}, overwrite=True)
    folder = work_folder(job.target)
    folder.mkdir()
    with pytest.warns(UserWarning, match=r"80 of 80 splats lie so far .* steps of 0.5 units"):
        make_cut(job.base.checkpoint, 2, folder)


def test_splats_that_are_doubtful_or_left_out_are_told_of(job):
    [file] = job.base.checkpoint.rglob("*.ply")
    columns = {name: np.tile(column, 2) for name, column in read_ply(file).columns.items()}
    columns["opacity"], columns["x"][0] = np.linspace(0, 1, 160, dtype=np.float32), np.nan
    write_ply(file, columns, overwrite=True)
    with pytest.warns(UserWarning, match=r"the opacities look like 0..1"), pytest.warns(UserWarning, match="1 of 160 splats was dropped"):
        scene = cut_in_three(job)
    doubts = [ACTIVATED, "1 of 160 splats was dropped: not finite once activated"]
    assert make_report(scene, [file], {"total": 1.0}, {}, "the start").notes == doubts


def whole_and_tiles(halved):
    """All splats, and of each tile its rows, its surroundings and its crop of a view that shows all."""
    splats = open_state(halved, Steered.before(halved.folder, 0))
    view = halved.sweep_views(halved.sweeps[0])[0]
    around = [Surroundings(halved, number, halved.sweeps[0]) for number in range(3)]
    rows = [torch.arange(first, end) for first, end in zip(splats.starts, splats.starts[1:], strict=False)]
    return splats.gaussians(torch.arange(len(splats))), view, rows, around


def shown_in(scene, splats, view, crop):
    """What a crop shows of the picture of all splats."""
    target = view.zoomed(scene.scale)
    image = scene.backend.render(splats, target, scene.target).image
    left, top = round(target.cx - crop.cx), round(target.cy - crop.cy)
    return image[top : top + crop.height, left : left + crop.width]


def test_a_core_in_its_halo_looks_as_in_the_whole_scene(halved):
    splats, view, rows, around = whole_and_tiles(halved)
    for own, halo in zip(rows, around, strict=True):
        crop = halo.crop(view)
        assert torch.allclose(halo.render(splats[own], crop), shown_in(halved, splats, view, crop), atol=3e-3)  # layers have 16 bits


def test_a_change_of_the_core_shows_as_far_as_the_halo_lets_it_through(halved):
    """Close to what the whole shows: only where splats overlap across a cut do layers differ from it."""
    splats, view, rows, around = whole_and_tiles(halved)
    for own, halo in zip(rows, around, strict=True):
        crop = halo.crop(view)
        brighter = splats.sh.clone()
        brighter[own, 0] += 0.5
        change = shown_in(halved, replace(splats, sh=brighter), view, crop) - shown_in(halved, splats, view, crop)
        seen = halo.render(replace(splats, sh=brighter)[own], crop) - halo.render(splats[own], crop)
        assert (seen - change).abs().mean() < 0.2 * change.abs().mean()


def test_all_tiles_together_are_asked_to_mend_the_whole_error(halved):
    splats, view, _, around = whole_and_tiles(halved)
    size = view.zoomed(halved.scale).size
    image = shown_in(halved, splats, view, view.zoomed(halved.scale))
    error = Truths(halved)(view) - image
    asked = torch.zeros(*size, 3)
    for halo in around:
        crop = halo.crop(view)
        left, top, right, bottom = halo._box(view.name)
        asked[top:bottom, left:right] += halo.wanted(crop) - image[top:bottom, left:right]
    assert error.abs().max() > 0.1
    middle = (slice(2, 6), slice(3, 7))
    assert torch.allclose(asked[middle], error[middle], atol=0.02)  # fractions have 8 bits


def test_a_view_without_the_core_shows_nothing(halved):
    splats, view, rows, around = whole_and_tiles(halved)
    away = nothing(view)
    core = splats[rows[0]].detach()
    core.means.requires_grad_()
    [image] = around[0].render_views(core, [away])
    (image - around[0].wanted(away)).square().mean().backward()
    assert image.shape == (1, 1, 3) and not image.any() and not core.means.grad.any()


def test_views_without_the_core_have_the_pixels_of_the_new_scale(halved, monkeypatch):
    """Means move by pixels, which are those of the closest view if none shows a splat."""
    monkeypatch.setattr(Surroundings, "crop", lambda self, view: None)
    tile = Tile(halved, 0, halved.sweeps[0])
    assert {view.fx for view in tile._task().views} == {view.zoomed(halved.scale).fx for view in halved.views.adapted}


@needs_numba
def test_tiles_step_by_rows_where_the_backend_can(job, monkeypatch):
    """And the result is that of autograd, but for rounding, of which Adam's first steps make more."""
    job, steps = replace(job, base=replace(job.base, backend="cpu")), []
    real_step = ByRows.step
    monkeypatch.setattr(ByRows, "step", lambda self, optimizer: (steps.append(self), real_step(self, optimizer)))
    by_rows = read_ply(adapt_in_tiles(job, 3).file).columns
    assert len(steps) == 3 * 4  # 4 steps of 3 tiles, whatever a view shows of them
    monkeypatch.setattr(Surroundings, "to_step", None)
    by_autograd = read_ply(adapt_in_tiles(replace(job, target=job.target.with_name("other.ply")), 3).file).columns
    assert len(steps) == 3 * 4 and not np.array_equal(by_rows["x"], by_autograd["x"])
    for name, column in by_autograd.items():
        np.testing.assert_allclose(by_rows[name], column, atol=2e-3, err_msg=name)


@needs_numba
def test_a_step_whose_views_show_nothing_moves_nothing(halved):
    _, view, _, around = whole_and_tiles(halved)
    around[0]._scene.backend = CpuBackend()
    raw = {name: tensor.contiguous() for name, tensor in splats_of(halved, 0).items()}
    before = {name: tensor.clone() for name, tensor in raw.items()}
    stepper = around[0].to_step.stepper(raw)
    seen = []
    shot = nothing(view), around[0]._effects
    around[0].to_step.differentiate_one(stepper, 0, shot, lambda _, images: [(seen.extend(images) or images[0], images[0].square().mean())])
    zeros = {name: torch.zeros_like(tensor) for name, tensor in raw.items()}
    rates = dict.fromkeys(["means", "quats", "scales", "opacities", "sh0", "shN"], 0.1)
    stepper.step(AdamStep(raw, zeros, {name: zero.clone() for name, zero in zeros.items()}, rates, (0.9, 0.99), 1.0, 1e-8))
    assert seen[0].shape == (1, 1, 3) and not seen[0].any() and all(torch.equal(raw[name], before[name]) for name in raw)


def splats_of(halved, number):
    """The raw parameters of a tile as they begin, with sh in one."""
    folder = halved.folder
    raw = Store(Steered.before(folder, 0).file(folder, number)).parameters()
    return {"sh": torch.cat([raw.pop("sh0"), raw.pop("shN")], dim=1), **raw}


# Sweeps


def config(**settings):
    return recipe("default", 0.25, **settings)


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


@pytest.mark.parametrize(
    ("psnrs", "kept", "ceiling"),
    [((31.0, 32.0), 2, 1.0), ((31.0, 30.95), 2, 1.0), ((31.0, 30.0), 1, 0.5), ((29.0,), 0, 0.5)],
)
def test_what_does_harm_to_the_whole_is_undone(halved, monkeypatch, psnrs, kept, ceiling):
    torch.save({"name": "the start", "psnr": 30.0}, halved.folder / "start.pt")
    measured = iter(psnrs)
    monkeypatch.setattr(steering, "psnr", lambda *_: next(measured))
    monkeypatch.setattr(steering, "open_state", lambda *_: None)
    monkeypatch.setattr(steering, "rate_factor", lambda *_: 1.0)
    steering.steer(halved, Sweep(0, 0, (1, 2), 0, 0))
    after = Steered.before(halved.folder, 1)
    assert (max(after.step, 0), after.ceiling, tuple(after.psnrs)) == (kept, ceiling, psnrs)


def test_a_little_loss_in_the_warm_up_is_no_harm_and_it_is_not_repeated(halved, monkeypatch):
    torch.save({"name": "the start", "psnr": 30.0}, halved.folder / "start.pt")
    measured = iter([32.0, 31.0, 29.0])
    monkeypatch.setattr(steering, "psnr", lambda *_: next(measured))
    monkeypatch.setattr(steering, "open_state", lambda *_: None)
    monkeypatch.setattr(halved, "config", halved.config.model_copy(update={"warm_up": 1.0}))
    steering.steer(halved, Sweep(0, 0, (1, 2, 3), 0, 0))
    after = Steered.before(halved.folder, 1)
    assert (after.step, after.ceiling < 1) == (1, True)
    assert after.following is None or not after.following.repeats


def test_what_did_harm_is_done_again_in_front_of_the_same_halos_but_not_for_ever(halved, monkeypatch):
    torch.save({"name": "the start", "psnr": 30.0}, halved.folder / "start.pt")
    measured = iter([31.0, 29.0, 29.0, 29.0, 32.0, 29.0, 33.0])
    monkeypatch.setattr(steering, "psnr", lambda *_: next(measured))
    monkeypatch.setattr(steering, "open_state", lambda *_: None)
    monkeypatch.setattr(steering, "rate_factor", lambda scene, step, ceiling: ceiling)
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


# The whole


def test_a_scene_in_tiles_is_whole_and_better_than_its_base(job, monkeypatch):
    bodies = []
    keep = SimpleNamespace(rmtree=lambda folder: bodies.extend((folder / f"part_{n}.ply").read_bytes() for n in range(3)))
    monkeypatch.setattr(run, "shutil", keep)
    joined = adapt_in_tiles(replace(job, settings=job.settings | {"merge_to": 0.6}), 3)
    report = joined.report
    assert len(load_vanilla(joined.file)) == report.gaussians_after == sum(tile["splats_after"] for tile in joined.tiles[-3:])
    assert report.gaussians_after < report.gaussians_before == 80
    assert report.psnr_after() > report.psnr_before() and report.returned == "the joined tiles"
    sidecar = json.loads(joined.file.with_name("out.ply.adaptation.json").read_text())
    assert [(tile["sweep"], tile["tile"]) for tile in sidecar["tiles"]] == [(sweep, number) for sweep in (0, 1) for number in range(3)]
    assert sidecar["validation"] == report.validation
    assert '"tiles": 3' in " ".join(read_header(joined.file).comments)
    # The cores stand in the file one after the other.
    cores = b"".join(body[body.index(b"end_header\n") + 11 :] for body in bodies)
    assert joined.file.read_bytes()[read_header(joined.file).body :] == cores


def test_a_large_scene_takes_fewer_steps_in_tiles_too(job, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", dict(steps=16, most_draws=1.0, check_every=2))
    settings = {name: value for name, value in job.settings.items() if name != "steps"}
    report = adapt_in_tiles(replace(job, settings=settings), 2).report
    assert report.settings.steps == report.curve[-1].step == 4
    assert report.ended_by.startswith("2 tiles of 4 steps (of 16, because the scene is large")


def test_a_file_for_a_filter_that_the_tag_does_not_tell_whole_is_read_back_with_its_dilation(job):
    """The base of tiles too, as one that was converted at x1."""
    base = tiny.folder(job.target.with_name("base"), trained=TrainedScale("mip", 0.1))
    again = replace(job.base, checkpoint=next(base.rglob("point_cloud.ply")), cameras=base / "cameras.json")
    for asked in (replace(job, viewer="mip"), replace(job, base=again, target=job.target.with_name("again.ply"))):
        made = load_model(adapt_in_tiles(replace(asked, settings=job.settings | {"steps": 0}), 2).file)
        assert (made.trained.screen_filter, made.trained.eps2d) == ("mip", 0.1)
        assert isinstance(made, MipModel) == (asked.viewer == "mip")  # whose loader requires filter_3D


def test_a_model_folder_is_written_as_one(job, tmp_path):
    joined = adapt_in_tiles(replace(job, target=tmp_path / "out"), 2)
    assert (tmp_path / "out" / "cameras.json").is_file() and (tmp_path / "out" / "cfg_args").is_file()
    assert joined.file == tmp_path / "out" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    assert len(load_vanilla(tmp_path / "out")) == joined.report.gaussians_after


def test_a_model_folder_is_written_beside_the_checkpoint(job, capsys):
    """Where the scale in its name looks like a suffix."""
    words = ["adapt", str(job.base.checkpoint), "--scale", "1/2", "--steps", "0", "--views", "given", "--tiles", "2"]
    assert main([*words, "--cameras", str(job.base.checkpoint.with_name("{name}") / "cameras.json")]) == 0
    assert (job.base.checkpoint.with_name("scene_x0.5") / "point_cloud").is_dir()


def test_the_result_does_not_depend_on_what_was_done_before(job, monkeypatch):
    """A run that fails in its second tile goes on there, and leaves the same bytes as one that is not disturbed."""
    undisturbed = adapt_in_tiles(replace(job, target=job.target.with_name("other.ply")), 3).file
    begun = []

    def fail_once(run, *rest):
        begun.append(run)
        if len(begun) == 2:
            raise OSError("no space left")
        return real_adapt(run, *rest)

    monkeypatch.setattr(tile, "adapt", fail_once)
    with pytest.raises(JobsFailed, match=r"1 of 3 jobs \(tile\) failed: no space left; the same command does these again"):
        adapt_in_tiles(job, 3)
    outcomes = []

    def engine(jobs):
        for outcome in in_this_process(jobs):
            outcomes.append(outcome)
            yield outcome

    joined = adapt_in_tiles(job, 3, engine)
    tiles = [outcome.status for outcome in outcomes if outcome.job.work == "tile" and outcome.job.sweep == 0]
    assert tiles == ["finished before", "done", "finished before"]
    before = [outcome.status for outcome in outcomes if outcome.job.work not in ("tile", "steering") and outcome.job.sweep == 0]
    assert set(before) == {"finished before"}
    assert read_ply(joined.file).columns["x"].tobytes() == read_ply(undisturbed).columns["x"].tobytes()
    assert read_ply(joined.file).columns["f_rest_0"].tobytes() == read_ply(undisturbed).columns["f_rest_0"].tobytes()


def test_the_bar_of_a_tile_says_which_it_is_and_no_db(job, monkeypatch):
    """Which it has not: it is measured as a part of the whole."""
    told, began = [], loop.Bar.__init__
    monkeypatch.setattr(loop.Bar, "__init__", lambda bar, **options: (told.append(options["desc"]), began(bar, **options))[1])
    monkeypatch.setattr(loop.Bar, "set_postfix_str", lambda bar, text: told.append(text))
    monkeypatch.setattr(run, "announced", lambda what: (told.append(what), nullcontext())[1])
    adapt_in_tiles(replace(job, settings=job.settings | {"closed_form": False, "steps": 2}), 2)
    assert set(told) == {"cutting", "adapting tile 1 x0.5", "adapting tile 2 x0.5", "40 splats", "measuring the whole", "writing out.ply"}


def test_no_tile_grows_beyond_what_the_settings_allow(job):
    settings = dict(steps=8, prune_every=2, densify_gradient=1e-9, most_growth=1.2, views="given", validation_views=2)
    assert 80 < adapt_in_tiles(replace(job, recipe="paper", settings=settings), 2).report.gaussians_after <= 96


def test_an_interrupted_tile_is_resumed(job, monkeypatch):
    def interrupt_early(run, task, config, on_interrupt, observe):
        return real_adapt(run, task, config, on_interrupt, lambda run: on_interrupt(run) if run.step == 2 else observe(run))

    with monkeypatch.context() as patched:
        patched.setattr(tile, "adapt", interrupt_early)
        with pytest.raises(KeyboardInterrupt, match="run the same command again"):
            adapt_in_tiles(job, 2)
    first_steps = []
    monkeypatch.setattr(tile, "adapt", lambda run, *rest: (first_steps.append(run.step), real_adapt(run, *rest))[1])
    assert adapt_in_tiles(job, 2).file.exists() and first_steps == [2, 1]


def test_invalid_splats_are_left_out(tmp_path, job):
    ply = next(job.base.checkpoint.rglob("*.ply"))
    columns = dict(read_ply(ply).columns)
    columns["opacity"] = columns["opacity"].copy()
    columns["opacity"][5] = float("nan")
    write_ply(ply, columns, overwrite=True)
    assert adapt_in_tiles(job, 2).report.gaussians_before == 79


# What cannot be


@pytest.mark.parametrize(
    ("changes", "tiles", "reason"),
    [
        ({}, 1, "give at least 2, got 1"),
        ({"scale": 4.0}, 2, "cut into tiles for a zoom-out"),
        ({"scale": 1.0}, 2, "x1: the base is right as it is"),
        ({"viewer": "portable"}, 2, "stands for several; give one of them"),
        ({"settings": {"most_splats": 10}}, 2, "to no number of splats"),
    ],
)
def test_requests_that_no_tiles_serve(job, changes, tiles, reason):
    with pytest.raises(SettingsError, match=reason):
        adapt_in_tiles(replace(job, **changes), tiles)
    assert not work_folder(job.target).exists()


def test_files_of_the_web_are_converted_before_they_are_cut(tmp_path):
    rows = np.zeros(9, SPLAT_RECORD)
    rows["scale"] = 0.1
    rows.tofile(tmp_path / "my room.splat")
    with pytest.raises(SettingsError, match=r"convert it first \(splat-transform 'my room.splat' 'my room_plain.ply'\), or leave --tiles out"):
        find_splats(tmp_path / "my room.splat")
    tiny.model(9).save(tmp_path / "room.glb", provenance={})
    with pytest.raises(SettingsError, match=r"first \(load_model\('room.glb'\).save\(Path\('room_plain.ply'\), provenance={}\) in Python\)"):
        find_splats(tmp_path / "room.glb")


def test_anchors_cannot_be_cut(tmp_path, job):
    folder = anchor_checkpoints.write(tmp_path / "anchors")
    with pytest.raises(SettingsError, match="a checkpoint of scaffold cannot be cut into tiles"):
        adapt_in_tiles(replace(job, base=replace(job.base, checkpoint=folder)), 2)


def test_more_tiles_than_splats(job):
    with pytest.raises(CheckpointError, match="has 80 splats, which cannot be cut into 90 tiles"):
        adapt_in_tiles(job, 90)
    assert not work_folder(job.target).exists()  # so that fewer may be tried


def test_tiles_of_another_request_are_not_touched(job):
    work_folder(job.target).mkdir()
    (work_folder(job.target) / "plan.json").write_text("{}")
    with pytest.raises(SettingsError, match="holds tiles of another base, settings or number of tiles"):
        adapt_in_tiles(job, 2)


def failing(*_):
    raise OSError("no space left")


def test_tiles_are_not_gone_on_with_for_other_cameras(job, monkeypatch):
    """Whose path is the same."""
    with monkeypatch.context() as patched, pytest.raises(JobsFailed):
        patched.setattr(tile, "adapt", failing)
        adapt_in_tiles(job, 2)
    (job.base.checkpoint / "cameras.json").unlink()
    write_cameras(job.base.checkpoint / "cameras.json", tiny.cameras(3, seed=5, width=20, height=16))
    with pytest.raises(SettingsError, match="holds tiles of another base, settings or number of tiles"):
        adapt_in_tiles(job, 2)


def test_saving_the_base_leaves_the_starts_to_the_next_run(job, monkeypatch):
    """A run that is killed while the base is saved comes to the same result when it goes on."""
    folder = work_folder(job.target)
    with monkeypatch.context() as patched, pytest.raises(OSError, match="no space left"):
        patched.setattr(run, "judged", lambda scene: ({}, AS_IT_IS))
        patched.setattr(run, "_save", failing)
        adapt_in_tiles(job, 2)
    starts = Store(folder / "start_0.splats").parameters()["opacities"]
    assert not torch.equal(starts, load_vanilla(folder / "part_0.ply").parameters()["opacities"])


def test_a_damaged_plan_is_said_in_a_sentence(job):
    work_folder(job.target).mkdir()
    (work_folder(job.target) / "plan.json").write_text("")
    with pytest.raises(SceneError, match=r"plan\.json: is not JSON"):
        adapt_in_tiles(job, 2)


def test_views_that_show_nothing_are_refused_and_leave_no_folder(job):
    """The corrected command is another request, which a folder of this one would refuse."""
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    views = [replace(view, viewmat=around @ view.viewmat) for view in tiny.cameras(3, width=20, height=16)]
    folder = tiny.folder(job.base.checkpoint.with_name("other"), views)
    with pytest.raises(SettingsError, match="none of the 3 views shows a splat: the cameras seem to be of another scene"):
        adapt_in_tiles(replace(job, base=replace(job.base, cameras=folder / "cameras.json")), 2)
    assert not work_folder(job.target).exists()


def test_what_an_earlier_command_did_stays_where_views_are_refused(job, monkeypatch):
    """Of several scales one may be refused that it was not asked for."""
    real = run.cut_for

    def gone_on_with(jobs, tiles):
        real(jobs, tiles)
        truth_file(work_folder(job.target), 0).touch()

    monkeypatch.setattr(run, "cut_for", gone_on_with)
    monkeypatch.setattr(run, "refuse_blind", Mock(side_effect=SettingsError("none of the views")))
    with pytest.raises(SettingsError, match="none of the views"):
        adapt_in_tiles(job, 2)
    assert truth_file(work_folder(job.target), 0).exists()


def test_validation_views_that_show_nothing_do_not_count(job, monkeypatch):
    """As without tiles."""
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    views = tiny.cameras(5, seed=3, width=20, height=16)
    away = [replace(view, viewmat=around @ view.viewmat) for view in views[:2]]
    monkeypatch.setattr("mipmap_plugin.tiles.scene.split_validation", lambda cameras, chosen, *_: (chosen, [*away, *views[2:]]))
    folder = work_folder(job.target)
    folder.mkdir()
    make_cut(job.base.checkpoint, 2, folder)
    found = opened(job.base, job.scale, None, job.config(), folder).views
    judged = torch.stack([view.viewmat for view in (*found.steering, *found.choosing)])
    assert torch.equal(judged, torch.stack([views[number].viewmat for number in (2, 4, 3)]))


def test_what_is_wrong_with_views_is_told(job, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.views.UNLIKE", 0.5)
    with pytest.warns(UserWarning, match="adapt with the cameras of each lens on their own"):
        adapt_in_tiles(replace(job, settings=job.settings | {"steps": 0}), 2)


def test_an_output_is_not_replaced_unasked(job):
    job.target.write_text("here")
    with pytest.raises(OutputExists):
        adapt_in_tiles(job, 2)
    assert job.target.read_text() == "here" and not work_folder(job.target).exists()


def interrupted_at(work, sweep, number):
    """An engine that is interrupted before one job."""

    def engine(jobs):
        for each in jobs:
            if (each.work, each.sweep, each.number) == (work, sweep, number):
                raise KeyboardInterrupt
            yield from in_this_process([each])

    return engine


def columns_of(file):
    return {name: column.tobytes() for name, column in read_ply(file).columns.items()}


@pytest.mark.parametrize(
    ("work", "sweep", "number"), [("tile", 1, 1), ("steering", 1, 0), ("tile", 2, 1), ("steering", 2, 0), ("halo", 3, 0), ("tile", 3, 2)]
)
def test_a_run_that_is_interrupted_anywhere_goes_on_to_the_same_bytes(job, monkeypatch, work, sweep, number):
    """Its second sweep does harm at the last check, and is repeated from the first one in a third."""
    gains, real_steer = {0: [1.0] * 6, 1: [1.5, -9.0], 2: [2.0], 3: [3.0] * 2}, steering.steer

    def steer(scene, made):
        start_db, own = torch.load(scene.folder / "start.pt")["psnr"], iter(gains[made.number])
        with monkeypatch.context() as patched:
            patched.setattr(steering, "psnr", lambda *_: start_db + next(own))
            real_steer(scene, made)

    monkeypatch.setattr(steering, "steer", steer)
    plan = [Sweep(0, 0, (1,), 0, 0), Sweep(1, 1, (2, 4), 1, 1), Sweep(2, 4, (5, 6), 2, 2)]
    monkeypatch.setattr("mipmap_plugin.tiles.scene.sweeps", lambda config: plan)
    job = replace(job, settings=job.settings | {"steps": 6, "warm_up": 0.0})
    undisturbed = adapt_in_tiles(replace(job, target=job.target.with_name("other.ply")), 3)
    assert [tile["sweep"] for tile in undisturbed.tiles] == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3
    with pytest.raises(KeyboardInterrupt):
        adapt_in_tiles(job, 3, interrupted_at(work, sweep, number))
    assert columns_of(adapt_in_tiles(job, 3).file) == columns_of(undisturbed.file)


def test_what_a_sweep_is_measured_by_is_what_it_began_with(halved, monkeypatch):
    """A warm-up may lose a little, and what comes after it need not be better than the best of it."""
    torch.save({"name": "the start", "psnr": 30.0}, halved.folder / "start.pt")
    monkeypatch.setattr(steering, "open_state", lambda *_: None)
    measured = iter([32.0, 31.0, 31.5, 31.45])
    monkeypatch.setattr(steering, "psnr", lambda *_: next(measured))
    halved.config = halved.config.model_copy(update={"warm_up": 0.5})
    steering.steer(halved, Sweep(0, 0, (1, 2), 0, 0))
    assert Steered.before(halved.folder, 1).psnr == 31.0
    steering.steer(halved, Sweep(1, 2, (3, 4), 1, 1))
    after = Steered.before(halved.folder, 2)
    assert (after.sweep, after.step, after.ceiling, after.psnr) == (1, 4, 1.0, 31.45)


def test_a_run_ends_with_the_sweep_that_reaches_the_target(job):
    joined = adapt_in_tiles(replace(job, settings=job.settings | {"target_db": 5.0}), 2)
    assert {tile["sweep"] for tile in joined.tiles} == {0}


# Several scales


def base_pictures(monkeypatch):
    """The sizes of the pictures of the base that are drawn from now on."""
    sizes = []

    def draw_base(scene, view):
        image = real_draw_base(scene, view)
        sizes.append(tuple(image.shape[:2]))
        return image

    real_draw_base = truth.draw_base
    monkeypatch.setattr(truth, "draw_base", draw_base)
    return sizes


def test_scales_share_the_cut_and_the_pictures_of_the_base(job, monkeypatch):
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.25)]
    alone = adapt_in_tiles(replace(jobs[1], target=job.target.with_name("alone.ply")), 2).file
    cuts, sizes = [], base_pictures(monkeypatch)
    monkeypatch.setattr(plan, "make_cut", lambda *asked: (cuts.append(asked), make_cut(*asked)))
    files = [joined.file for joined in adapt_all_in_tiles(jobs, 2)]
    assert len(cuts) == 1 and sizes == [(16, 20)] * 5  # three views, and two of validation
    assert read_ply(files[1]).columns["x"].tobytes() == read_ply(alone).columns["x"].tobytes()


def test_scales_of_other_views_draw_their_own(job, monkeypatch):
    """At x1/8 four samples a pixel are drawn from half of the base's pixels."""
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.125)]
    sizes = base_pictures(monkeypatch)
    assert all(joined.file.exists() for joined in adapt_all_in_tiles(jobs, 2))
    assert sizes == [(16, 20)] * 5 + [(8, 10)] * 5


def test_a_scale_that_is_interrupted_leaves_the_others_what_they_share(job, monkeypatch):
    jobs = [replace(job, scale=scale, target=job.target.with_name(f"x{scale}.ply")) for scale in (0.5, 0.25)]
    first = next(adapt_all_in_tiles(jobs, 2))
    sizes = base_pictures(monkeypatch)
    assert first.file.exists() and adapt_in_tiles(jobs[1], 2).file.exists() and not sizes


def test_jobs_of_several_bases_or_of_one_output_are_refused(job, tmp_path):
    other = replace(job, target=job.target.with_name("other.ply"), base=replace(job.base, background="white"))
    for jobs in ([job, other], [job, replace(job, scale=0.25)]):
        with pytest.raises(SettingsError, match="those of one base, each with an output of its own"):
            next(adapt_all_in_tiles(jobs, 2))


def test_no_folder_is_claimed_if_one_cannot_be(job):
    jobs = [replace(job, target=job.target.with_name(name)) for name in ("a.ply", "b.ply")]
    (work_folder(jobs[1].target)).mkdir()
    (work_folder(jobs[1].target) / "something").write_text("")
    with pytest.raises(SettingsError, match="holds other things"):
        next(adapt_all_in_tiles(jobs, 2))
    assert not work_folder(jobs[0].target).exists()


def test_a_disk_that_is_full_before_the_base_is_cut_leaves_no_plan_behind(job, monkeypatch):
    """Which would refuse other settings, for tiles that are not there."""
    monkeypatch.setattr(plan, "make_cut", lambda *_: (_ for _ in ()).throw(OutputError("no space left")))
    with pytest.raises(OutputError, match="no space left"):
        next(adapt_all_in_tiles([job], 2))
    assert not work_folder(job.target).exists()


# The command


def test_the_command(job, capsys):
    options = ["--scale", "1/2", "--steps", "0", "--views", "given", "--output", str(job.target)]
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2"]) == 0
    out = capsys.readouterr().out
    assert "x0.5, 2 tiles:" in out and str(job.target) in out
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2", "--skip-existing", "--overwrite"]) == 0
    assert "finished before" in capsys.readouterr().out
    assert main(["adapt", str(job.base.checkpoint), *options, "--tiles", "2", "--skip-existing", "--json"]) == 0
    assert [report["file"] for report in json.loads(capsys.readouterr().out)] == [str(job.target)]


def test_the_command_for_several_scales_skips_what_is_finished(job, capsys):
    options = ["--steps", "0", "--views", "given", "--tiles", "2", "--scale", "1/2"]
    assert main(["adapt", str(job.base.checkpoint), *options, "--json"]) == 0
    capsys.readouterr()
    assert main(["adapt", str(job.base.checkpoint), *options, "--scale", "1/4", "--json"]) == 0
    reports = json.loads(capsys.readouterr().out)
    assert [report["scale"] for report in reports] == [0.5, 0.25]


def test_the_command_says_how_to_go_on_with_several_scales(job, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt("interrupted")
        yield

    monkeypatch.setattr(run, "adapt_all_in_tiles", interrupted)
    options = ["adapt", str(job.base.checkpoint), "--steps", "0", "--tiles", "2", "--scale", "1/2"]
    two = ["--scale", "1/4"]
    for further, again in (([], "again to go on"), (two, "again to go on"), ([*two, "--overwrite"], "with --skip-existing")):
        assert main([*options, *further]) == 130
        assert again in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("a.ply b.ply --scale 1/2 --tiles 2", "--tiles cuts one checkpoint"),
        ("a.ply --scale 1/2 --tiles 2 --report", "without tiles"),
        ("a.ply --scale 1/2 --tiles 2 --dask local:2 --send-files", "leave --send-files out"),
    ],
)
def test_commands_that_cannot_be(words, reason, capsys):
    assert main(["adapt", *words.split()]) == 2
    assert reason in capsys.readouterr().err


def test_help_says_what_a_time_budget_is_of(capsys):
    with pytest.raises(SystemExit):
        main(["adapt", "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Maximum number of seconds for each file; with --tiles for each tile instead" in said
