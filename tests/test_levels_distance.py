"""Levels by distance: the rule, chunks, what is merged, mixtures, walks, and a small ladder from end to end."""

import json
import math
import re
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import pytest
import tiny
import torch
from torch.overrides import TorchFunctionMode

from mipmap_plugin import cli, load_model, wrap_model
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.adaptation.pixel_size import pixel_size, seen_pixel_size
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.commands.levels import print_summary
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance import chunks as chunks_module
from mipmap_plugin.levels.distance.chunks import Chunks, shrunk
from mipmap_plugin.levels.distance.coarsening import coarsened, kept_splats, shaped
from mipmap_plugin.levels.distance.ladder import _first, by_distance, scene_of
from mipmap_plugin.levels.distance.level import AS_FINER, LevelRun
from mipmap_plugin.levels.distance.mixture import Mixture, together
from mipmap_plugin.levels.distance.rule import DistanceRule, focal, is_unbounded, nearest
from mipmap_plugin.levels.distance.walks import WalkTruth, backed, foreground
from mipmap_plugin.levels.distance.yardstick import Walks
from mipmap_plugin.levels.manifest import MANIFEST, read_manifest
from mipmap_plugin.levels.request import Band, LadderRequest
from mipmap_plugin.levels.streamed import distances, progression
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.pages.walks import walks_page
from mipmap_plugin.scenes import write_cameras

pytestmark = pytest.mark.usefixtures("few_views")

RULE = DistanceRule(first=0.1, ratio=2.0, count=4)
BRIEF = dict(steps=4, extra_views=2, validation_views=2, warm_up=0, views_per_step=1)


def with_background(near=300, far=200):
    """A ball that the cameras surround, and a sky far behind it."""
    rng, ball = torch.Generator().manual_seed(3), tiny.gaussians(near, degree=0)
    sky = tiny.gaussians(far, degree=0, seed=5, spread=1.0)
    away = sky.means / sky.means.norm(dim=1, keepdim=True) * (14 + 8 * torch.rand(far, 1, generator=rng))
    return together([replace(ball, scales=ball.scales / 3), replace(sky, means=away, scales=8 * sky.scales)])


def wrapped(**counts):
    model = VanillaModel.from_gaussians(with_background(**counts), tiny.model(1).trained)
    return wrap_model(model, cameras=tiny.cameras(3, width=48, height=36), backend="cpu", threads=1)


@pytest.fixture
def small_chunks(monkeypatch):
    """The scenes here have hardly more splats than the smallest chunk of splat-transform."""
    cut = Chunks.of
    monkeypatch.setattr(chunks_module.Chunks, "of", classmethod(lambda _, splats, extent: cut(splats, extent, least=16)))


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
    assert base_distance / focal(camera) == pytest.approx(RULE.first)


def test_the_rule_counts_the_shorter_side():
    wide = Camera(200, 100, 50.0, 60.0, 100, 50, torch.eye(4))
    assert focal(wide) == 60.0 and focal(replace(wide, width=100, height=200)) == 50.0


def test_the_rule_follows_from_the_nearest_parts():
    """They leave level 0 where its band ends, and the last level has them at the coarsest scale."""
    pixels, band = torch.cat([torch.full((50,), 0.01), torch.full((50,), 0.5)]), Band.first(2.0, as_it_is=False)
    rule = DistanceRule.of(pixels, LadderRequest("playcanvas", coarsest=1 / 8), band)
    assert nearest(pixels) == pytest.approx(0.01)
    assert rule.first == pytest.approx(0.01 * 2**0.5) and rule.ratio == 2.0
    assert rule.ends(rule.count - 1)[1] >= 0.01 * 8 > rule.ends(rule.count - 2)[1]


def test_scenes_with_a_background_are_unbounded_and_objects_are_not():
    views = tiny.cameras(6)
    assert is_unbounded(with_background().means, views, 0.01)
    assert not is_unbounded(tiny.gaussians(200).means, views, 0.01)


