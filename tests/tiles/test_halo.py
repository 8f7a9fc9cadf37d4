"""A tile in its halo, which stays as it is: what it shows, and what a step moves."""

import importlib.util
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.tiles.folder import layer_file
from mipmap_plugin.tiles.halo import PAD, _halos
from mipmap_plugin.tiles.pictures import Album, new_pictures
from mipmap_plugin.tiles.run import adapt_in_tiles
from mipmap_plugin.tiles.steering import Steered, open_state
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.surroundings import KEPT, Surroundings, nothing
from mipmap_plugin.tiles.tile import Tile
from mipmap_plugin.tiles.truth import Truths

needs_numba = pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="numba is not installed")


def whole_and_tiles(halved):
    """All splats, and of each tile its rows, its surroundings and its crop of a view that shows all."""
    splats = open_state(halved, Steered.before(halved.folder, 0))
    view = halved.sweep_views(halved.sweeps[0])[0]
    around = [Surroundings(halved, number, halved.sweeps[0]) for number in range(3)]
    rows = torch.arange(len(splats)).split([*map(len, splats.parts)])
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


def test_the_layers_of_a_view_are_not_all_in_memory_at_once(halved):
    """Of 64 tiles in large views they would take a gigabyte."""

    class Counted(Album):
        def __getitem__(self, name):
            picture = super().__getitem__(name).float()
            living.add(picture)
            most.append(len(living))
            return picture

    living, most = weakref.WeakSet(), []
    sweep = halved.sweeps[0]
    layers = [Counted([layer_file(halved.folder, number, sweep.halos)]) for number in range(3)]
    assert len(list(_halos(halved, halved.sweep_views(sweep)[0], layers))) == 3
    assert max(most) <= 2


def test_the_surroundings_of_many_views_are_not_all_in_memory_at_once(halved, monkeypatch):
    around = Surroundings(halved, 0, halved.sweeps[0])
    monkeypatch.setattr(around, "_read", lambda name: name)
    assert [around._surrounding(str(number)) for number in range(2 * KEPT)][-1] in around._kept and len(around._kept) == KEPT


@pytest.mark.parametrize("changed", ["sh", "opacities"])
def test_a_change_of_the_core_shows_as_far_as_the_halo_lets_it_through(halved, changed):
    """Close to what the whole shows: only where splats overlap across a cut do layers differ from it."""
    splats, view, rows, around = whole_and_tiles(halved)
    for own, halo in zip(rows, around, strict=True):
        crop = halo.crop(view)
        values = getattr(splats, changed).clone()
        values[own] = values[own] + 0.5 if changed == "sh" else values[own] / 2
        other = replace(splats, **{changed: values})
        change = shown_in(halved, other, view, crop) - shown_in(halved, splats, view, crop)
        seen = halo.render(other[own], crop) - halo.render(splats[own], crop)
        assert (seen - change).abs().mean() < 0.2 * change.abs().mean()


def test_a_tile_has_pixels_around_what_is_seen_of_it_and_none_where_nearly_nothing_is(tmp_path):
    """The first fills the left of a view, the second lies behind it, and leaves a pixel half open to the third."""
    [view] = tiny.cameras(1, width=40, height=24)
    pictures = torch.zeros(3, 24, 40, 4)
    pictures[0, :, 20:, 3], pictures[1, 2, 30, 3] = 1.0, 0.5  # transmittances
    layers = []
    for number, picture in enumerate(pictures):
        with new_pictures(tmp_path / str(number)) as write:
            write(view.name, picture.half(), None)
        layers.append(Album([tmp_path / str(number)]))
    x = view.center[0].item()
    scene = SimpleNamespace(tree=(0, x + 1, 0, (0, x + 2, 1, 2)), scale=1, target=SimpleNamespace(background=(0.0, 0.0, 0.0)))
    boxes = {number: box for number, _, box in _halos(scene, view, layers)}
    assert boxes == {0: (0, 0, 20 + PAD, 24), 1: (20 - PAD, 0, 40, 24)}


def test_all_tiles_together_are_asked_to_mend_the_whole_error(halved):
    splats, view, _, around = whole_and_tiles(halved)
    size = view.zoomed(halved.scale).size
    image = shown_in(halved, splats, view, view.zoomed(halved.scale))
    error = Truths(halved)[view.name] - image
    asked = torch.zeros(*size, 3)
    for halo in around:
        crop = halo.crop(view)
        left, top, right, bottom = halo._halos.box(f"{view.name}/{halo._number}")
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
    monkeypatch.setattr(ByRows, "step", lambda self, *arguments: (steps.append(self), real_step(self, *arguments)))
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
