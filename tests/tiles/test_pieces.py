"""A scene in pieces: every splat in one core, exact pictures from the disk, and parts that are joined."""

from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.start.blend_weights import weighed
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.formats.ply import MAX_HEADER, read_header
from mipmap_plugin.formats.ply_rows import PlyRows, concatenate
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles import slabs
from mipmap_plugin.tiles.cut import cut, front_to_back
from mipmap_plugin.tiles.folder import CUT
from mipmap_plugin.tiles.pictures import Album, new_pictures
from mipmap_plugin.tiles.reading import make_cut
from mipmap_plugin.tiles.slabs import Painter
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.store import Store, write_store

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


# Cuts


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_every_splat_lies_in_exactly_one_core_of_equal_size(count):
    means = torch.randn(1003, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([3.0, 1.0, 2.0])
    rows = torch.arange(1003)[torch.arange(1003) % 7 != 0]
    cores, _ = cut(means, rows, count)
    assert torch.equal(torch.cat(cores).sort().values, rows)
    assert max(map(len, cores)) - min(map(len, cores)) <= 1
    assert all(torch.equal(core, core.sort().values) for core in cores)


@pytest.mark.parametrize("away", [0.0, 1e4])
def test_a_cut_is_a_plane_across_the_longest_axis_which_far_strays_do_not_decide(away):
    means = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 9.0, 1.0])
    means[:, 2] += 50
    means[:5, 0] += away
    (low, high), _ = cut(means, torch.arange(500), 2)
    assert means[low, 1].max() <= means[high, 1].min()


def test_sizes_of_splats_do_not_decide_where_a_scene_is_cut(tmp_path):
    """Its cameras are on one side of each plane, and of no size."""
    splats = tiny.gaussians(200, spread=0.1)
    sizes = torch.logspace(-2, 2, 200)[:, None].expand(-1, 3)
    ply = VanillaModel.from_gaussians(replace(splats, scales=sizes), TrainedScale()).save(tmp_path / "scene.ply", provenance={})
    make_cut(ply, 8, tmp_path)
    assert sorted(front_to_back(load_torch(tmp_path / CUT)["tree"], (0.0, 0.0, 0.0))) == list(range(8))


