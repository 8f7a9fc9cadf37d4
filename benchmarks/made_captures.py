"""Captures made up of textured surfaces, one for each way in which people move a camera: every number follows from the capture's name.

Splats lie a little irregularly on parallelograms, with a thin axis along the normal; held-out views lie between those that are adapted to. What
a capture shows at its own scale is the truth, so that it needs no training. numpy only, from a seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from numpy.typing import ArrayLike
from scenes import quaternions

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.wrap import Wrapped

Array = np.ndarray
Paint = Callable[[Array, Array], Array]  # positions on a surface, each [N] in 0..1 -> colors [N, 3]

SIZE = (320, 240)  # px
SPACING = 0.55  # scale over the distance of neighbors
THICKNESS = 0.15  # of the axis along the normal
VIEW_DEPENDENCE = 0.02  # standard deviation of the SH coefficients of the first band


@dataclass(frozen=True)
class Capture:
    """Splats, and the cameras of their training; views that nothing is adapted to."""

    splats: Gaussians
    cameras: list[Camera]
    held_out: list[Camera]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def wrapped(self) -> Wrapped:
        return wrap_model(VanillaModel.from_gaussians(self.splats, TrainedScale(background=self.background)), cameras=self.cameras, threads=1)


class Builder:
    """Splats, surface by surface."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self._parts: list[Gaussians] = []

    def add(self, means: Array, scales: Array, rotations: Array, opacities: Array, colors: Array, view_dependence: float = VIEW_DEPENDENCE) -> None:
        """Splats of these means [N, 3], scales [N, 3], rotation matrices [N, 3, 3], opacities [N] and colors [N, 3]."""
        count = len(means)
        sh = np.zeros((count, 4, 3))
        sh[:, 0], sh[:, 1:] = (colors - 0.5) / C0, self.rng.normal(0, view_dependence, (count, 3, 3))
        arrays = (means, quaternions(rotations), scales, opacities, sh)
        self._parts.append(Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays)))

    def surface(self, corner: ArrayLike, u: ArrayLike, v: ArrayLike, count: int, paint: Paint, view_dependence: float = VIEW_DEPENDENCE) -> None:
        """Some `count` splats over the parallelogram corner + a · u + b · v."""
        corner, u, v = (np.asarray(each, dtype=float) for each in (corner, u, v))
        long, wide = np.linalg.norm(u), np.linalg.norm(v)
        columns = max(1, round(math.sqrt(count * long / wide)))
        rows = max(1, round(count / columns))
        a, b = (each.ravel() for each in np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows))
        a, b = (np.clip(each + self.rng.uniform(-0.5, 0.5, len(each)) / n, 0, 1) for each, n in ((a, columns), (b, rows)))
        normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        spacing, count = math.sqrt(long * wide / len(a)), len(a)
        means = corner + a[:, None] * u + b[:, None] * v + self.rng.normal(0, 0.05 * spacing, (count, 1)) * normal
        turn = self.rng.uniform(0, np.pi, (count, 1))
        first = np.cos(turn) * u / long + np.sin(turn) * np.cross(normal, u / long)
        rotations = np.stack([first, np.cross(normal, first), np.broadcast_to(normal, first.shape)], -1)
        scales = SPACING * spacing * self.rng.lognormal(0, 0.35, (count, 3)) * [1, 1, THICKNESS]
        colors = np.clip(paint(a, b) + self.rng.normal(0, 0.015, (count, 3)), 0, 1)
        self.add(means, scales, rotations, self.rng.beta(5, 1.2, count), colors, view_dependence)

    def box(self, low: ArrayLike, high: ArrayLike, count: int, paint: Paint) -> None:
        low, edges = np.asarray(low, dtype=float), np.diag(np.asarray(high, dtype=float) - np.asarray(low, dtype=float))
        for one, two, along in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            for corner in (low, low + edges[along]):
                self.surface(corner, edges[one], edges[two], count // 6, paint)

    def ball(self, radius: float, count: int, scale: float, color: Array) -> None:
        """`count` round splats around everything, as a sky."""
        directions = self.rng.normal(0, 1, (count, 3))
        means = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        turned = np.broadcast_to(np.eye(3), (count, 3, 3))
        self.add(means, np.full((count, 3), scale), turned, np.full(count, 0.9), np.broadcast_to(color, (count, 3)), view_dependence=0.002)

    def gaussians(self) -> Gaussians:
        return reduce(Gaussians.joined, self._parts)


def looking(eye: ArrayLike, target: ArrayLike, field_of_view: float = 60) -> Camera:
    """A camera at `eye` that looks at `target`; the horizontal field of view in degrees."""
    eye, forward = np.asarray(eye, dtype=float), np.asarray(target, dtype=float) - np.asarray(eye, dtype=float)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    width, height = SIZE
    focal = width / 2 / math.tan(math.radians(field_of_view) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2, torch.from_numpy(viewmat))


def checker(fields: float, light: ArrayLike = (0.9, 0.85, 0.8), dark: ArrayLike = (0.15, 0.2, 0.3)) -> Paint:
    return lambda a, b: np.where(((np.floor(a * fields) + np.floor(b * fields)) % 2 > 0)[:, None], light, dark)


def stripes(fields: float, light: ArrayLike = (0.95, 0.95, 0.95), dark: ArrayLike = (0.05, 0.05, 0.05)) -> Paint:
    return lambda a, b: np.where((np.floor(a * fields) % 2 > 0)[:, None], light, dark)


def cloudy(rng: np.random.Generator, color: ArrayLike, contrast: float = 0.25, octaves: int = 5) -> Paint:
    """Noise of several frequencies around a color."""
    waves = [(rng.normal(0, 3 * 2**octave, 2), rng.uniform(0, 2 * np.pi), rng.normal(0, 1, 3)) for octave in range(octaves) for _ in range(4)]

    def paint(a: Array, b: Array) -> Array:
        field = sum(np.sin(a * frequency[0] + b * frequency[1] + phase)[:, None] * tint for frequency, phase, tint in waves)
        return np.clip(np.asarray(color) + contrast * field / math.sqrt(len(waves)), 0, 1)

    return paint


def board() -> Capture:
    """A striped board on a plain wall, along which the camera moves: a tenth of the views show the board, the others nothing to speak of."""
    builder = Builder(1)
    builder.surface((-20, 4, -4), (40, 0, 0), (0, 0, 8), 6000, lambda a, b: np.stack([0.5 + 0.2 * a, 0.6 + 0.1 * b, 0.7 + 0 * a], 1), 0.002)
    builder.surface((-1.5, 3.6, -1), (3, 0, 0), (0, 0, 2), 6000, stripes(40))
    cameras = [looking((x, 0, 0), (x, 4, 0)) for x in np.linspace(-16, 16, 60)]
    return Capture(builder.gaussians(), cameras, [looking((x, 0, 0), (x, 4, 0)) for x in (-1.6, -1, -0.4, 0.4, 1.2, 1.7)])


def _object(builder: Builder) -> None:
    builder.box((-0.5, -0.5, 0), (0.5, 0.5, 0.7), 4000, checker(9, (0.9, 0.2, 0.1), (0.95, 0.9, 0.8)))
    builder.box((-0.2, -0.2, 0.7), (0.2, 0.2, 1.2), 2000, stripes(12))
    builder.surface((-1.2, -1.2, -0.02), (2.4, 0, 0), (0, 2.4, 0), 2000, cloudy(builder.rng, (0.5, 0.5, 0.5)))


def _around(number: float, count: int) -> Camera:
    turn, rise = 2 * np.pi * number / count, 0.25 + 0.5 * (number * 0.618 % 1)
    return looking(3 * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)]) + [0, 0, 0.2], (0, 0, 0.45), 45)


