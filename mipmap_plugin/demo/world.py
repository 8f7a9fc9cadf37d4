"""A small ray-traced world whose true image is known at every resolution: thin, striped, fuzzy and shiny things on white.

The samples of a pixel are averaged as displayed (sRGB) values, so that the mean of 4 x 4 pixels of an image *is* the
pixel of the image a quarter the size: what an exact anti-aliased renderer of the same world would show.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.demo.geometry import Capsules, Hit, Slab, nothing
from mipmap_plugin.errors import SettingsError

RAYS_PER_CHUNK = 1 << 17
GAMMA = 2.2  # displayed = linear ** (1 / GAMMA)
LIFT = 1e-3  # world units: secondary rays start this far off the surface that they leave

TARGET = (0.0, 0.0, 0.33)  # what every camera looks at
ORBIT_RADIUS = 3.4
FIELD_OF_VIEW = math.radians(45)
ELEVATIONS = math.radians(10), math.radians(65)
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

SUN = torch.nn.functional.normalize(torch.tensor([0.72, -0.48, 0.9]), dim=0)
SUNLIGHT = torch.tensor([1.0, 0.94, 0.84]) * 0.78
SKYLIGHT = torch.tensor([0.43, 0.47, 0.54])  # from straight above
BOUNCE = torch.tensor([0.24, 0.21, 0.19])  # from straight below
ZENITH = torch.tensor([0.07, 0.24, 0.62])  # seen in the mirror ball only
HORIZON = torch.tensor([0.70, 0.80, 0.93])
GLINT = 350.0  # exponent of the sun's highlight: it spans a few degrees


def _rgb(code: str) -> Tensor:
    return torch.tensor([int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)]) ** GAMMA


def _rods(start: Tensor, end: Tensor, radius: float, colors: tuple[str, str], bands: int = 0, mirror: float = 0.0) -> Capsules:
    """K capsules from `start` to `end`, both [K, 3] and apart."""
    k, span = len(start), end - start
    length = span.norm(dim=1)
    a, b = (_rgb(color).expand(k, 3) for color in colors)
    return Capsules(start, span / length[:, None], length, torch.full((k,), radius), a, b, torch.full((k,), float(bands)), torch.full((k,), mirror))


def _ball(center: list[float], radius: float, colors: tuple[str, str], bands: int = 0, mirror: float = 0.0) -> Capsules:
    """A sphere, painted along a slightly tilted axis."""
    at = torch.tensor([center])
    ball = _rods(at, at + torch.tensor([[0.28, -0.2, 0.94]]), radius, colors, bands, mirror)
    return ball._replace(length=torch.zeros(1))


def _join(*parts: Capsules) -> Capsules:
    return Capsules(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _arc(first: float, last: float, count: int) -> Tensor:
    """[count, 3] points on the horizontal unit circle, angles in degrees."""
    angle = torch.deg2rad(torch.linspace(first, last, count))
    return torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], dim=1)


def _wheel() -> Capsules:
    """An upright bicycle wheel with crossed spokes."""
    center = torch.tensor([0.0, 0.08, 0.62])

    def upright(points: Tensor, radius: float) -> Tensor:
        return center + radius * points[:, [0, 2, 1]]

    ring, spokes = _arc(0, 360, 73), _arc(0, 345, 24)
    lean = torch.tensor([-0.05, 0.05]).repeat(12)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    hub = _rods(center[None] - torch.tensor([0.0, 0.07, 0.0]), center[None] + torch.tensor([0.0, 0.07, 0.0]), 0.05, ("E9A820", "E9A820"))
    return _join(
        _rods(upright(ring[:-1], 0.575), upright(ring[1:], 0.575), 0.044, ("26324A", "26324A")),
        _rods(upright(ring[:-1], 0.525), upright(ring[1:], 0.525), 0.016, ("E9A820", "E9A820")),
        _rods(upright(spokes, 0.03) + lean, upright(spokes, 0.53), 0.0085, ("E4572E", "E4572E")),
        hub,
    )


def _dandelion() -> Capsules:
    """A ball of thin hairs on a stem."""
    center, count = torch.tensor([[-0.66, 0.46, 0.55]]), 240
    index = torch.arange(count)
    z = 1 - (2 * index + 1) / count
    angle, flat = GOLDEN_ANGLE * index, (1 - z**2).sqrt()
    outward = torch.stack([flat * angle.cos(), flat * angle.sin(), z], dim=1)
    stem = _rods(center * torch.tensor([1.0, 1.0, 0.0]), center, 0.018, ("2E7D4F", "7CB342"))
    hairs = _rods(center + 0.08 * outward, center + 0.27 * outward, 0.0055, ("8E2A8C", "FFA6B5"))
    return _join(stem, _ball(center[0].tolist(), 0.09, ("5B1F70", "7B2D8B")), hairs)


def _fence() -> Capsules:
    """Thin bars along the platform's edge, between two rails."""
    posts, rail, up = _arc(5, 75, 33), _arc(5, 75, 17), torch.tensor([0.0, 0.0, 1.0])
    rails = [_rods(rail[:-1] + z * up, rail[1:] + z * up, 0.009, ("1D6FB8", "1D6FB8")) for z in (0.08, 0.36)]
    return _join(_rods(posts, posts + 0.43 * up, 0.0075, ("1D6FB8", "8FD3F4")), *rails)