@pytest.mark.parametrize("count", [2, 5, 8])
def test_a_core_is_before_all_that_it_may_hide(count):
    """Every line of sight meets the cores, which its planes keep apart, in their order."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(800, 3, generator=generator)
    cores, tree = cut(means, torch.arange(800), count)
    center = torch.tensor([0.3, -0.2, 0.1])
    order = front_to_back(tree, center.tolist())
    assert sorted(order) == list(range(count))

    def core_at(point, node=tree):
        return node if isinstance(node, int) else core_at(point, node[2] if point[node[0]] <= node[1] else node[3])

    assert all(core_at(mean) == number for number, core in enumerate(cores) for mean in means[core])
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
    splats.opacities = torch.linspace(0, 1, 300)
    assert torch.equal(splats.gaussians(rows).opacities, splats.opacities[rows])


def test_splats_beside_a_picture_are_seen_as_far_as_they_reach():
    """A splat of 5 px, three and seven of its standard deviations from each edge; and one behind the near plane."""
    camera = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, torch.eye(4))
    at = [(u, v) for away in (15, 35) for u, v in ((-away, 15), (40 + away, 15), (20, -away), (20, 30 + away))]
    places = torch.tensor([[(u - 20) / 5, (v - 15) / 5, 10.0, 1.0] for u, v in at] + [[0.0, 0.0, 0.1, 1.0]])
    rows, depths = Splats(VanillaModel, [], places).seen_by(camera, 0.2)
    assert rows.tolist() == [0, 1, 2, 3] and depths.tolist() == [10.0] * 4


@pytest.mark.parametrize("piece", [7, 50])
def test_splats_come_back_from_a_file_as_they_were(tmp_path, monkeypatch, piece):
    monkeypatch.setattr("mipmap_plugin.tiles.store.PIECE", piece)
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
    with new_pictures(tmp_path / "a") as write:
        for name, picture in pictures.items():
            write(name, picture, (1, 2, 3, 4) if "/" in name else None)
    album = Album([tmp_path / "a"])
    assert all(torch.equal(album[name], picture) for name, picture in pictures.items())
    assert album.box("2/0") == (1, 2, 3, 4) and album.box("1") == (0, 0, 4, 3) and "3" not in album


def test_slabs_give_the_picture_of_all_splats(on_disk, monkeypatch):
    splats, in_memory = on_disk
    camera, backend = tiny.cameras(1)[0], ReferenceBackend()
    whole = backend.render(in_memory, camera, EFFECTS)
    monkeypatch.setattr(slabs, "SLAB", 37)
    assert torch.allclose(Painter(backend, EFFECTS).image(splats, camera), whole.image, atol=2e-4)
    assert torch.allclose(1 - Painter(backend, EFFECTS).draw(splats, camera).transmittance[..., 0], whole.alpha, atol=2e-4)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_slabs_give_the_blend_weights_of_all_splats(on_disk, monkeypatch, backend):
    if backend == "cpu":
        pytest.importorskip("numba")
    splats, in_memory = on_disk
    views, backend = tiny.cameras(3), get_backend(backend)
    monkeypatch.setattr(slabs, "COLORLESS_SLAB", 37)
    expected, shown = weighed(in_memory, views, [0, 3, 0], backend, EFFECTS)
    found = Painter(backend, EFFECTS).weighed(splats, views, [0, 3, 0])
    assert torch.allclose(found[0], expected, atol=1e-3, rtol=1e-3) and found[1] == pytest.approx(shown)


def test_strips_give_the_blend_weights_of_their_view(on_disk, monkeypatch):
    splats, _ = on_disk
    view, painter = tiny.cameras(1), Painter(ReferenceBackend(), EFFECTS)
    whole, _ = painter.weighed(splats, view, [0])
    monkeypatch.setattr(slabs, "MOST_PIXELS", 300)
    assert [strip.height for strip in slabs.strips(view[0])] == [8, 8, 8]
    assert torch.allclose(painter.weighed(splats, view, [0])[0], whole, atol=0.02, rtol=0.01)  # the frame limits how oblique a splat may be drawn


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("format ascii 1.0\nelement vertex 1", "only a binary PLY is read part by part"),
        ("format binary_little_endian 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 1", "only a PLY without lists"),
    ],
)
def test_a_file_whose_rows_have_no_known_place_is_refused(tmp_path, header, message):
    path = tmp_path / "scene.ply"
    path.write_text(f"ply\n{header}\nproperty float x\nend_header\n0000000\n")
    with pytest.raises(CheckpointError, match=message):
        PlyRows(path)


# The concatenation


def test_a_concatenation_has_the_bytes_of_its_parts_in_their_order(tmp_path):
    parts = [tiny.model(150, seed=seed).save(tmp_path / f"part_{seed}.ply", provenance={}) for seed in (0, 1)]
    whole = concatenate(tmp_path / "whole.ply", parts, ["of two parts"])
    bodies = b"".join(part.read_bytes()[read_header(part).body :] for part in parts)
    header = read_header(whole)
    assert whole.read_bytes()[header.body :] == bodies
    assert header.vertex.count == 300 and header.comments == ("of two parts",) and not header.notes


def test_parts_of_other_columns_are_refused(tmp_path):
    first = tiny.model(degree=1).save(tmp_path / "first.ply", provenance={})
    other = tiny.model(degree=2).save(tmp_path / "other.ply", provenance={})
    with pytest.raises(CheckpointError, match="has other columns than"):
        concatenate(tmp_path / "whole.ply", [first, other], [])


def test_comments_that_no_header_holds_are_refused_also_of_a_concatenation(tmp_path):
    part, whole = tiny.model().save(tmp_path / "part.ply", provenance={}), tmp_path / "whole.ply"
    with pytest.raises(SettingsError, match="but a PLY header holds"):
        concatenate(whole, [part], ["x" * MAX_HEADER])
    assert not whole.exists()
