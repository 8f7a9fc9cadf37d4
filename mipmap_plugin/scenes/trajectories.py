"""Generated views around the given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes.orbits import Orbit

# A generated view lies between a camera and one of its NEIGHBORS nearest ones, or beyond either of them by up to BEYOND of the way. With fewer
# neighbors, and nothing beyond, views fill the gaps between cameras poorly.
NEIGHBORS = 16
BEYOND = 0.25

# Cameras, or candidates, whose distances to all cameras are in memory at once: those of 10,000 to each other, and what is made of them, take 3 GB,
# and those of the candidates for 1000 views 1.3 GB.
BLOCK = 64

# Of a camera's neighbors, by distance, those after a gap are of another part of the capture, and nobody was on the way there. A gap is a distance GAP
# times as large as the one before it; among the first RIG neighbors, which may be the cameras of a rig, there is none.
GAP, RIG = 4.0, 4

# Cameras whose distance is a smaller fraction of that to another place are in the same place, but for rounding.
SAME_PLACE = 1e-6

# The relative rounding error of coordinates of splats and cameras, which checkpoints store in single precision.
ROUNDING = torch.finfo(torch.float32).eps

# Candidates per generated view: keeping those that fill gaps gains 0.5 dB on lego's test views at x1/8.
CANDIDATES = 16

# Of a capture with one kind of views, those that fill gaps best have 1.1 to 1.7 times the room (`_room`) of the median candidate (23 captures).
# Where some cameras are far away, or look past the scene, they have 2.3 and 3.3 times: sparse parts would get nearly all views.
MOST_ROOM = 2.0

# The sine of the angle between two lines of sight below which their intersection counts as undefined.
PARALLEL = 1e-6

# How far people move in front of a scene that a single camera saw, as a fraction of the distance to its middle. Files for x1/4 that are adapted to
# such views gain 4 to 10 dB when they are seen from there, and lose up to 0.7 dB at the camera's own place.
SWAY = 0.1

# Cameras whose directions differ more see different content, and views halfway between them look where no camera did.
SAME_DIRECTION = math.radians(60)


def jittered(
    cameras: Sequence[Camera], count: int, generator: torch.Generator, amount: float = 0.05, *, spread: bool = True
) -> list[Camera]:
    """`count` training views near the given cameras, looking in similar directions.

    Each has the intrinsics, size and time of one of `cameras`. It is interpolated at random toward a near camera that looks in a
    similar direction, or extrapolated a little (`BEYOND`): centers on an arc around the point that both look at, rotations on an
    arc. Then the center is moved by `amount` of the distance between the two, and the view rotated by `amount` of its field of
    view, one standard deviation each. `spread`: of `CANDIDATES` times as many views, those farthest from the cameras and from each other
    are kept, which fill gaps (`_spread`); otherwise they are as typical as the cameras. Raises SettingsError without cameras.
    """
    if not cameras or count < 0 or amount < 0:
        raise SettingsError(f"jittered views need cameras, but got {len(cameras)} cameras, count={count} and amount={amount}")
    centers = torch.stack([camera.center for camera in cameras])
    rotations = torch.stack([camera.viewmat[:3, :3].T for camera in cameras])  # camera to world
    fovs = centers.new_tensor([2 * math.atan(camera.width / (2 * camera.fx)) for camera in cameras])
    times = centers.new_tensor([camera.time or 0.0 for camera in cameras])
    tried = count * CANDIDATES if spread else count
    order = torch.cat([torch.randperm(len(cameras), generator=generator) for _ in range(tried // len(cameras) + 1)])
    index = order[:tried]
    pairs = torch.stack([index, _neighbors(centers, rotations, index, generator)])
    along = (1 + 2 * BEYOND) * torch.rand(len(index), 1, generator=generator, dtype=torch.float64) - BEYOND
    shift, turn = torch.randn((2, len(index), 3), generator=generator, dtype=torch.float64) * amount / math.sqrt(3)  # over three axes
    way = rotation_vector(rotations[pairs[0]].mT @ rotations[pairs[1]])
    turned = rotations[index] @ rotation_matrix(way * along) @ rotation_matrix(turn * fovs[index, None])
    gap = (centers[pairs[1]] - centers[pairs[0]]).norm(dim=1, keepdim=True)
    moved = _on_arc(centers[pairs], rotations[pairs][..., 2], along) + shift * gap
    far = list(range(count))
    if spread:
        far = _spread(_places(moved, turned, times[index], centers), _places(centers, rotations, times, centers), count)
    poses = [(cameras[int(index[i])], viewmat_of(turned[i], moved[i])) for i in far]
    return [replace(camera, viewmat=pose, name=f"jittered_{n:04d}", split="train") for n, (camera, pose) in enumerate(poses)]


def with_company(cameras: Sequence[Camera], orbit: Orbit) -> list[Camera]:
    """The cameras that `jittered` goes around: of a lone one also those a little (`SWAY`) to its left and right, above and below."""
    if len(cameras) != 1:
        return list(cameras)
    [camera] = cameras
    rotation, center = camera.viewmat[:3, :3], camera.center
    reach = SWAY * (center.new_tensor(orbit.center) - center).norm()
    ways = (rotation[0], -rotation[0], rotation[1], -rotation[1])  # right, left, down, up, in world coordinates
    return [camera, *(replace(camera, viewmat=viewmat_of(rotation.T, center + reach * way)) for way in ways)]


def rotation_vector(rotation: Tensor) -> Tensor:
    """Rotation vectors [..., 3], axis times angle (radians, below pi), of rotations [..., 3, 3]; the logarithm."""
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    angle = torch.acos(((trace - 1) / 2).clamp(-1, 1))
    skew = rotation - rotation.mT
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1) / (2 * torch.sinc(angle / math.pi))


def rotation_matrix(vector: Tensor) -> Tensor:
    """The rotations [..., 3, 3] by |vector| radians around `vector` [..., 3]; the exponential."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.unflatten(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1), -1, (3, 3))
    rotations: Tensor = torch.linalg.matrix_exp(cross)
    return rotations


