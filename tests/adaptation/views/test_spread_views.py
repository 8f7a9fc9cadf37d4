"""Views around cameras of which some stand close together: every part of a capture has its share of them."""

import math

import torch

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.scenes import jittered, trajectories


def looking_in(radius: float, turn: float, count: int) -> list[Camera]:
    """Cameras on a circle, all of which look at its middle."""
    cameras = []
    for number in range(count):
        angle = turn + 2 * math.pi * number / count
        forward = torch.tensor([-math.cos(angle), 0.0, -math.sin(angle)], dtype=torch.float64)
        down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        rotation = torch.stack([torch.linalg.cross(down, forward), down, forward], 1)
        cameras.append(Camera(80, 60, 70.0, 70.0, 40.0, 30.0, viewmat_of(rotation, -radius * forward)))
    return cameras


def distances(cameras: list[Camera]) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.stack([view.center.norm() for view in jittered(cameras, 120, generator)])


def test_close_ups_have_their_share_of_the_views_beside_overviews():
    """Of the most distant candidates alone none is a close-up, though half of the cameras are."""
    far = distances([*looking_in(1.0, 0.0, 30), *looking_in(4.0, 0.05, 16), *looking_in(8.0, 0.1, 16)])
    assert (far < 1.5).float().mean() > 0.2


def test_views_of_a_capture_with_one_kind_of_views_fill_gaps_wherever_these_are(monkeypatch):
    found = distances(looking_in(4.0, 0.0, 30))
    monkeypatch.setattr(trajectories, "MOST_ROOM", math.inf)
    assert torch.equal(found, distances(looking_in(4.0, 0.0, 30)))


def test_candidates_in_one_place_do_not_take_all_views():
    """They have no room, by which nothing can be divided."""
    [near], far = looking_in(1.0, 0.0, 1), looking_in(8.0, 0.1, 10)
    found = jittered([near] * 40 + far, 20, torch.Generator().manual_seed(0), amount=0.0)
    assert sum(torch.allclose(view.viewmat, near.viewmat) for view in found) < 2