def test_splats_in_no_picture_have_no_part_in_the_rule():
    """A third of the splats here lie right behind a camera, and one in ten right before it, nearer than the near plane."""
    views, ball = tiny.cameras(1, width=48, height=36), tiny.gaussians(300, degree=0)
    eye = views[0].center.float()
    away = eye / eye.norm()
    behind, before = (tiny.gaussians(count, degree=0, spread=1e-4, seed=count) for count in (150, 45))
    hidden = [replace(behind, means=behind.means + eye + 0.2 * away), replace(before, means=before.means + eye - 0.005 * away)]
    base, cluttered = (wrap_model(VanillaModel.from_gaussians(together(parts), tiny.model(1).trained), cameras=views, backend="cpu", threads=1)
                       for parts in ([ball], [ball, *hidden]))  # fmt: skip
    request = LadderRequest("playcanvas", coarsest=1 / 8)
    rules = [scene_of(each, request, request.first_band(each.target("playcanvas"), each.effects())) for each in (base, cluttered)]
    assert rules[0].rule == rules[1].rule and rules[0].near == rules[1].near and rules[0].extent == rules[1].extent
    assert not by_distance(cluttered, replace(request, viewer="supersplat", by="auto"))


def test_a_scene_that_no_camera_sees_is_not_unbounded():
    assert not is_unbounded(torch.cat([torch.zeros(5, 3), torch.full((5, 3), 100.0)]), [from_x(1e6)], 0.01)


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
    assert shrunk(torch.tensor([[1.0, 1, 1], [5, 5, 5]])).tolist() == [[1, 1, 1], [5, 5, 5]]
    assert shrunk(torch.tensor([[1.0, 1, 1], [1, 1, 1], [5, 5, 5]]))[2].tolist() == [2, 2, 2]


def test_splats_in_one_place_are_one_chunk():
    splats = tiny.gaussians(50)
    assert len(Chunks.of(replace(splats, means=torch.zeros_like(splats.means)), extent=0.1, least=10)) == 1


# Merging by scale


def test_only_splats_smaller_than_the_level_are_merged():
    splats, size = with_background(), 0.1
    pixels = pixel_size(splats.means, tiny.cameras(6))
    far = pixels >= size
    assert 0 < far.sum() < len(splats)
    target = Effects(screen_filter="classic", eps2d=0.3, sh_degree=0)
    made, fixed = coarsened(splats, lambda means: pixel_size(means, tiny.cameras(6)), (0.0, size), torch.ones(len(splats)), 100, target)
    assert fixed == far.sum()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(made, name)[:fixed], getattr(splats, name)[far])
    assert 100 <= len(made) - fixed < (~far).sum()


def test_nothing_is_merged_for_pixels_smaller_than_those_of_training():
    splats = tiny.gaussians(40)
    made, fixed = coarsened(splats, lambda means: torch.ones(len(means)), (0.0, 0.5), torch.ones(40), 10, Effects(0))
    assert fixed == len(made) == 40 and torch.equal(made.means, splats.means)


def test_fewer_are_kept_of_what_is_coarser():
    pixels = torch.tensor([0.01, 0.02, 0.04, 10.0])
    assert kept_splats(pixels.repeat(1000), 0.1, 2.0) < kept_splats(pixels.repeat(1000), 0.05, 2.0)
    assert kept_splats(pixels, 0.001, 2.0) == 0


