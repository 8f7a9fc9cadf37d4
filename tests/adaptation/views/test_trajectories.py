"""Generated views: they stay where the scene was seen, see it, and come out the same for the same seed."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from largest import Largest
from orbiting import orbit

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes import jittered, load_scene
from mipmap_plugin.scenes.orbits import TIGHT, Orbit, frame, guess_up
from mipmap_plugin.scenes.trajectories import BEYOND, CANDIDATES, rotation_matrix, rotation_vector


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cloud(*spread: float, count: int = 4000) -> torch.Tensor:
    return torch.randn(count, 3, generator=seeded(), dtype=torch.float64) * torch.tensor(spread) + torch.tensor([5.0, -2.0, 1.0])


def ring(count: int = 12) -> list[Camera]:
    return [replace(c, width=80, cx=40.0, split="test") for c in orbit(cloud(1, 1, 1), (60, 60), count, seeded(7), up=(0, 0, 1))]


def poses(cameras: list[Camera]) -> torch.Tensor:
    return torch.stack([camera.viewmat for camera in cameras])


def forwards(cameras: list[Camera]) -> torch.Tensor:
    return poses(cameras)[:, 2, :3]


def in_view(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return (z > NEAR_PLANE) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)


# orbit


def test_orbit_frames_nine_tenths_of_the_splats():
    means = cloud(1, 1, 0.5)
    assert min(in_view(camera, means).double().mean().item() for camera in orbit(means, (48, 64), 10, seeded())) >= 0.9


def test_orbit_ignores_far_floaters_and_broken_rows():
    means = cloud(1, 1, 1)
    dirty = torch.cat([means, torch.full((40, 3), 1e6, dtype=torch.float64), torch.full((1, 3), math.nan, dtype=torch.float64)])
    clean, spoilt = (Orbit.around(m) for m in (means, dirty))
    assert math.dist(spoilt.center, clean.center) < 0.5
    assert clean.distance / TIGHT <= spoilt.distance <= clean.distance


def test_orbit_stands_above_the_horizon_with_the_vertical_upright():
    for camera in orbit(cloud(3, 1, 3), (64, 64), 10, seeded()):
        assert camera.center[1] < -2.0
        assert camera.viewmat[0, 1].abs() < 1e-9  # the image's x axis is level
        assert camera.viewmat[1, 1] > 0  # the image's y axis points down


def test_orbit_looks_from_all_sides_where_nothing_tells_the_vertical():
    cameras = orbit(cloud(1, 1, 1), (64, 64), 50, seeded())
    sides = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    assert (sides @ forwards(cameras).T).amax(1).min() > math.cos(math.radians(30))
    assert all(camera.viewmat[1, 1] > 0 for camera in cameras)  # y points down in pictures, as in most files
    assert all(lower.center[1] > higher.center[1] for higher, lower in pairwise(cameras))


def test_orbit_takes_a_vertical():
    assert all(camera.center[0] > 5.0 for camera in orbit(cloud(1, 1, 1), (64, 64), 10, seeded(), up=(2, 0, 0)))


def test_orbit_poses_are_rotations():
    rotations = poses(orbit(cloud(1, 1, 1), (64, 64), 5, seeded()))[:, :3, :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(5, dtype=torch.float64))


@pytest.mark.parametrize("views", [lambda seed: orbit(cloud(1, 1, 1), (64, 64), 6, seed), lambda seed: jittered(ring(), 6, seed)])
def test_views_are_the_same_only_for_the_same_seed(views):
    first, again, other = (poses(views(seeded(seed))) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_orbit_of_one_splat_sees_it():
    point = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    assert all(in_view(camera, point).all() for camera in orbit(point, (8, 8), 4, seeded()))


def shown(cameras: list[Camera], points: torch.Tensor) -> list[float]:
    """The share of `points` that each of `cameras` has in its picture."""
    return [camera.in_picture(camera.to_camera(points)).double().mean().item() for camera in cameras]


def statue(floaters: int = 0) -> torch.Tensor:
    """A wide pedestal of 4,000 splats, 800 of a thin figure on it, up to four times as high, and `floaters` splats far away."""
    pedestal, figure, around = torch.rand(4800 + floaters, 3, generator=seeded(), dtype=torch.float64).split([4000, 800, floaters])
    figure = figure * torch.tensor([0.2, 4.0, 0.2]) + torch.tensor([0.4, -4.0, 0.4])
    return torch.cat([pedestal, figure, 60 * around - 30])


def test_orbit_shows_an_object_by_itself_whole():
    assert frame(statue())[2]
    assert min(shown(orbit(statue(), (64, 64), 40, seeded()), statue())) > 0.99


def test_orbit_leaves_what_lies_far_away_out():
    center, radius, whole = frame(statue(floaters=300))
    assert not whole and radius < 4 and center.abs().max() < 1


def test_orbit_without_splats_is_refused():
    with pytest.raises(SettingsError, match="0 finite splats"):
        orbit(torch.full((3, 3), math.inf), (8, 8), 4, seeded())


@pytest.mark.parametrize(
    ("spread", "up"),
    [((3, 1, 3), (0, -1, 0)), ((1, 1, 1), None), ((1, 1, 3), None), ((1, 3, 0.5), None)],
    ids=["a wide scene", "a ball", "a tower", "a person who stands"],
)
def test_only_a_scene_flat_along_y_tells_its_vertical(spread, up):
    assert guess_up(cloud(*spread)) == up


# jittered


def straight(x: float = 0.0, turn: float = 0.0) -> Camera:
    """A camera at a place along x, which is turned about y by an angle."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[0, 3] = rotation_matrix(torch.tensor([0.0, turn, 0.0], dtype=torch.float64)), -x
    return Camera(8, 8, 8.0, 8.0, 4.0, 4.0, viewmat)


