"""Generated views: around the given cameras, or around the scene if there are none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians

ORBIT_FOV = math.radians(50)  # along the shorter side: a normal lens

# Elevations of an orbit's views, degrees: where the vertical is guessed, typical of handheld cameras; where somebody says it, what people look at
# an object from. From 10 to 50 there too, lego and chair at x1/4 gain 0.5 and 0.9 dB between 20 and 50, and lose 3.6 above and 1.5 below.
HANDHELD, ABOVE, ALL = (10.0, 50.0), (-10.0, 80.0), (-90.0, 90.0)

# Fraction of the splats that an orbit frames; the farthest tenth are mostly floaters and background.
FRAMED = 0.9

# Largest ratio of the extent along y to those along x and z at which y is assumed to be vertical.
FLATTER = 0.8

# What pictures have upwards where nothing tells the vertical: as in most files, whose y is down (COLMAP).
Y_DOWN = (0.0, -1.0, 0.0)

# What may be said to be up, by name.
AXES = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "-x": (-1.0, 0.0, 0.0), "-y": Y_DOWN, "-z": (0.0, 0.0, -1.0),
}  # fmt: skip

# Places at multiples of the golden ratio are spread evenly, however many there are.
GOLDEN = (math.sqrt(5) - 1) / 2

# A generated view lies between a camera and one of its NEIGHBORS nearest, or beyond either end by up to this fraction of the way. With 4
# neighbors and 0 beyond, views fill the gaps between cameras so poorly that lego's test views at x1/8 lose 0.8 dB.
NEIGHBORS = 16
BEYOND = 0.25

# Cameras beyond a gap of so many times the distance before it are of another part of the capture, where nobody was on the way; but for the first
# few, which may be those of a rig.
GAP, RIG = 4.0, 4

# Fraction of the distance to another place within which cameras are in one place but for rounding.
SAME_PLACE = 1e-6

# Of the coordinates of splats and cameras, which checkpoints store in single precision.
ROUNDING = torch.finfo(torch.float32).eps

# Candidates per generated view: keeping those that fill gaps gains 0.5 dB on lego's test views at x1/8.
CANDIDATES = 16

# Sine of the angle below which the intersection of two lines of sight is undefined.
PARALLEL = 1e-6

# How far people move before a scene that a lone camera saw, as a fraction of the distance to its middle. Files for x1/4 from one camera of lego,
# chair and flowers gain 4 to 10 dB so far to its side by such views (2 to 5 at half of that), and lose up to 0.7 at the camera's own place.
SWAY = 0.1

# Cameras whose directions differ more see different content, and views halfway between them look where no camera did.
SAME_DIRECTION = math.radians(60)


@dataclass(frozen=True)
class Orbit:
    """What an orbit goes around, in world units: `center`, the vertical `up` (None: not known), and how far away its cameras are.

    `said`: the user or the base's files say what is up; otherwise it is guessed from the splats (`guess_up`).
    """

    center: tuple[float, float, float]
    up: tuple[float, float, float] | None
    distance: float
    said: bool = False

    @classmethod
    def around(cls, means: Tensor, up: Sequence[float] | None = None) -> Orbit:
        """Around the median of `means` [N, 3], from a distance that frames nine tenths of them. `up` defaults to `guess_up`.

        Raises SettingsError without splats.
        """
        means = means.detach().to("cpu", torch.float64)
        means = means[means.isfinite().all(dim=1)]
        if len(means) == 0:
            raise SettingsError("an orbit needs splats, but got 0 finite splats")
        center = means.median(dim=0).values
        radius = _quantile((means - center).norm(dim=1), FRAMED).item()
        distance = max(radius / math.sin(ORBIT_FOV / 2), radius + 2 * NEAR_PLANE)  # a small scene must not lie in front of the near plane
        x, y, z = center.tolist()
        vertical = guess_up(means) if up is None else (up[0], up[1], up[2])
        return cls((x, y, z), vertical, distance)

    def told(self) -> str:
        """From where its views look, in words."""
        if self.up is None:
            return "from all around"
        name = next((name for name, axis in AXES.items() if axis == self.up), f"({', '.join(f'{part:.3g}' for part in self.up)})")
        return f"from above the horizon, with {name} up"

    def views(self, size: tuple[int, int], count: int, generator: torch.Generator) -> list[Camera]:
        """`count` views of `size` (height, width) px: from above the horizon, or from all around where no vertical is known (the highest first)."""
        if count < 1:
            raise SettingsError(f"an orbit needs views, but got {count}")
        center, vertical = (torch.tensor(vector, dtype=torch.float64) for vector in (self.center, self.up or Y_DOWN))
        vertical = vertical / vertical.norm()
        guessed = self.up is not None and not self.said
        elevations = HANDHELD if guessed else ABOVE if self.said else ALL
        directions = (_sky_directions if guessed else _spiral)(vertical, elevations, count, generator)
        return [_looking_at(center, center + self.distance * way, vertical, size, f"orbit_{i:04d}") for i, way in enumerate(directions)]


def orbit(
    means: Tensor | Gaussians, size: tuple[int, int], count: int, generator: torch.Generator, up: Sequence[float] | None = None
) -> list[Camera]:
    """`count` views of `size` (height, width) px around the scene, for a checkpoint without cameras (`Orbit`).

    Suitable for objects: the positions of the cameras of an unbounded scene do not follow from its splats. Raises SettingsError
    without splats or views.
    """
    return Orbit.around(means.means if isinstance(means, Gaussians) else means, up).views(size, count, generator)


def guess_up(means: Tensor) -> tuple[float, float, float] | None:
    """The likely vertical of the splats at `means` [N, 3]: -y (COLMAP) for a scene clearly flatter along y, as scenes are usually wider than high.

    None for any other: of single objects neither the shape nor the light tells what is up, and files have y down, y up and z up.
    """
    x, y, z = (_quantile(means, FRAMED) - _quantile(means, 1 - FRAMED)).tolist()
    return Y_DOWN if y < FLATTER * min(x, z) else None


def jittered(
    cameras: Sequence[Camera], count: int, generator: torch.Generator, amount: float = 0.05, *, spread: bool = True
) -> list[Camera]:
    """`count` training views near the given cameras, looking in similar directions.

    Each has the intrinsics, size and time of one of `cameras`. It is interpolated at random toward a near camera that looks in a
    similar direction, or extrapolated a little (`BEYOND`): centers on an arc around the point that both look at, rotations on an
    arc. Then the center is moved by `amount` of the distance between the two, and the view rotated by `amount` of its field of
    view, one standard deviation each. `spread`: of `CANDIDATES` times as many views, those farthest from the cameras and from each other
    are kept, which fill gaps; otherwise they are as typical as the cameras. Raises SettingsError without cameras.
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
        far = _farthest(_places(moved, turned, times[index], centers), _places(centers, rotations, times, centers), count)
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
    traces = rotations.flatten(1) @ rotations.flatten(1).T  # of the rotation from one to the other, 1 + 2 cos(angle)
    # By differences: products of matrices round so much that cameras in one place would be apart.
    distances = torch.cdist(centers, centers, compute_mode="donot_use_mm_for_euclid_dist")
    distances[(traces - 1) / 2 < math.cos(SAME_DIRECTION)] = math.inf
    distances.fill_diagonal_(math.inf)
    reach = _reach(distances)
    distances[distances > torch.minimum(reach[:, None], reach)] = math.inf
    distances, nearest = distances.topk(min(NEIGHBORS, len(centers)), largest=False)
    known = distances.isfinite().sum(1)[index]
    drawn = (torch.rand(len(index), generator=generator) * known).long()
    return torch.where(known > 0, nearest[index, drawn], index)


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