def _on_arc(centers: Tensor, forwards: Tensor, along: Tensor) -> Tensor:
    """Points [V, 3] at fractions `along` [V, 1] (0..1, or beyond) of the arcs between eyes [2, V, 3] around the point that both look at.

    That point is where their lines of sight, in the directions `forwards` [2, V, 3], come closest. If it is not in front of both, or at
    one of them, the path is straight.
    """
    gap = centers[1] - centers[0]
    sights = torch.stack([forwards[0], -forwards[1]], dim=-1)
    depths = torch.linalg.lstsq(sights, gap[..., None], driver="gelsd").solution.movedim(-2, 0)
    parallel = torch.linalg.cross(forwards[0], forwards[1]).norm(dim=-1, keepdim=True) < PARALLEL
    focus = (centers + forwards * depths).mean(0)
    radii = (centers - focus).norm(dim=-1, keepdim=True)
    start, end = (centers - focus) / radii
    axis = torch.linalg.cross(start, end)
    angle = torch.atan2(axis.norm(dim=-1, keepdim=True), (start * end).sum(-1, keepdim=True))
    turn = rotation_matrix(axis / axis.norm(dim=-1, keepdim=True).clamp_min(PARALLEL) * angle * along)
    arc = focus + (turn @ start[..., None])[..., 0] * radii[0] ** (1 - along) * radii[1] ** along
    undefined = ~arc.isfinite().all(dim=-1, keepdim=True)  # both eyes are in one place, which is then what they look at
    return torch.where(parallel | (depths.amin(0) <= 0) | undefined, centers[0] + gap * along, arc)


