"""Views around a scene that came without cameras."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.scenes.photographed import GOLDEN, SEEN_OPACITY, photographed, quantile, seen_ways, sizes

ORBIT_FOV = math.radians(50)  # along the shorter side: a normal lens

# Elevations of an orbit's views, degrees. HANDHELD, where the vertical is guessed: those of handheld cameras. ABOVE, where somebody says what is up:
# those from which people look at an object. With HANDHELD there, too, lego and chair at x1/4 gain 0.5 and 0.9 dB in views from 20 to 50 degrees, but
# lose 3.6 dB in higher and 1.5 in lower ones.
HANDHELD, ABOVE, ALL = (10.0, 50.0), (-10.0, 80.0), (-90.0, 90.0)

# Fraction of the splats that an orbit frames; the farthest tenth are mostly floaters and background.
FRAMED = 0.9

# An object by itself has neither: WHOLE of its splats lie within TIGHT times the radius that frames FRAMED of them. For eleven objects, rendered or
# cut out of captures, the ratio is at most 1.3 (framed by FRAMED a guitar lost its head, a statue its upper half), for seven captures at least 1.5.
WHOLE, TIGHT = 0.995, 1.4

# From where a capture was photographed is guessed by its splats: in the photographs, the median size of those in its inner half that can be seen is
# about SHARP_PX (1.4 to 4.4 px in five captures). Half of an orbit's views are at the distance at which pictures of the focal length SHARP_FOCAL px
# show this size, the others at NEARER of it, but none is within the MIDDLE of the splats. Adapted to views that frame all splats, from up to 15 times
# as far away as the cameras, a bird and flowers look worse than their bases from where they were photographed.
INNER, SHARP_PX, NEARER, MIDDLE = 1 / 2, 2.0, 1 / 2, 1 / 4
SHARP_FOCAL = 400 / math.tan(ORBIT_FOV / 2)  # of pictures of 800 px

# The pixels of photographs are guessed by the smallest splats, so that those of blurred captures are told too large: in two 1.5 and 1.9 times. What
# is adapted to larger pixels than it is seen with looks worse than its base. So in every fifth view (EVERY) pixels are half as large (FINER).
FINER, EVERY = 2.0, 5

# What lies beside the middle of a capture is in few views of an orbit where walls leave only some of them clear, and its splats, which steps move as
# far as others, would look wrong to whoever turns there. So of the views in place of others half (BESIDE, of each four) are turned right or left, by
# half of TURN (radians) to all of it.
BESIDE, TURN = (1, 2), math.radians(40)

# So many splats, evenly chosen, tell whether a scene is small.
SAMPLE = 1 << 16

# Largest ratio of the extent along y to those along x and z at which y is assumed to be vertical.
FLATTER = 0.8

# What is compact is a capture all the same if its colors tell that it was photographed from less than this part of the distance that frames it. They
# tell 1 for two objects, 0.8 for one cut out of a capture, and 0.15 to 0.35 for captures whose background was cut off.
WITHIN = 1 / 2

# What pictures have upwards where nothing tells the vertical: as in most files, whose y is down (COLMAP).
Y_DOWN = (0.0, -1.0, 0.0)

# What may be said to be up, by name.
AXES = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "-x": (-1.0, 0.0, 0.0), "-y": Y_DOWN, "-z": (0.0, 0.0, -1.0),
}  # fmt: skip


@dataclass(frozen=True)
class Orbit:
    """What an orbit goes around, in world units: `center`, the vertical `up` (None: not known), and how far away its cameras are.

    `nearest`: how far half of them are, if that is not the same (0).
    `seen`: in which directions a capture was photographed, as its colors tell (`photographed`), and `focal`: with which focal length (px) from
    `nearest`. Without them ("", 0) all directions count, and pictures have the size that is asked for.
    `said`: the user or the base's files say what is up; otherwise it is guessed from the splats (`guess_up`).
    """

    center: tuple[float, float, float]
    up: tuple[float, float, float] | None
    distance: float
    said: bool = False
    nearest: float = 0.0
    seen: str = ""
    focal: float = 0.0

    @classmethod
    def around(cls, means: Tensor, sharp: Callable[[], float] = lambda: math.inf, near: float = NEAR_PLANE) -> Orbit:
        """Around `means` [N, 3], from a distance that frames them as `frame` says, with the vertical of `guess_up`.

        `sharp`: the size of sharp splats (`sharp_size`), of which a capture is seen from so near that they are about as large as pixels. `near`:
        the near plane, in world units. Raises SettingsError without splats.
        """
        means = _finite(means)
        center, radius, whole = frame(means)
        distance = max(radius / math.sin(ORBIT_FOV / 2), radius + 2 * near)  # a small scene must not lie in front of the near plane
        nearest = 0.0
        if not whole:
            from_here = sharp() / SHARP_PX * SHARP_FOCAL
            outside = max(quantile((means - center).norm(dim=1), MIDDLE).item(), 2 * near)
            distance, nearest = (min(distance, max(far, outside)) for far in (from_here, NEARER * from_here))
        x, y, z = center.tolist()
        return cls((x, y, z), guess_up(means), distance, nearest=nearest)

    def where_photographed(self, splats: Gaussians, near: float = NEAR_PLANE) -> Orbit:
        """The orbit from where the colors of the splats tell that a capture was photographed; the same if they do not tell, and around an object.

        What is compact, but was photographed from near or from within (`WITHIN`), is no object.
        """
        center = torch.tensor(self.center, dtype=torch.float64)
        away = (_finite(splats.means) - center).norm(dim=1)
        outside, framing = max(quantile(away, MIDDLE).item(), 2 * near), quantile(away, FRAMED).item() / math.sin(ORBIT_FOV / 2)
        found = photographed(splats, center, outside, max(outside, framing), ORBIT_FOV / 2)
        if found is None or (not self.nearest and found.nearest > WITHIN * framing):
            return self
        return replace(self, distance=found.farthest, nearest=found.nearest, seen=found.seen, focal=found.focal)

    def told(self) -> str:
        """From where its views look, in words."""
        around = "from above the horizon" if self.up else "from all around"
        where = "from where its colors tell that it was photographed" if self.seen else around
        if self.up is None or (self.seen and not self.said):
            return where
        name = next((name for name, axis in AXES.items() if axis == self.up), f"({', '.join(f'{part:.3g}' for part in self.up)})")
        return f"{where}, with {name} up"

    def views(self, size: tuple[int, int], count: int, generator: torch.Generator, first: int = 0, beside: bool = False) -> list[Camera]:
        """`count` views of `size` (height, width) px: from above the horizon, or from all around where no vertical is known (the highest first).

        `first`: the number of the first of them, in their names. `beside`: half of them look beside the center.
        """
        if count < 1:
            raise SettingsError(f"an orbit needs views, but got {count}")
        center, vertical = self._axes()
        directions = self._ways(vertical, count, generator)
        # Two far, two near: if all views of one part of the turn were near, these would be on one side only, and if every other view were, all of
        # them would be in the same half of the validation views.
        far = [self.distance if i // 2 % 2 == 0 else self.nearest or self.distance for i in range(count)]
        focals = [self.focal * each / (self.nearest or each) for each in far]  # so that all show the middle in the same detail
        eyes = [center + far[i] * way for i, way in enumerate(directions)]
        aims = [_beside(center, eye, vertical, generator) if beside and i % 4 in BESIDE else center for i, eye in enumerate(eyes)]
        views = [
            _looking_at(aim, eye, vertical, size, f"orbit_{first + i:04d}", focals[i]) for i, (aim, eye) in enumerate(zip(aims, eyes, strict=True))
        ]
        return [_part(view, generator) for view in views]

    def finer(self, view: Camera, size: tuple[int, int], generator: torch.Generator) -> Camera:
        """One of the `views` of a `size` (height, width) px, whose pixels are half as large."""
        center, vertical = self._axes()
        return _part(_looking_at(center, view.center.double(), vertical, size, view.name, FINER * view.fx), generator)

    def _axes(self) -> tuple[Tensor, Tensor]:
        """The center and the unit vector that pictures have upwards, [3] each."""
        center, vertical = (torch.tensor(vector, dtype=torch.float64) for vector in (self.center, self.up or Y_DOWN))
        return center, vertical / vertical.norm()

    def _ways(self, vertical: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """The directions of `count` cameras, unit vectors [count, 3], with `vertical` (unit) upwards."""
        if self.seen:
            return seen_ways(self.seen, count, generator)
        guessed = self.up is not None and not self.said
        elevations = HANDHELD if guessed else ABOVE if self.said else ALL
        return (_sky_directions if guessed else _spiral)(vertical, elevations, count, generator)


def frame(means: Tensor) -> tuple[Tensor, float, bool]:
    """What pictures of `means` [N, 3] show: a center [3], a radius (world units), and whether that is a whole object.

    An object by itself is shown whole, and of a capture the nine tenths of the splats around the median. Raises SettingsError without splats.
    """
    means = _finite(means)
    median, middle = means.median(dim=0).values, (quantile(means, WHOLE) + quantile(means, 1 - WHOLE)) / 2
    most, whole = (quantile((means - center).norm(dim=1), share).item() for center, share in ((median, FRAMED), (middle, WHOLE)))
    return (middle, whole, True) if whole <= TIGHT * most else (median, most, False)


def radius_if_small(means: Tensor, near: float) -> float:
    """What pictures of `means` [N, 3] show (`frame`), if a near plane at `near` keeps views from framing it, in world units; 0 if not."""
    means = means[means.isfinite().all(dim=1)]
    radius = frame(means[:: 1 + len(means) // SAMPLE])[1] if len(means) else 0.0
    return radius if radius / math.sin(ORBIT_FOV / 2) < radius + 2 * near else 0.0


def sharp_size(gaussians: Gaussians) -> float:
    """The median size (`sizes`), in world units, of the visible splats in the inner half of a scene, since splats farther out are larger.

    Infinite if no splat is visible, or if the splats have covariances instead of scales.
    """
    seen = (gaussians.opacities >= SEEN_OPACITY) & gaussians.scales.isfinite().all(dim=1) & gaussians.means.isfinite().all(dim=1)
    if gaussians.covariances is not None or not seen.any():
        return math.inf
    away = (gaussians.means[seen] - gaussians.means[seen].median(dim=0).values).norm(dim=1)
    inner = away <= quantile(away, INNER)
    return float(sizes(gaussians.detach())[seen][inner].median())


def guess_up(means: Tensor) -> tuple[float, float, float] | None:
    """The likely vertical of the splats at `means` [N, 3]: -y (COLMAP) for a scene clearly flatter along y, as scenes are usually wider than high.

    None for any other: of single objects neither the shape nor the light tells what is up, and files have y down, y up and z up.
    """
    x, y, z = (quantile(means, FRAMED) - quantile(means, 1 - FRAMED)).tolist()
    return Y_DOWN if y < FLATTER * min(x, z) else None


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


def _beside(target: Tensor, eye: Tensor, up: Tensor, generator: torch.Generator) -> Tensor:
    """What an eye sees as far away as `target` that turns right or left by half of TURN to TURN."""
    forward, (side, more) = target - eye, torch.rand(2, generator=generator, dtype=target.dtype).tolist()
    right = torch.linalg.cross(forward, up)
    angle = math.copysign(TURN * (1 + more) / 2, side - 0.5)
    turned: Tensor = eye + math.cos(angle) * forward + math.sin(angle) * forward.norm() / right.norm() * right
    return turned


def _looking_at(target: Tensor, eye: Tensor, up: Tensor, size: tuple[int, int], name: str, focal: float = 0.0) -> Camera:
    """A camera at `eye` that looks at `target`, with `up` upwards. The columns of its rotation are right, down and forward.

    `focal`, px: 0 for that with which a picture of this `size` shows `ORBIT_FOV`. A picture that would show more is smaller.
    """
    forward = (target - eye) / (target - eye).norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    usual = min(size) / (2 * math.tan(ORBIT_FOV / 2))
    focal = focal or usual
    height, width = (max(1, round(side * min(1.0, focal / usual))) for side in size)
    return Camera(width, height, focal, focal, width / 2, height / 2, viewmat_of(rotation, eye), name)


def _part(view: Camera, generator: torch.Generator) -> Camera:
    """A view that shows less than `ORBIT_FOV`, moved to anywhere in one that shows so much; any other as it is.

    If all views showed the middle alone, splats beside it would be adapted to nothing: with pictures of a quarter of that width, flowers at x1/4 lose
    up to 2.9 dB in a view from where they were photographed, and gain 0.3 at least with pictures from anywhere in it.
    """
    whole = 2 * math.tan(ORBIT_FOV / 2) * view.fx / min(view.size)
    width, height = (int(side * (whole - 1)) for side in (view.width, view.height))
    if max(width, height) <= 0:
        return view
    right, down = (torch.rand(2, generator=generator, dtype=torch.float64) - 0.5).tolist()
    return replace(view, cx=view.cx + right * width, cy=view.cy + down * height)


def _finite(means: Tensor) -> Tensor:
    """The finite ones of `means` [N, 3], as float64 on the CPU. Raises SettingsError if there are none."""
    means = means.detach().to("cpu", torch.float64)
    means = means[means.isfinite().all(dim=1)]
    if len(means) == 0:
        raise SettingsError("an orbit needs splats, but got 0 finite splats")
    return means