def _farthest(places: Tensor, taken: Tensor, count: int) -> list[int]:
    """`count` rows of `places` [V, D], each the farthest from those `taken` [T, D] and chosen so far (Gonzalez 1985)."""
    chosen: list[int] = []
    distance = torch.cdist(places, taken).amin(1)
    for _ in range(count):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (places - places[chosen[-1]]).norm(dim=1))
    return chosen


def _sky_directions(up: Tensor, elevations: tuple[float, float], count: int, generator: torch.Generator) -> Tensor:
    """Unit vectors [count, 3] at evenly spaced azimuths and random `elevations` (degrees) above the horizon whose normal is `up` (unit)."""
    start, chance = torch.rand((), generator=generator, dtype=up.dtype), torch.rand(count, 1, generator=generator, dtype=up.dtype)
    low, high = map(math.radians, elevations)
    return _directions(up, torch.arange(count, dtype=up.dtype)[:, None] / count + start, torch.sin(low + (high - low) * chance))


def _spiral(up: Tensor, elevations: tuple[float, float], count: int, generator: torch.Generator) -> Tensor:
    """Unit vectors [count, 3] evenly spread within `elevations` (degrees), on a spiral around `up` (unit) from the highest down."""
    start, chance = torch.rand((), generator=generator, dtype=up.dtype), torch.rand(count, 1, generator=generator, dtype=up.dtype)
    number = torch.arange(count, dtype=up.dtype)[:, None]
    low, high = (math.sin(math.radians(each)) for each in elevations)
    return _directions(up, number * GOLDEN + start, high - (high - low) * (number + chance) / count)


def _directions(up: Tensor, turns: Tensor, height: Tensor) -> Tensor:
    """Unit vectors [count, 3] after `turns` [count, 1] around `up` (unit), at `height` [count, 1] along it (-1 to 1)."""
    east: Tensor = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[up.abs().argmin()])
    east = east / east.norm()
    north: Tensor = torch.linalg.cross(up, east)
    azimuth = turns * 2 * math.pi
    return (1 - height**2).sqrt() * (azimuth.cos() * east + azimuth.sin() * north) + height * up


def _looking_at(target: Tensor, eye: Tensor, up: Tensor, size: tuple[int, int], name: str) -> Camera:
    """A camera at `eye` that looks at `target`, with `up` upwards. The columns of its rotation are right, down and forward."""
    forward = (target - eye) / (target - eye).norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    height, width = size
    focal = min(size) / (2 * math.tan(ORBIT_FOV / 2))
    return Camera(width, height, focal, focal, width / 2, height / 2, viewmat_of(rotation, eye), name)


def _quantile(values: Tensor, share: float) -> Tensor:
    """The value below which `share` of the first dimension lies. torch.quantile refuses more than 16 million values."""
    return values.kthvalue(max(1, round(share * len(values))), dim=0).values