@cache
def _solids() -> tuple[Slab | Capsules, ...]:
    slab = Slab(radius=1.15, thickness=0.09, tile=0.1, border=0.07, colors=torch.stack([_rgb("F5EBD8"), _rgb("1F7A7A"), _rgb("D9A441")]))
    striped = _ball([0.56, -0.5, 0.29], 0.29, ("D7263D", "FFF6E9"), bands=21)
    mirror = _ball([-0.42, -0.58, 0.31], 0.31, ("DDE4EE", "DDE4EE"), mirror=0.82)
    return slab, _wheel(), _dandelion(), _fence(), striped, mirror


def trace(origins: Tensor, directions: Tensor) -> Hit:
    """What N rays, [N, 3] float32 with unit directions, meet first."""
    best = nothing(directions)
    for solid in _solids():
        solid.hit(origins, directions, best)
    return best


def shade(points: Tensor, directions: Tensor, hit: Hit, bounces: int = 1) -> Tensor:
    """Linear RGB [N, 3] that leaves surface `points` against rays of `directions`; every ray has hit something."""
    lifted = points + LIFT * hit.normal
    facing = (hit.normal @ SUN).clamp(min=0)
    lit = facing.clone()
    sunny = (facing > 0).nonzero()[:, 0]
    lit[sunny] *= trace(lifted[sunny], SUN.expand(len(sunny), 3)).distance.isinf()
    ambient = torch.lerp(BOUNCE, SKYLIGHT, (hit.normal[:, 2:] + 1) / 2)
    color = hit.albedo * (ambient + lit[:, None] * SUNLIGHT)

    shiny = (hit.mirror > 0).nonzero()[:, 0] if bounces else ()
    if len(shiny):
        normal, cosine = hit.normal[shiny], -(directions[shiny] * hit.normal[shiny]).sum(1, keepdim=True)
        reflected = directions[shiny] + 2 * cosine * normal
        share = hit.mirror[shiny, None]
        share = share + (1 - share) * (1 - cosine.clamp(0, 1)) ** 5  # Schlick's Fresnel term
        color[shiny] = torch.lerp(color[shiny], _reflection(lifted[shiny], reflected), share)
    return color


def _reflection(origins: Tensor, directions: Tensor) -> Tensor:
    """Linear RGB that a mirror sees: the world, or else a sky with the sun in it."""
    hit = trace(origins, directions)
    sky = torch.lerp(HORIZON, ZENITH, directions[:, 2:].clamp(min=0) ** 0.7)
    sky = sky + 4 * (directions @ SUN).clamp(min=0)[:, None] ** GLINT
    met = hit.distance.isfinite().nonzero()[:, 0]
    hit = Hit(*(column[met] for column in hit))
    sky[met] = shade(origins[met] + directions[met] * hit.distance[:, None], directions[met], hit, bounces=0)
    return sky


