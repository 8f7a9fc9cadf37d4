"""From where a capture was photographed, as view-dependent colors tell that were trained toward its cameras alone."""

import json
import math
from dataclasses import asdict, replace

import pytest
import torch
from lone_capture import COUNT, FAR, cameras, capture, draws, table

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.adapted_scale import orbit_in
from mipmap_plugin.scenes.orbits import FINER, ORBIT_FOV, Orbit
from mipmap_plugin.scenes.photographed import CONTRAST, FARTHER, LEAST, LONGEST, SMALLEST, agreement, even_directions, photographed, seen_ways

CENTER = torch.zeros(3, dtype=torch.float64)


def by_chance(splats: Gaussians) -> Gaussians:
    return replace(splats, sh=torch.randn(splats.sh.shape, generator=draws(3), dtype=torch.float64))


def found(splats: Gaussians):
    return photographed(splats, CENTER, 2.0, 40.0, ORBIT_FOV / 2)


def test_colors_stand_out_where_the_cameras_were():
    splats, eyes = capture(), cameras()
    assert agreement(splats, eyes).min() > agreement(splats, -eyes).max()
    assert agreement(splats, eyes).mean() > torch.stack([agreement(splats, far * eyes).mean() for far in (0.3, 4.0)]).max()


def test_the_agreement_of_colors_by_chance_is_the_same_everywhere():
    assert agreement(by_chance(capture()), FAR * even_directions()).std() < CONTRAST / 2


def test_the_distance_of_the_cameras_is_found():
    assert FAR / FARTHER < found(capture()).nearest < FAR * FARTHER


def test_the_directions_of_the_cameras_count_as_seen_and_those_across_do_not():
    seen = found(capture()).seen
    ways, nearest = seen_ways(seen, 400, draws(4)), cameras() / FAR
    closest = (nearest @ ways.T).max(dim=1).values
    assert closest.min() > math.cos(math.radians(15))
    assert (ways @ -nearest[len(nearest) // 2]).max() < math.cos(math.radians(15))


def test_the_smallest_splats_are_pixels_in_pictures_from_there():
    splats = capture()
    told = found(splats)
    ways = seen_ways(told.seen, 200, draws(5))
    eyes = torch.cat([told.nearest * ways[::2], told.farthest * ways[1::2]])
    depth = torch.stack([(splats.means - eye) @ -eye / eye.norm() for eye in eyes])
    angle = depth / torch.stack([(splats.means - eye).norm(dim=1) for eye in eyes])
    closest = torch.where(angle > math.cos(ORBIT_FOV / 2), depth, math.inf).amin(0)
    pixels = splats.scales[:, 0] * told.focal / closest
    assert (pixels[closest.isfinite()] < 1).double().mean() == pytest.approx(SMALLEST, abs=0.05)


@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_specks_that_no_picture_shows_ask_for_no_longer_lens_than_there_are(size):
    splats = capture()
    specks = replace(splats, scales=splats.scales.clone())
    specks.scales[::4] = size
    assert found(specks) == replace(found(splats), focal=LONGEST)


@pytest.mark.parametrize(
    "silent",
    [
        by_chance,
        lambda splats: replace(splats, sh=splats.sh[:, :1]),
        lambda splats: splats[: LEAST - 1],
        lambda splats: replace(splats, sh=0 * splats.sh),
    ],
    ids=["chance", "degree 0", "few", "zero bands"],
)
def test_colors_that_do_not_tell_change_nothing(silent):
    orbit = Orbit.around(table(), sharp=lambda: 0.01)
    assert orbit.where_photographed(silent(capture())) is orbit


@pytest.mark.parametrize(("far", "from_within"), [(6.0, False), (2.2, True)], ids=["object", "capture"])
def test_what_is_compact_is_an_object_unless_it_was_photographed_from_within(far, from_within):
    compact = capture(far)[COUNT // 10 :]
    framed = Orbit.around(compact.means)
    assert framed.nearest == 0
    assert bool(framed.where_photographed(compact).nearest) == from_within


def test_splats_that_are_not_finite_are_not_asked():
    splats = capture()
    broken = replace(splats, sh=splats.sh.clone(), means=splats.means.clone())
    broken.sh[::7], broken.means[::11] = math.nan, math.inf
    assert found(broken).nearest == pytest.approx(found(splats).nearest, rel=0.3)


def test_views_are_where_the_colors_tell_half_of_them_farther_and_all_in_the_same_detail():
    orbit = Orbit.around(table(), sharp=lambda: 0.01).where_photographed(capture())
    views = orbit.views((10_000, 10_000), 40, draws(6))
    center = torch.tensor(orbit.center, dtype=torch.float64)
    far = torch.stack([view.center.double() - center for view in views]).norm(dim=1)
    assert sorted({round(each, 6) for each in far.tolist()}) == [round(orbit.nearest, 6), round(FARTHER * orbit.nearest, 6)]
    assert [view.fx / float(each) for view, each in zip(views, far, strict=True)] == pytest.approx([orbit.focal / orbit.nearest] * len(views))
    assert [view.width for view in views] == pytest.approx([2 * view.fx * math.tan(ORBIT_FOV / 2) for view in views], abs=1)


def test_a_finer_view_is_the_same_with_pixels_half_as_large():
    orbit = Orbit.around(table(), sharp=lambda: 0.01).where_photographed(capture())
    [view] = orbit.views((10_000, 10_000), 1, draws(6))
    finer = orbit.finer(view, (10_000, 10_000), draws(7))
    assert torch.allclose(finer.viewmat, view.viewmat, atol=1e-6) and finer.name == view.name
    assert (finer.fx, finer.width, finer.cx) == pytest.approx((FINER * view.fx, FINER * view.width, FINER * view.cx), abs=1)


def test_pictures_are_no_larger_than_asked_and_keep_their_detail():
    orbit = Orbit.around(table(), sharp=lambda: 0.01).where_photographed(capture())
    small, large = (orbit.views((side, 2 * side), 4, draws(7))[0] for side in (10, 10_000))
    assert (small.height, small.width, small.fx) == (10, 20, pytest.approx(large.fx))


def test_pictures_that_show_less_show_all_parts_of_what_a_photograph_would():
    orbit = replace(Orbit.around(table(), sharp=lambda: 0.01).where_photographed(capture()), focal=1000.0)
    views = [view for view in orbit.views((100, 100), 400, draws(8)) if view.fx == orbit.focal]  # of the near ones
    side = 2 * 1000 * math.tan(ORBIT_FOV / 2)
    for middles in ([50 - view.cx for view in views], [50 - view.cy for view in views]):
        assert (min(middles), max(middles)) == pytest.approx((50 - side / 2, side / 2 - 50), abs=side / 20)


def test_an_adapted_file_remembers_it():
    orbit = Orbit.around(table(), sharp=lambda: 0.01).where_photographed(capture())
    record = json.loads(json.dumps({"orbit": asdict(orbit)}))
    assert Orbit(**orbit_in(record)) == orbit
    for wrong in ({"seen": "xyz"}, {"seen": "0"}, {"seen": "f" * 65}, {"focal": -1.0}, {"focal": math.inf}):
        assert Orbit(**orbit_in({"orbit": record["orbit"] | wrong})) == replace(orbit, seen="", focal=0.0)
