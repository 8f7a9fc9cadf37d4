"""Levels by distance: the rule by which a chunk chooses its level, and walks that judge it."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import tiny
import torch
from levels_by_distance import from_x, wrapped
from torch.overrides import TorchFunctionMode

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.farther import backed, foreground
from mipmap_plugin.adaptation.views.pixel_size import nearest, seen_pixel_size
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.levels.distance.chunks import Chunks, shrunk
from mipmap_plugin.levels.distance.ladder import by_distance, scene_of
from mipmap_plugin.levels.distance.mixture import Mixture, joined
from mipmap_plugin.levels.distance.rule import DistanceRule, focal_along_shorter_side
from mipmap_plugin.levels.distance.walks import WalkTruth
from mipmap_plugin.levels.distance.yardstick import Walks
from mipmap_plugin.levels.request import Band, LadderRequest
from mipmap_plugin.models.vanilla import VanillaModel

pytestmark = pytest.mark.usefixtures("few_views")

RULE = DistanceRule(first=0.1, ratio=2.0, count=4)


def scene_in(base, ratio=2.0):
    """As levels down to x1/4 see it."""
    request = LadderRequest("classic", coarsest=1 / 4, ratio=ratio, by="distance")
    return scene_of(base, request, request.first_band(base))


# The rule


@pytest.mark.parametrize(
    ("pixel", "level"),
    [(0.0, 0), (0.0999, 0), (0.1001, 1), (0.1999, 1), (0.2001, 2), (0.3999, 2), (0.4001, 3), (0.8001, 3), (1e6, 3), (math.inf, 3)],
)
def test_a_level_is_shown_from_one_power_of_the_ratio_to_the_next(pixel, level):
    """PlayCanvas: level 0 below lodBaseDistance, level k below lodBaseDistance · lodMultiplier^k, the last one beyond."""
    assert RULE.level(torch.tensor([pixel], dtype=torch.float64)).tolist() == [level]


def test_the_ends_of_levels_are_where_the_rule_changes():
    for number in range(1, RULE.count):
        low, high = RULE.ends(number)
        assert RULE.level(torch.tensor([0.999 * low, 1.001 * low, 0.999 * high])).tolist() == [number - 1, number, number]
        assert RULE.middle(number) == pytest.approx((low * high) ** 0.5)
    assert RULE.ends(0) == (0.0, RULE.first)


def test_lod_base_distance_is_that_of_playcanvas():
    """At a field of view of 45° the factor is 1: a canvas of H px sees a pixel of size q at the distance q · H / 2 / tan 22.5°."""
    base_distance, multiplier = RULE.playcanvas(1000)
    assert multiplier == 2.0
    camera = Camera(2000, 1000, 500 / math.tan(math.pi / 8), 500 / math.tan(math.pi / 8), 1000, 500, torch.eye(4))
    assert base_distance / focal_along_shorter_side(camera) == pytest.approx(RULE.first)


def test_the_rule_counts_the_shorter_side():
    wide = Camera(200, 100, 50.0, 60.0, 100, 50, torch.eye(4))
    assert focal_along_shorter_side(wide) == 60.0 and focal_along_shorter_side(replace(wide, width=100, height=200)) == 50.0


def test_the_rule_follows_from_the_nearest_parts():
    """They leave level 0 where its band ends, and the last level has them at the coarsest scale."""
    pixels, band = torch.cat([torch.full((50,), 0.01), torch.full((50,), 0.5)]), Band.first(2.0, as_it_is=False)
    rule = DistanceRule.of(pixels, LadderRequest("playcanvas", coarsest=1 / 8), band)
    assert nearest(pixels) == pytest.approx(0.01)
    assert rule.first == pytest.approx(0.01 * 2**0.5) and rule.ratio == 2.0
    assert rule.ends(rule.count - 1)[1] >= 0.01 * 8 > rule.ends(rule.count - 2)[1]


def test_splats_in_no_picture_have_no_part_in_the_rule():
    """A third of the splats here lie right behind a camera, and one in ten right before it, nearer than the near plane."""
    views, ball = tiny.cameras(1, width=48, height=36), tiny.gaussians(300, degree=0)
    eye = views[0].center.float()
    away = eye / eye.norm()
    behind, before = (tiny.gaussians(count, degree=0, spread=1e-4, seed=count) for count in (150, 45))
    hidden = [replace(behind, means=behind.means + eye + 0.2 * away), replace(before, means=before.means + eye - 0.005 * away)]
    base, cluttered = (wrap_model(VanillaModel.from_gaussians(joined(parts), tiny.model(1).trained), cameras=views, backend="cpu", threads=1)
                       for parts in ([ball], [ball, *hidden]))  # fmt: skip
    request = LadderRequest("playcanvas", coarsest=1 / 8)
    rules = [scene_of(each, request, request.first_band(each)) for each in (base, cluttered)]
    assert rules[0].rule == rules[1].rule and rules[0].near == rules[1].near and rules[0].extent == rules[1].extent
    assert not by_distance(cluttered, replace(request, viewer="supersplat", by="auto"))


def test_the_nearest_parts_are_found_where_few_of_many_views_see_something():
    blind, view = [from_x(1e6)] * 99, tiny.cameras(1)[0]
    means = tiny.gaussians(20).means
    assert torch.equal(seen_pixel_size(means, [*blind, view], 0.01), seen_pixel_size(means, [view], 0.01))


# Chunks


def test_chunks_are_small_or_have_few_splats_and_every_splat_is_in_its_box():
    splats = tiny.gaussians(400)
    chunks = Chunks.of(splats, extent=0.5, least=10)
    place = chunks.of_points(splats.means)
    assert len(chunks) > 4 and sorted(set(place.tolist())) == list(range(len(chunks)))
    for number in range(len(chunks)):
        means = splats.means[place == number]
        assert len(means) <= 10 or (means.amax(0) - means.amin(0)).max() <= 0.5


def test_boxes_are_made_from_the_reach_of_all_splats_once():
    """And not once for each of thousands of chunks, which took longer than all else of a scene of a million."""
    splats, counted = tiny.gaussians(400), []

    class Counting(TorchFunctionMode):
        def __torch_function__(self, function, types, arguments=(), options=None):
            made = function(*arguments, **(options or {}))
            counted.append(made.shape == splats.means.shape if isinstance(made, torch.Tensor) else False)
            return made

    with Counting():
        chunks = Chunks.of(splats, extent=0.1, least=4)
    assert sum(counted) < 20 < len(chunks)


def test_a_distance_is_that_to_the_nearest_point_of_a_box():
    chunks = Chunks([], torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[1.0, 2.0, 3.0]]))
    eyes = torch.tensor([[0.5, 1.0, 1.0], [-2.0, 1.0, 1.0], [4.0, 6.0, 3.0]], dtype=torch.float64)
    assert [float(chunks.distances(eye)) for eye in eyes] == pytest.approx([0.0, 2.0, 5.0])


def test_one_large_splat_hardly_enlarges_a_box():
    """PlayCanvas leaves out three quarters of what a box is larger than half of the boxes."""
    splats = tiny.gaussians(200)
    scales = splats.scales.clone()
    scales[0] = 100.0
    ends = [Chunks.of(replace(splats, scales=each), extent=0.5, least=10) for each in (splats.scales, scales)]
    grown = ((ends[1].high - ends[1].low) - (ends[0].high - ends[0].low)).max()
    assert 40 < grown < 100  # of more than 200


def test_of_two_boxes_the_larger_is_the_usual_one():
    """As in PlayCanvas, whose median of an even number is the upper one."""
    half = torch.tensor([[1.0, 1, 1], [1, 1, 1], [5, 5, 5]])
    assert torch.equal(shrunk(-half[1:], half[1:])[1], half[1:])
    assert [corners[2].tolist() for corners in shrunk(-half, half)] == [[-2, -2, -2], [2, 2, 2]]


def test_splats_in_one_place_are_one_chunk():
    splats = tiny.gaussians(50)
    assert len(Chunks.of(replace(splats, means=torch.zeros_like(splats.means)), extent=0.1, least=10)) == 1


def test_finished_levels_are_cut_together_as_they_are_streamed():
    """splat-transform halves the splats of all levels, those with the lowest places along the longest side first; its chunks have all levels."""
    levels = [tiny.gaussians(count, degree=0, seed=count) for count in (1801, 700, 300)]
    means = torch.cat([level.means for level in levels])

    def cut(rows):
        sides = means[rows].amax(0) - means[rows].amin(0)
        if len(rows) <= 1024 or sides.max() <= 0.5:
            return [rows]
        rising = rows[means[rows, sides.argmax()].argsort()]
        return [*cut(rising[: len(rows) // 2]), *cut(rising[len(rows) // 2 :])]

    expected = cut(torch.arange(len(means)))
    mixture = Mixture.streamed(RULE, 0.5, levels)
    places = torch.cat(list(mixture.places))
    assert len(mixture.chunks) == len(expected) == 4
    assert all(len(set(places[rows].tolist())) == 1 and int((places == places[rows[0]]).sum()) == len(rows) for rows in expected)


def test_walks_are_measured_with_the_chunks_that_are_streamed(small_chunks):
    """Those of the base alone are for making the levels: another one has its splats elsewhere."""
    scene = scene_in(base := wrapped())
    levels = [base.model, *[VanillaModel.from_gaussians(scene.splats[:150], base.model.trained)] * (scene.rule.count - 1)]
    streamed = Mixture.streamed(scene.rule, scene.extent, [scene.splats_of(level) for level in levels])
    seen = Walks(scene, levels).seen(scene.views[0], scene.rule.middle(1))
    camera = backed(scene.views[0], seen.way)
    assert seen.splats == len(streamed.splats(camera))
    assert seen.splats != len(Mixture.of(scene.rule, scene.chunks, streamed.levels).splats(camera))


# Walks


@pytest.mark.parametrize(("screen_filter", "eps2d"), [("classic", 0.3), ("antialiased", 0.3), ("mip", 0.1)])
def test_the_truth_of_the_first_picture_is_the_bases_own(screen_filter, eps2d):
    """Exactly with one sample; with more, up to the shape of the filter."""
    splats, view, backend, effects = tiny.gaussians(80), tiny.cameras(1, width=64, height=48)[0], CpuBackend(), Effects(1, screen_filter, eps2d)
    own = backend.render(splats, view, effects).image.clamp(0, 1)
    one, four = (WalkTruth((splats, backend, effects), [view], {}, samples).make(view, view) for samples in (1, 4))
    torch.testing.assert_close(one, own, atol=2e-3, rtol=0)
    assert (four - own).square().mean().sqrt() < 0.02


def test_the_truth_keeps_the_thickness_of_the_first_picture():
    """A thin splat seen from twice as far has a quarter of the area; the classic dilation would keep it as large as it was."""
    view, backend, effects = from_x(0.0), CpuBackend(), Effects(0, "classic", 0.3)
    splats = tiny.gaussians(1, degree=0)
    splats = replace(splats, means=torch.tensor([[0.0, 0.0, 5.0]]), scales=torch.full((1, 3), 1e-3), opacities=torch.tensor([0.9]))
    truth = WalkTruth((splats, backend, effects), [view], {}, 8)
    first, second = (float(truth.make(camera, view).sum()) for camera in (view, backed(view, 5.0)))
    classic = [float(backend.render(splats, camera, effects).image.sum()) for camera in (view, backed(view, 5.0))]
    assert second / first == pytest.approx(1 / 4, rel=0.1)
    assert classic[1] / classic[0] > 0.9


def test_a_base_that_integrates_over_pixels_is_refused_before_any_work(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.levels.distance.ladder.scene_of", None)
    base = wrap_model(tiny.model(), cameras=tiny.cameras(1), screen_filter="analytic")
    with pytest.raises(SettingsError, match="need a base with a dilation"):
        base.levels("classic", by="distance")


def test_walks_begin_where_something_is_seen(small_chunks, monkeypatch):
    scene = scene_in(base := wrapped())
    away = from_x(1e6)
    assert math.isinf(foreground(away, scene.splats.means, scene.target.near_plane))
    monkeypatch.setattr("mipmap_plugin.levels.distance.yardstick.jittered", lambda views, count, generator: [away, views[0]])
    walks = Walks(scene, [base.model] * scene.rule.count)
    assert walks.views and not any(view is away for view in walks.views)


def test_a_place_is_measured_once_where_levels_end_before_walks_begin(small_chunks):
    """The nearest parts of this scene are nearer than what most views have before them."""
    scene = scene_in(base := wrapped(), ratio=1.3)
    walks = Walks(scene, [base.model] * scene.rule.count)
    pixels = [[walks.seen(view, size).pixel for view in walks.views] for size in walks.sizes()]
    assert len(walks.sizes()) < 1 + 2 * scene.rule.count and walks.sizes()[0] == 0
    assert all(any(one < other for one, other in zip(*pair, strict=True)) for pair in pairwise(pixels))


def test_cameras_that_see_nothing_are_refused():
    base = wrap_model(wrapped().model, cameras=[from_x(1e6)])
    with pytest.raises(SettingsError, match="none of 1 view shows a splat"):
        base.levels("classic", by="distance")