def on_a_line(*places: float) -> list[Camera]:
    return [straight(x) for x in places]


@pytest.mark.parametrize("vector", [(0.3, -0.8, 0.5), (0.0, 0.0, 0.0)])
def test_rotation_vector_and_matrix_are_inverse(vector):
    vector = torch.tensor(vector, dtype=torch.float64)
    torch.testing.assert_close(rotation_vector(rotation_matrix(vector)), vector)


def test_jittered_views_keep_the_lens_and_get_names_of_their_own():
    view = jittered(ring(), 8, seeded())[7]
    assert (view.size, view.fx, view.fy, view.cx) == (ring()[0].size, ring()[0].fx, ring()[0].fy, 40.0)
    assert (view.name, view.split) == ("jittered_0007", "train")


def test_jittered_views_stay_near_a_camera():
    centers = torch.stack([camera.center for camera in ring()])
    neighbor = torch.cdist(centers, centers).topk(5, largest=False).values.max()
    new = torch.stack([camera.center for camera in jittered(ring(), 100, seeded())])
    assert torch.cdist(new, centers).min(dim=1).values.max() < neighbor


def test_jittered_views_look_where_the_cameras_looked():
    cosine = (forwards(jittered(ring(), 100, seeded())) @ forwards(ring()).T).max(dim=1).values
    assert cosine.min() > math.cos(math.radians(25))


def test_jittered_views_see_the_scene():
    middle = torch.tensor([[5.0, -2.0, 1.0]], dtype=torch.float64)
    assert all(in_view(camera, middle).all() for camera in jittered(ring(), 100, seeded()))


def test_parallel_cameras_have_views_on_the_line_through_both_and_a_little_beyond():
    centers = torch.stack([view.center for view in jittered(on_a_line(0.0, 2.0), 50, seeded(), amount=0.0)])
    assert torch.equal(centers[:, 1:], torch.zeros(50, 2, dtype=torch.float64))
    assert centers[:, 0].min() >= -2 * BEYOND and centers[:, 0].max() <= 2 + 2 * BEYOND
    assert centers[:, 0].min() < 0 < 2 < centers[:, 0].max()


def standing(turn: float, *eye: float) -> Camera:
    """A camera at a place that is turned about y by an angle."""
    return replace(straight(), viewmat=viewmat_of(straight(turn=turn).viewmat[:3, :3].T, torch.tensor(eye, dtype=torch.float64)))


def test_cameras_whose_sights_meet_behind_one_of_them_have_views_on_the_line_through_both():
    """As those of one who walks on and turns: an arc around that point would be a detour."""
    views = jittered([standing(0.0, 0.0, 0.0, 0.0), standing(-0.5, 1.0, 0.0, 3.0)], 20, seeded(), amount=0.0)
    centers = torch.stack([view.center for view in views])
    torch.testing.assert_close(centers, centers[:, :1] * torch.tensor([1.0, 0.0, 3.0], dtype=torch.float64))


def test_between_a_near_camera_and_a_far_one_views_are_neither_near_nor_far():
    views = jittered([standing(0.0, 0.0, 0.0, -1.0), standing(0.5, 4 * math.sin(0.5), 0.0, -4 * math.cos(0.5))], 20, seeded(), amount=0.0)
    assert 5 <= sum(1.2 < view.center.norm() < 3.5 for view in views) < 20


def test_views_are_turned_by_a_part_of_their_own_field_of_view():
    wide, narrow = straight(), replace(straight(), fx=800.0, fy=800.0)
    turns = {8.0: [], 800.0: []}
    for view in jittered([wide, narrow], 40, seeded(), spread=False):
        turns[view.fx].append(rotation_vector(view.viewmat[:3, :3]).norm().item())
    assert min(turns[8.0]) > max(turns[800.0]) > 0


def test_cameras_around_something_have_views_as_far_from_it_as_they_are():
    focus = torch.linalg.lstsq(*sights(ring())).solution
    distances = torch.stack([(camera.center - focus).norm() for camera in ring()])
    new = torch.stack([(view.center - focus).norm() for view in jittered(ring(), 50, seeded(), amount=0.0)])
    torch.testing.assert_close(new, distances.mean().expand(50))