def test_the_world_form_takes_off_what_the_larger_pixel_adds():
    """With the dilation of its pixel, a splat that is wide enough covers what it did before; a narrow one loses opacity instead."""
    ones = torch.ones(2, 3)
    scales, round_ones = torch.stack([ones[0], 0.01 * ones[0]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
    splats = Gaussians(torch.zeros(2, 3), round_ones, scales, torch.full((2,), 0.5), ones[:, None])
    target = Effects(0, "classic", 0.3)
    scales, opacities = shaped(splats, torch.tensor([0.5, 0.5]), 1.0, target)
    assert torch.allclose(scales[0].square() + 0.3, 1 + 0.3 * 0.25 * ones[0]) and opacities[0] == pytest.approx(0.5)
    assert opacities[1] < 0.2 and scales[1].max() <= 0.011
    same, as_before = shaped(splats, torch.tensor([0.5, 0.5]), 1.0, replace(target, screen_filter="mip"))
    assert same is splats.scales and as_before is splats.opacities


# Mixtures


def mixture():
    """Two chunks beside each other, and three levels that can be told apart by their opacity."""
    splats = tiny.gaussians(40, degree=0)
    left = torch.arange(40) < 20
    splats = replace(splats, means=torch.where(left, 0.0, 10.0)[:, None] + 0.1 * splats.means, scales=0.01 * splats.scales)
    chunks = Chunks.of(splats, extent=2.0, least=1)
    levels = [replace(splats, opacities=torch.full((40,), 0.1 * (number + 1))) for number in range(3)]
    return Mixture.of(DistanceRule(0.05, 2.0, 3), chunks, levels), chunks


def from_x(x):
    """A camera at (x, 0, 0)."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(100, 100, 100.0, 100.0, 50, 50, viewmat)


def test_a_mixture_has_each_chunk_at_the_level_of_its_distance():
    """From x = -2 the near chunk is 2 away, a pixel of 0.02: level 0; the far one 12, 0.12: level 2."""
    mixed, chunks = mixture()
    splats = mixed.splats(from_x(-2.0))
    near = splats.means[:, 0] < 5
    assert len(chunks) == 2 and len(splats) == 40
    assert torch.allclose(splats.opacities[near], torch.tensor(0.1)) and torch.allclose(splats.opacities[~near], torch.tensor(0.3))
    assert torch.allclose(mixed.splats(from_x(-200.0)).opacities, torch.tensor(0.3))


def test_only_the_level_itself_has_a_gradient_and_only_where_it_is_shown():
    mixed, _ = mixture()
    opacities = torch.full((40,), 0.9, requires_grad=True)
    student = replace(mixed.levels[2], opacities=opacities)
    drawn = mixed.with_student(2, student, from_x(-2.0), fixed=25)
    assert len(drawn) == 40
    drawn.opacities.sum().backward()
    far, moves = student.means[:, 0] > 5, torch.arange(40) >= 25
    assert torch.equal(opacities.grad, (far & moves).float())


# Walks


def test_walking_back_moves_everything_away():
    view, points = tiny.cameras(1)[0], tiny.gaussians().means
    before, after = (camera.to_camera(points)[:, 2] for camera in (view, backed(view, 3.0)))
    torch.testing.assert_close(after, before + 3.0, rtol=1e-4, atol=1e-4)


def test_the_foreground_is_what_is_nearest_in_the_picture():
    view, splats = tiny.cameras(1)[0], with_background()
    depth = foreground(view, splats.means, 0.2)
    assert 0.2 < depth < 10
    assert foreground(backed(view, 5.0), splats.means, 0.2) > depth
    assert foreground(view, view.center.float()[None] - 100 * view.viewmat[2, :3].float()[None], 0.2) == math.inf


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
    base, request = wrapped(), LadderRequest("classic", coarsest=1 / 4, ratio=2.0, by="distance")
    scene = scene_of(base, request, request.first_band(base.target("classic"), base.effects()))
    away = from_x(1e6)
    assert math.isinf(foreground(away, scene.splats.means, scene.target.near_plane))
    monkeypatch.setattr("mipmap_plugin.levels.distance.yardstick.jittered", lambda views, count, generator: [away, views[0]])
    walks = Walks(scene, [base.model] * scene.rule.count)
    assert walks.views and not any(view is away for view in walks.views)


def test_a_place_is_measured_once_where_levels_end_before_walks_begin(small_chunks):
    """The nearest parts of this scene are nearer than what most views have before them."""
    base, request = wrapped(), LadderRequest("classic", coarsest=1 / 4, ratio=1.3, by="distance")
    scene = scene_of(base, request, request.first_band(base.target("classic"), base.effects()))
    walks = Walks(scene, [base.model] * scene.rule.count)
    pixels = [[walks.seen(view, size).pixel for view in walks.views] for size in walks.places()]
    assert len(walks.places()) < 1 + 2 * scene.rule.count and walks.places()[0] == 0
    assert all(any(one < other for one, other in zip(*pair, strict=True)) for pair in pairwise(pixels))


def test_cameras_that_see_nothing_are_refused():
    base = wrap_model(wrapped().model, cameras=[from_x(1e6)])
    with pytest.raises(SettingsError, match="none of the 1 views shows a splat"):
        base.levels("classic", by="distance")


# Ladders


def test_a_ladder_from_end_to_end(tmp_path, small_chunks, capsys):
    """The far splats of every level are those of the first; the manifest gives what PlayCanvas is set to."""
    base = wrapped()
    ladder = base.levels("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF)
    folder = ladder.save(tmp_path / "levels")
    manifest = json.loads((folder / MANIFEST).read_text())
    files = [load_model(folder / level["file"]).gaussians(base.any_camera()) for level in manifest["levels"]]
    assert manifest["by"] == "distance" and len(files) == 3
    first, last = files[0], files[-1]
    far = ladder.contents.scene.pixel_of(first.means) >= manifest["levels"][-1]["pixel_from"] * 2**0.5
    torch.testing.assert_close(last.means[: far.sum()], first.means[far], rtol=1e-6, atol=1e-6)
    assert not torch.equal(last.means[far.sum() :], first.means[~far][: len(last) - far.sum()])
    assert progression(distances(manifest, manifest["canvas"]), 2.0) == pytest.approx((manifest["lodBaseDistance"], manifest["lodMultiplier"]))
    assert manifest["levels"][0]["distance_to"] == pytest.approx(manifest["lodBaseDistance"]) == manifest["levels"][1]["distance_from"]
    assert manifest["levels"][-1]["distance_to"] is None
    assert [level["scale"] for level in manifest["levels"]] == [level.report.scale for level in ladder.contents.levels]
    near, pixels = manifest["base_pixel"], [level["pixel_from"] for level in manifest["levels"][1:]]
    assert [level["scale"] for level in manifest["levels"][1:]] == pytest.approx([near / (pixel * 2**0.5) for pixel in pixels])
    assert [point["pixel"] for point in manifest["curve"]] == sorted({point["pixel"] for point in manifest["curve"]})
    assert [point["zoom"] for point in manifest["curve"]] == pytest.approx([near / point["pixel"] for point in manifest["curve"]])
    keyed = {zoom: psnr for level in manifest["levels"] for zoom, psnr in level["psnr_db"].items()}
    assert keyed == {f"{point['zoom']:.4g}": point["psnr_db"] for point in manifest["curve"]}
    seconds = dict(ladder.levels[-1].report.seconds)
    assert sum(seconds.values()) == pytest.approx(2 * seconds["total"])  # of all phases
    print_summary(folder, manifest)
    assert "3 levels by distance" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("db", "name"),
    [
        ((30.0, 36.0, 34.0), "merged splats of the finer level"),  # half of the gain is kept
        ((30.0, 36.0, 32.0), "the finer level in closed form"),
        ((30.0, 29.0, 29.8), "merged splats of the finer level"),  # what merging may cost in any recipe
        ((30.0, 29.0, 29.5), AS_FINER),  # all would be worse than that
    ],
)
def test_a_level_that_no_step_betters_is_not_merged_at_any_cost(small_chunks, monkeypatch, db, name):
    """`db`: of the finer level as it is, in closed form, and merged."""
    finer, formed, merged = db
    base, coarser = wrapped(), LevelRun._coarser
    request = LadderRequest.of("classic", by="distance", coarsest=1 / 4, ratio=2.0, **BRIEF | {"steps": 0})
    band = request.first_band(base.target("classic"), base.effects())
    first, quality = _first(base, request, band, None).model, {}

    def noted(self, weights, kept):
        student = coarser(self, weights, kept)
        quality[student] = formed if weights is None else merged
        return student

    monkeypatch.setattr(LevelRun, "_coarser", noted)
    monkeypatch.setattr(Validation, "steer", lambda self, model: quality.get(model, finer))
    student, told = LevelRun(scene_of(base, request, band), 1, [first])._start()
    assert told == name
    if name == AS_FINER:
        assert torch.equal(student.parameters()["means"], first.parameters()["means"])


def test_what_takes_long_is_announced(small_chunks, monkeypatch):
    told = []
    for module in ("ladder", "level"):
        monkeypatch.setattr(f"mipmap_plugin.levels.distance.{module}.announced", lambda what: (told.append(what), nullcontext())[1])
    wrapped().levels("classic", by="distance", coarsest=1 / 2, ratio=2.0, **BRIEF)
    assert told == ["cutting the scene into chunks", "level 1: choosing views", "level 1: merging", "level 1: validation", "measuring the levels"]


def test_a_level_that_is_worse_than_the_finer_one_says_so(small_chunks, monkeypatch):
    monkeypatch.setattr(LevelRun, "_as_finer", lambda *_: 99.0)
    with pytest.warns(UserWarning, match=r"level_1 has .* dB where it is shown, where the finer level would have 99\.0, with more splats"):
        report = wrapped().levels("classic", by="distance", coarsest=1 / 2, ratio=2.0, **BRIEF).contents.levels[1].report
    assert report.validation[AS_FINER] == 99.0 and any(note.startswith("level_1 has") for note in report.notes)


def test_a_level_at_the_end_that_is_the_finer_one_again_is_left_out(tmp_path, small_chunks, monkeypatch, capsys):
    base, start = wrapped(near=100, far=60), LevelRun._start
    options = dict(by="distance", coarsest=1 / 8, ratio=2.0, **BRIEF | {"steps": 0})
    whole = base.levels("classic", **options).contents
    assert len(whole.levels) == 4 and not whole.left_out

    def repeating(self):
        student = start(self)
        return (self._for_target(), AS_FINER) if self.number in (1, 3) else student

    monkeypatch.setattr(LevelRun, "_start", repeating)
    ladder = base.levels("classic", **options)
    assert len(ladder.levels) == 3  # the first stays, for another one comes after it
    manifest = read_manifest(ladder.save(tmp_path / "ladder"))
    [left_out], curve = manifest["left_out"], manifest["curve"]
    assert left_out["scale"] == whole.scene.scale(3) and left_out["splats"] == manifest["levels"][2]["splats"]
    assert len(manifest["switches"]) == 2 and manifest["levels"][2]["pixel_to"] is None
    assert [point["pixel"] for point in curve] == [point.pixel for point in whole.curve] and curve[-1]["level"] == 2
    print_summary(tmp_path / "ladder", manifest)
    assert "where a neighbor is shown: nothing was better than the finer level as it is" in capsys.readouterr().out
    assert walks_page("ladder", ladder.contents, manifest, ()).zooms


def test_an_interrupted_ladder_goes_on_with_its_finished_levels(tmp_path, small_chunks, monkeypatch):
    from mipmap_plugin.levels.distance.level import LevelRun

    base, options, made = wrapped(near=100, far=60), dict(by="distance", coarsest=1 / 4, ratio=2.0, resume=tmp_path / "state", **BRIEF), []
    whole = base.levels("classic", **{**options, "resume": tmp_path / "other"})
    run = LevelRun.run

    def stopped(self, resume):
        made.append(self.number)
        if len(made) == 2:
            raise KeyboardInterrupt
        return run(self, resume)

    monkeypatch.setattr(LevelRun, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        base.levels("classic", **options)
    resumed = base.levels("classic", **options)
    assert made == [1, 2, 2]
    for one, other in zip(whole.levels, resumed.levels, strict=True):
        assert all(torch.equal(tensor, other.model.parameters()[name]) for name, tensor in one.model.parameters().items())


@pytest.mark.parametrize(
    ("viewer", "by", "far", "expected"),
    [("supersplat", "auto", 200, True), ("supersplat-viewer", "auto", 200, True), ("spark", "auto", 200, False),
     ("supersplat", "auto", 0, False), ("spark", "distance", 0, True), ("supersplat", "zoom", 200, False)],
)  # fmt: skip
def test_auto_is_by_distance_for_streaming_viewers_of_unbounded_scenes(viewer, by, far, expected):
    assert by_distance(wrapped(far=far) if far else wrap_model(tiny.model(), cameras=tiny.cameras(6)), LadderRequest(viewer, by=by)) is expected


def test_auto_is_by_zoom_where_a_bound_asks_for_it():
    assert not by_distance(wrapped(), LadderRequest("supersplat", by="auto", least_db=30.0))
    assert by_distance(wrapped(), LadderRequest("supersplat", by="auto"))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"by": "size"}, "by: must be one of"),
        ({"by": "distance", "least_db": 30.0}, "leave both out"),
        ({"by": "distance", "merge_to": 0.5}, "merge_to:"),
    ],
)
def test_impossible_requests_are_refused(options, reason):
    with pytest.raises(SettingsError, match=reason):
        wrapped(near=20, far=20).levels("classic", **options)


@pytest.fixture
def command(tmp_path):
    """Words of a command that makes a small ladder by distance in tmp_path/out."""
    VanillaModel.from_gaussians(with_background(60, 40), tiny.model(1).trained).save(tmp_path / "base", provenance={})
    write_cameras(tmp_path / "base" / "cameras.json", tiny.cameras(3, width=48, height=36))
    words = ["levels", str(tmp_path / "base"), "--viewer", "playcanvas", "--output", str(tmp_path / "out"), "--by", "distance"]
    return [*words, "--recipe", "instant", "--backend", "cpu", "--threads", "1"]


def test_the_command_makes_levels_by_distance(tmp_path, capsys, command):
    assert cli.main([*command, "--coarsest", "1/4"]) == 0
    assert "lodBaseDistance" in capsys.readouterr().out and (tmp_path / "out" / "level_1.ply").is_file()


@pytest.mark.parametrize("by", ["distance", "zoom"])
def test_a_ladder_that_ends_within_its_first_band_has_one_level(tmp_path, capsys, command, by):
    assert cli.main([by if word == "distance" else word for word in (*command, "--coarsest", "1", "--report", "--json")]) == 0
    manifest = json.loads(capsys.readouterr().out)
    assert [level["file"] for level in manifest["levels"]] == ["level_0.ply"] and manifest["switches"] == []
    assert (tmp_path / "out" / "report.html").is_file()


def test_the_page_of_walks_has_the_figures_of_their_manifest(tmp_path, capsys, command):
    assert cli.main([*command, "--coarsest", "1/4", "--report"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {tmp_path / 'out' / 'report.html'}"
    text, manifest = (tmp_path / "out" / "report.html").read_text(), json.loads((tmp_path / "out" / MANIFEST).read_text())
    record = json.loads(re.search(r'<script type="application/json" id="record">(.*?)</script>', text, re.DOTALL)[1])
    assert record["ladder"] == manifest and f"on walks backwards at worst {manifest['worst_db']:.1f} dB" in record["lead"]
    scales = [zoom["scale"] for zoom in record["zooms"]]
    assert scales == sorted(scales) and scales[-1] == 1 and scales[0] < 1 / 2 and len(scales) > 3
    curve = {round(point["psnr_db"], 6): point for point in manifest["curve"]}
    for zoom in record["zooms"]:
        base, levels, truth = zoom["pictures"]
        assert [base["role"], levels["role"], truth["role"]] == ["base", "adapted", "truth"]
        assert curve[round(levels["mean"]["psnr_db"], 6)]["base_db"] == pytest.approx(base["mean"]["psnr_db"])