def _radiance(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Displayed colors [N, 3], white where a ray meets nothing, and distances [N]."""
    hit = trace(origins, directions)
    met = hit.distance.isfinite().nonzero()[:, 0]
    seen = Hit(*(column[met] for column in hit))
    color = torch.ones_like(directions)
    points = origins[met] + directions[met] * seen.distance[:, None]
    color[met] = shade(points, directions[met], seen).clamp(0, 1) ** (1 / GAMMA)
    return color, hit.distance


def _rays(camera: Camera, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and unit directions, [N, 3] float32, through the pixel positions `x`, `y` [N] float64."""
    local = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=1)
    directions = torch.nn.functional.normalize(local @ camera.viewmat[:3, :3], dim=1)
    return camera.center.float().expand(len(x), 3), directions.float()


@torch.no_grad()
def render_world(camera: Camera, *, samples: int) -> Tensor:
    """The true image [H, W, 3], sRGB in 0..1 on white: a box filter over an n x n grid of `samples` = n² rays per pixel.

    Raises SettingsError where `samples` is not a square number.
    """
    n = math.isqrt(max(samples, 0))
    if n < 1 or n * n != samples:
        raise SettingsError(f"samples: {samples} rays do not fill a square grid inside a pixel; take 1, 4, 9, 16, ...")
    x = (torch.arange(camera.width * n, dtype=torch.float64) + 0.5) / n
    y = (torch.arange(camera.height * n, dtype=torch.float64) + 0.5) / n
    rows = max(1, RAYS_PER_CHUNK // (len(x) * n))
    image = []
    for band in y.split(rows * n):
        color, _ = _radiance(*_rays(camera, x.repeat(len(band)), band.repeat_interleave(len(x))))
        image.append(color.view(len(band) // n, n, camera.width, n, 3).mean(dim=(1, 3)))
    return torch.cat(image)


def cameras(size: int, count: int, split: Literal["train", "test"]) -> list[Camera]:
    """`count` square views of `size` px on a spiral around the world; "test" views lie between those of "train".

    Raises SettingsError where `split` is neither.
    """
    if split not in ("train", "test"):
        raise SettingsError(f"split: there is no {split!r}; take 'train' or 'test'")
    low, high = (math.sin(angle) for angle in ELEVATIONS)
    views = []
    for index in range(count):
        step = index + (0.25 if split == "train" else 0.75)
        elevation = math.asin(low + (high - low) * step / count)  # even in its sine: even on the sphere
        views.append(replace(orbit_camera(size, GOLDEN_ANGLE * step, elevation), name=f"{split}_{index:03d}", split=split))
    return views


def orbit_camera(size: int, azimuth: float = math.radians(-72), elevation: float = math.radians(22)) -> Camera:
    """A square view of `size` px from the orbit, angles in radians; by default the world's most telling side."""
    focal = size / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Camera(size, size, focal, focal, size / 2, size / 2, _looking_at_target(azimuth, elevation), "orbit", "test")


def _looking_at_target(azimuth: float, elevation: float) -> Tensor:
    """World-to-camera matrix [4, 4] of an eye on the orbit, angles in radians."""
    flat = math.cos(elevation)
    backward = torch.tensor([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)], dtype=torch.float64)
    right = torch.tensor([-math.sin(azimuth), math.cos(azimuth), 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(right, backward), -backward], dim=1)
    return viewmat_of(rotation, torch.tensor(TARGET, dtype=torch.float64) + ORBIT_RADIUS * backward)


@torch.no_grad()
def surface_points(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """`count` points [N, 3] on the surfaces that the training views see, and their displayed colors [N, 3] in 0..1."""
    views = cameras(size=1, count=64, split="train")
    points, colors, found = [], [], 0
    while found < count:
        rays = [_rays(view, *torch.rand(2, count // len(views) + 1, generator=generator, dtype=torch.float64)) for view in views]
        origins, directions = (torch.cat(part) for part in zip(*rays, strict=True))
        color, distance = _radiance(origins, directions)
        met = distance.isfinite()
        points.append((origins + directions * distance[:, None])[met])
        colors.append(color[met])
        found += int(met.sum())
    kept = torch.randperm(found, generator=generator)[:count]
    return torch.cat(points)[kept], torch.cat(colors)[kept]