def sights(cameras: list[Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """The system whose solution is the point that all cameras look at."""
    across = [torch.eye(3, dtype=torch.float64) - torch.outer(c.viewmat[2, :3], c.viewmat[2, :3]) for c in cameras]
    return torch.cat(across), torch.cat([a @ c.center for a, c in zip(across, cameras, strict=True)])


def test_rotations_turn_by_part_of_the_angle_and_a_little_beyond():
    for view in jittered([straight(), straight(turn=0.5)], 10, seeded(), amount=0.0):
        x, y, z = rotation_vector(view.viewmat[:3, :3]).tolist()
        assert (x, z) == pytest.approx((0, 0), abs=1e-12)
        assert -0.5 * BEYOND <= y <= 0.5 * (1 + BEYOND)


def test_cameras_that_look_apart_are_not_mixed():
    views = jittered([straight(), straight(turn=math.pi)], 10, seeded(), amount=0.0)
    assert forwards(views)[:, 2].abs().min() > 1 - 1e-12


def test_the_widest_gap_between_cameras_is_filled_first():
    views = jittered(on_a_line(0.0, 0.1, 0.2, 0.3, 0.4, 1.5), 4, seeded(), amount=0.0)
    assert sum(0.6 < view.center[0] < 1.4 for view in views) >= 2


@pytest.mark.parametrize("far", [[100.0 + step for step in range(5)], [100.0]], ids=["another room", "a stray camera"])
def test_no_view_lies_between_two_parts_of_a_capture(far):
    views = jittered(on_a_line(*range(5), *far), 60, seeded(), amount=0.0)
    places = [float(view.center[0]) for view in views]
    assert any(place > 90 for place in places) or len(far) == 1  # a camera alone is the view from there
    assert not [place for place in places if 10 < place < 90]


def test_stations_have_views_between_them_though_cameras_of_one_place_differ_by_rounding():
    places = [x + 1e-9 * turn for x in (0.0, 1.0, 2.0) for turn in range(8)]
    views = jittered(on_a_line(*places), 60, seeded(), amount=0.0)
    assert [view for view in views if 0.2 < view.center[0] % 1 < 0.8]


def test_rigs_have_views_between_them():
    """The cameras of a rig lie a hundredth apart."""
    views = jittered(on_a_line(0.0, 0.01, 0.02, 5.0, 5.01, 5.02), 60, seeded(), amount=0.0)
    assert [view for view in views if 1 < view.center[0] < 4]


def test_views_are_spread_over_the_times_of_the_cameras_too():
    cameras = [replace(camera, time=float(n % 2)) for n, camera in enumerate(ring(12))]
    times = [view.time for view in jittered(cameras, 40, seeded())]
    assert 8 <= sum(times) <= 32


def test_views_around_thousands_of_cameras_need_no_number_for_each_pair(monkeypatch):
    """Of 10,000 cameras such tensors took 3 GB, and one of them to each candidate for 1000 views 1.3 GB."""
    cameras, before = ring(100), jittered(ring(100), 5, seeded())
    monkeypatch.setattr("mipmap_plugin.scenes.trajectories.BLOCK", 7)
    with Largest() as largest:
        views = jittered(cameras, 5, seeded())
    assert largest.numbers < 2000 < 5 * CANDIDATES * 100 and torch.equal(poses(views), poses(before))


def test_a_single_camera_is_rotated_in_place():
    only = ring()[:1]
    views = jittered(only, 5, seeded())
    torch.testing.assert_close(torch.stack([v.center for v in views]), only[0].center.expand(5, 3))
    assert not torch.equal(poses(views)[0], poses(views)[1])


@pytest.mark.parametrize("places", [1, 20])
def test_cameras_in_one_place_have_views_from_there(places):
    """Panoramas from a tripod, and rigs of several cameras; where the lines of sight meet is then the eye itself, up to rounding."""
    eyes = torch.tensor([[0.2, -0.3, 1.5]], dtype=torch.float64) + torch.arange(places, dtype=torch.float64)[:, None]
    cameras = []
    for number in range(24 * places):
        rotation = rotation_matrix(torch.tensor([0.1, 2 * math.pi * number / 24, 0.0], dtype=torch.float64))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eyes[number // 24]
        cameras.append(Camera(80, 60, 70.0, 70.0, 40.0, 30.0, pose))
    views = jittered(cameras, 50, seeded())
    assert len(views) == 50 and all(view.viewmat.isfinite().all() for view in views)
    if places == 1:
        assert all((view.center - eyes[0]).norm() < 1e-9 for view in views)
        directions = torch.stack([view.viewmat[2, :3] for view in views])
        assert torch.pdist(directions).min() > 0.01


def test_no_camera_is_refused():
    with pytest.raises(SettingsError, match="need cameras"):
        jittered([], 3, seeded())


@pytest.mark.parametrize("name", ["bases/lego_200", "flowers_r8"])
def test_views_around_real_cameras_keep_their_distance(shared_data, name):
    cameras = load_scene(shared_data / "checkpoints" / name).cameras
    old = torch.stack([camera.center for camera in cameras])
    new = torch.stack([camera.center for camera in jittered(cameras, 50, seeded())])
    radius = (old - old.mean(dim=0)).norm(dim=1)
    assert torch.cdist(new, old).min(dim=1).values.max() < 0.25 * radius.max()