def sky() -> Capture:
    """An object, and five cameras of 53 that look past it at a plain sky."""
    builder = Builder(2)
    _object(builder)
    builder.ball(9, 300, 1.6, np.array([0.5, 0.6, 0.7]))
    away = [looking((3 * np.cos(t), 3 * np.sin(t), 0.8), (9 * np.cos(t + 0.4), 9 * np.sin(t + 0.4), 1.5)) for t in 1.48 * np.arange(5)]
    return Capture(builder.gaussians(), [_around(i, 48) for i in range(48)] + away, [_around(i + 0.43, 8) for i in range(8)])


def lenses() -> Capture:
    """An object, every second view through a lens of six times the focal length."""
    builder = Builder(3)
    _object(builder)
    views, held_out = [_around(i, 48) for i in range(48)], [_around(i + 0.43, 8) for i in range(8)]
    for some in (views, held_out):
        some[::2] = [replace(view, fx=6 * view.fx, fy=6 * view.fy) for view in some[::2]]
    return Capture(builder.gaussians(), views, held_out)


def _room(builder: Builder, corner: ArrayLike, count: int) -> None:
    """A room of 4 x 4 x 2.6 without a ceiling."""
    corner, rng = np.asarray(corner, dtype=float), builder.rng
    builder.surface(corner, (4, 0, 0), (0, 4, 0), count // 4, checker(10, rng.uniform(0.5, 1, 3), rng.uniform(0, 0.5, 3)))
    for number, (start, along) in enumerate((((0, 0, 0), (4, 0, 0)), ((0, 4, 0), (4, 0, 0)), ((0, 0, 0), (0, 4, 0)), ((4, 0, 0), (0, 4, 0)))):
        striped = stripes(24, rng.uniform(0.4, 1, 3), rng.uniform(0, 0.6, 3))
        paint = striped if number % 2 else cloudy(rng, rng.uniform(0.2, 0.8, 3))
        builder.surface(corner + start, along, (0, 0, 2.6), count // 5, paint)


def rooms() -> Capture:
    """Nine rooms, from the middle of which a camera looks at the walls: most views do not show most splats."""
    builder, cameras, held_out = Builder(4), [], []
    for number in range(9):
        corner = 4.2 * np.array([number // 3, number % 3, 0])
        _room(builder, corner, 3000)
        for turn, views in ((2 * np.pi * np.arange(14) / 14, cameras), (builder.rng.uniform(0, 2 * np.pi, 1), held_out)):
            for t in turn:
                eye = corner + np.array([2 + 0.7 * np.cos(t), 2 + 0.7 * np.sin(t), 1.4])
                views.append(looking(eye, eye + np.array([np.cos(t), np.sin(t), -0.15]), 70))
    return Capture(builder.gaussians(), cameras, held_out)


def panorama() -> Capture:
    """A room from a tripod: all cameras lie in one place."""
    builder = Builder(5)
    _room(builder, (0, 0, 0), 12_000)
    eye = np.array([2.2, 1.7, 1.5])

    def turned(t: float) -> Camera:
        return looking(eye, eye + np.array([np.cos(t), np.sin(t), 0.15 * np.sin(5 * t)]), 75)

    cameras, held_out = ([turned(2 * np.pi * (i + shift) / n) for i in range(n)] for n, shift in ((24, 0), (8, 0.43)))
    return Capture(builder.gaussians(), cameras, held_out)


def street() -> Capture:
    """A drive of 120 units: what is near in one view lies far away in the one before."""
    builder = Builder(6)
    line = lambda a, b: np.where((np.abs(b - 0.5) < 0.03)[:, None] & (np.floor(a * 80) % 2 > 0)[:, None], 0.95, 0.3) * np.ones(3)  # noqa: E731
    builder.surface((-2, -3, 0), (150, 0, 0), (0, 6, 0), 8000, line)
    for y in (-3, 3):
        wall = cloudy(builder.rng, (0.6, 0.5, 0.45), 0.2)
        windows = lambda a, b, wall=wall: np.where((a * 100 % 1 < 0.4)[:, None] & (b * 3 % 1 < 0.5)[:, None], (0.1, 0.12, 0.2), wall(20 * a, b))  # noqa: E731
        builder.surface((-2, y, 0), (150, 0, 0), (0, 0, 5), 8000, windows)
    drive = lambda x: looking((x, 0.3 * np.sin(x), 1.5), (x + 5, 0.2 * np.sin(0.7 * x), 1.3), 80)  # noqa: E731
    return Capture(builder.gaussians(), [drive(x) for x in np.linspace(0, 120, 150)], [drive(x) for x in np.linspace(0.4, 119, 8)])


def facing() -> Capture:
    """Three cameras side by side."""
    builder = Builder(7)
    builder.surface((-2, 3, -1.2), (4, 0, 0), (0, 3, 0), 3000, checker(16))
    builder.box((-0.9, 3.6, -1.2), (-0.2, 4.2, 0.1), 1800, cloudy(builder.rng, (0.7, 0.3, 0.2)))
    builder.box((0.2, 4.2, -1.2), (0.9, 4.8, 0.5), 1800, stripes(12))
    builder.surface((-20, 20, -12), (40, 0, 0), (0, 0, 24), 5400, cloudy(builder.rng, (0.5, 0.65, 0.8), 0.3, 6))
    places = lambda *eyes: [looking((x, y, z), (0.3 * x, 5, -0.3)) for x, y, z in eyes]  # noqa: E731
    held_out = places((-0.35, 0.05, 0.02), (-0.2, 0.05, 0.05), (0.15, 0.05, 0.06), (0.4, 0.05, 0))
    return Capture(builder.gaussians(), places((-0.5, 0, 0), (0, 0, 0.1), (0.5, 0, -0.05)), held_out)


def leaves() -> Capture:
    """Leaves on white, with holes between them."""
    builder, count = Builder(8), 30_000
    rng = builder.rng
    axes, _ = np.linalg.qr(rng.normal(0, 1, (count, 3, 3)))
    axes *= np.linalg.det(axes)[:, None, None]  # rotations, none of which mirrors
    scales = np.exp(rng.normal(-4.4, 0.35, (count, 1))) * [1, 0.5, 0.1]
    colors = np.clip(np.array([0.2, 0.45, 0.12]) * rng.uniform(0.4, 1.8, (count, 1)), 0, 1)
    builder.add(rng.normal(0, 0.5, (count, 3)) + np.array([0, 0, 1.2]), scales, axes, rng.beta(3, 1, count), colors)
    orbit = lambda t: looking((3 * np.cos(t), 3 * np.sin(t), 1.3 + 0.5 * np.sin(3 * t)), (0, 0, 1.1), 50)  # noqa: E731
    cameras, held_out = ([orbit(t) for t in 2 * np.pi * (np.arange(n) + shift) / n] for n, shift in ((48, 0), (8, 0.4)))
    return Capture(builder.gaussians(), cameras, held_out, (1.0, 1.0, 1.0))


CAPTURES: dict[str, Callable[[], Capture]] = {make.__name__: make for make in (board, sky, lenses, rooms, panorama, street, facing, leaves)}