def _neighbors(centers: Tensor, rotations: Tensor, index: Tensor, generator: torch.Generator) -> Tensor:
    """For each of `index` [V], a random one of the nearest cameras that look in a similar direction, [V]; itself if none does."""
    everyone = torch.arange(len(centers))
    reach = torch.cat([_reach(_distances(centers, rotations, rows)) for rows in everyone.split(BLOCK)])
    wanted, number = index.unique(return_inverse=True)
    found = []
    for rows in wanted.split(BLOCK):
        distances = _distances(centers, rotations, rows)
        distances[distances > torch.minimum(reach[rows, None], reach)] = math.inf
        found.append(distances.topk(min(NEIGHBORS, len(centers)), largest=False))
    known = torch.cat([distances.isfinite().sum(1) for distances, _ in found])[number]
    drawn = (torch.rand(len(index), generator=generator) * known).long()
    return torch.where(known > 0, torch.cat([nearest for _, nearest in found])[number, drawn], index)


def _distances(centers: Tensor, rotations: Tensor, rows: Tensor) -> Tensor:
    """From the cameras of the numbers `rows` [R] to all others, [R, C]; infinity to those that look elsewhere, and to themselves."""
    traces = rotations[rows].flatten(1) @ rotations.flatten(1).T  # of the rotation from one to the other, 1 + 2 cos(angle)
    # By differences: products of matrices round so much that cameras in one place would be apart.
    distances = torch.cdist(centers[rows], centers, compute_mode="donot_use_mm_for_euclid_dist")
    distances.masked_fill_(traces < 1 + 2 * math.cos(SAME_DIRECTION), math.inf)
    distances[torch.arange(len(rows)), rows] = math.inf
    return distances


def _reach(distances: Tensor) -> Tensor:
    """How far each camera's own part of the capture reaches: its distance [C] before the first `GAP`, of `distances` [C, C]; infinity without one."""
    near = distances.topk(min(NEIGHBORS, len(distances)), largest=False).values
    gaps = (near[:, 1:] > GAP * near[:, :-1]) & near[:, 1:].isfinite() & (near[:, :-1] > SAME_PLACE * near[:, 1:])
    gaps[:, : RIG - 1] = False
    before = torch.where(gaps, near[:, :-1], math.inf)
    reach: Tensor = torch.cat([before, torch.full_like(near[:, :1], math.inf)], 1).amin(1)
    return reach


def _places(centers: Tensor, rotations: Tensor, times: Tensor, around: Tensor) -> Tensor:
    """Features [V, 7] of views: position, in units of the size of the camera path `around` [C, 3], direction, and time."""
    size, middle = (around - around.mean(0)).norm(dim=1).max(), around.mean(0)
    rounding = ROUNDING * around.abs().max()  # of cameras in one place only directions tell
    return torch.cat([(centers - middle) / (size if size > rounding else 1.0), rotations[..., 2], times[:, None]], dim=1)


def _spread(places: Tensor, taken: Tensor, count: int) -> list[int]:
    """`count` rows of `places` [V, D], far from those `taken` [T, D] and from each other.

    Where that leaves hardly any in dense parts, such as close-ups (`MOST_ROOM`), distances are in units of room: views are as dense as places.
    """
    chosen = _farthest(places, taken, count, torch.ones_like(places[:, 0]))
    if not chosen:
        return chosen
    room = _room(places).clamp_min(SAME_PLACE)
    return chosen if room[chosen].median() <= MOST_ROOM * room.median() else _farthest(places, taken, count, room)


def _room(places: Tensor) -> Tensor:
    """The distance of each of `places` [V, D] to the `CANDIDATES`-th nearest of the others, or the farthest of fewer, [V]."""
    number = min(CANDIDATES + 1, len(places))
    return torch.cat([torch.cdist(some, places).topk(number, largest=False).values[:, -1] for some in places.split(BLOCK)])


def _farthest(places: Tensor, taken: Tensor, count: int, room: Tensor) -> list[int]:
    """`count` rows of `places` [V, D], each the farthest from those `taken` [T, D] and chosen so far (Gonzalez 1985), in units of its `room` [V]."""
    chosen: list[int] = []
    distance = torch.cat([torch.cdist(some, taken).amin(1) for some in places.split(BLOCK)])
    for _ in range(count):
        chosen.append(int((distance / room).argmax()))
        distance = torch.minimum(distance, (places - places[chosen[-1]]).norm(dim=1))
    return chosen
