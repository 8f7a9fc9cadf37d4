"""Synthetic scenes for measuring: every number follows from the scene's name, so that machines and programs can be compared.

Splats lie on surfaces (a back wall, a ground plane, ellipsoids). Scales are log-normal about the local spacing, with a thin axis
along the normal; 3 % are 3-5 times larger, 10 % are turned at random; opacities are bimodal, as in trained models. Everything is in
front of the camera, 12 % of the centers are off screen, and about 44 splats reach alpha 1/255 at a pixel. numpy only, from a seed.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.random import Generator

from mipmap_plugin.camera import Camera
from mipmap_plugin.splatting.harmonics import C0

Name = Literal["A", "B", "C", "N1", "N10", "P1", "P10", "T"]


class Spec(NamedTuple):
    """What a scene's name stands for."""

    splats: int
    width: int  # px
    height: int  # px
    spread: float  # scale over local spacing, calibrated for the number of splats at a pixel


SPECS: dict[Name, Spec] = {
    "A": Spec(10_000, 256, 256, 0.47),
    "B": Spec(50_000, 400, 400, 0.44),
    "C": Spec(200_000, 800, 800, 0.47),
    "N1": Spec(20_000, 400, 400, 0.44),  # N10 has ten times as many splats in the same image
    "N10": Spec(200_000, 400, 400, 0.44),
    "P1": Spec(50_000, 253, 253, 0.44),  # P10 has ten times as many pixels of the same splats
    "P10": Spec(50_000, 800, 800, 0.44),
    "T": Spec(300, 64, 48, 0.6),  # tiny
}
SEED = 20240607

FOCAL = 0.9  # focal length over the longer side
OVERSHOOT = 1.15  # wall and ground reach this far over the image's edge
DEEPEST = 9.0  # world units, the wall's depth
ELLIPSOIDS = 14


class Scene(NamedTuple):
    """Raw parameters, float32 and in random order, and what to do with them."""

    raw: dict[str, np.ndarray]  # means [N, 3], log_scales [N, 3], quats [N, 4] wxyz of any norm, logits [N], sh [N, 16, 3]
    camera: Camera
    weights: np.ndarray  # [H, W, 3] float32, the gradient of the loss sum(image * weights)


class Surface(NamedTuple):
    """Points in camera space."""

    points: np.ndarray  # [N, 3]
    normals: np.ndarray  # [N, 3] of any length
    areas: np.ndarray  # [N] world units², each point's share of its surface


def make(name: Name) -> Scene:
    """The scene `name` of SPECS."""
    return make_to(SPECS[name])


def make_to(spec: Spec) -> Scene:
    rng = np.random.default_rng(SEED + spec.splats)
    camera = _camera(spec.width, spec.height)
    points, normals, areas = _surfaces(rng, spec.splats, 0.5 * spec.width / camera.fx, 0.5 * spec.height / camera.fy)
    scales = _scales(rng, areas, spec.spread)
    viewmat = camera.viewmat.numpy()
    quats = _orientations(rng, normals, viewmat[:3, :3])
    means = (points - viewmat[:3, 3]) @ viewmat[:3, :3]
    raw = dict(means=means, log_scales=np.log(scales), quats=quats, logits=_logits(rng, spec.splats), sh=_harmonics(rng, means))
    order = rng.permutation(spec.splats)  # no spatial order in memory
    weights = rng.standard_normal((spec.height, spec.width, 3)).astype(np.float32)
    return Scene({key: np.ascontiguousarray(array[order].astype(np.float32)) for key, array in raw.items()}, camera, weights)


def _camera(width: int, height: int) -> Camera:
    yaw, pitch, roll = np.deg2rad([20.0, -15.0, 5.0])
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = about_z @ about_x @ about_y
    viewmat[:3, 3] = [0.3, -0.2, 0.5]
    focal = FOCAL * max(width, height)
    return Camera(width, height, focal, focal, width / 2, height / 2, torch.from_numpy(viewmat.astype(np.float32)))


def _surfaces(rng: Generator, count: int, tan_x: float, tan_y: float) -> Surface:
    """All surfaces, with unit normals and a little noise along them. `tan_x`, `tan_y`: of half the field of view."""
    flat = int(0.18 * count)
    parts = [_wall(rng, flat, tan_x, tan_y), _ground(rng, flat, tan_x), *_ellipsoids(rng, count - 2 * flat, tan_x, tan_y)]
    points, normals, areas = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(points + normals * 0.01 * rng.standard_normal((count, 1)), normals, areas)


def _wall(rng: Generator, count: int, tan_x: float, tan_y: float) -> Surface:
    """Across the end of the view, wavy and a little tilted."""
    half_x, half_y = DEEPEST * tan_x * OVERSHOOT, DEEPEST * tan_y * OVERSHOOT
    xy = rng.uniform(-1, 1, (count, 2)) * [half_x, half_y]
    z = DEEPEST + 0.25 * np.sin(2 * xy[:, 0]) + 0.1 * xy[:, 1]
    normals = np.stack([-0.5 * np.cos(2 * xy[:, 0]), np.full(count, -0.1), np.ones(count)], 1)
    return Surface(np.c_[xy, z], normals, np.full(count, 4 * half_x * half_y / count))


def _ground(rng: Generator, count: int, tan_x: float) -> Surface:
    """Below the eye, from depth 2 to the wall."""
    z = rng.uniform(2.0, DEEPEST, count)
    x = rng.uniform(-OVERSHOOT, OVERSHOOT, count) * tan_x * DEEPEST
    y = np.full(count, 1.6) + 0.02 * rng.standard_normal(count)
    return Surface(np.c_[x, y, z], np.tile([0, -1.0, 0], (count, 1)), np.full(count, 7 * 2.3 * tan_x * DEEPEST / count))


def _ellipsoids(rng: Generator, count: int, tan_x: float, tan_y: float) -> list[Surface]:
    """Objects over the whole view; large and near ones get more splats."""
    radii = rng.uniform(0.25, 0.95, (ELLIPSOIDS, 1)) * rng.uniform(0.6, 1.4, (ELLIPSOIDS, 3))
    z = rng.uniform(2.6, 7.5, ELLIPSOIDS)
    xy = rng.uniform(-0.95, 0.95, (ELLIPSOIDS, 2)) * np.c_[z * tan_x, z * tan_y]
    a, b, c = radii.T
    areas = 4 * np.pi * (((a * b) ** 1.6 + (a * c) ** 1.6 + (b * c) ** 1.6) / 3) ** (1 / 1.6)  # Thomsen's approximation
    shares = areas**0.75 / z
    shares /= shares.sum()
    surfaces = []
    for i, n in enumerate(rng.multinomial(count, shares)):
        directions = rng.standard_normal((n, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        center = [xy[i, 0], xy[i, 1], max(z[i], radii[i, 2] + 1.0)]
        surfaces.append(Surface(directions * radii[i] + center, directions / radii[i], np.full(n, areas[i] / n)))
    return surfaces


def _scales(rng: Generator, areas: np.ndarray, spread: float) -> np.ndarray:
    """[N, 3] world units; the third axis lies along the normal."""
    count = len(areas)
    scales = spread * np.sqrt(areas)[:, None] * np.exp(rng.normal(0, 0.45, (count, 1))) * np.exp(rng.normal(0, 0.40, (count, 3)))
    big = rng.random(count) < 0.03
    scales[big] *= rng.uniform(3, 5, (big.sum(), 1))
    scales[:, 2] *= 0.15
    return scales


def _orientations(rng: Generator, normals: np.ndarray, world_to_camera: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] in the world, not normalized on purpose."""
    count = len(normals)
    first = rng.standard_normal((count, 3))
    first -= (first * normals).sum(1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first), normals], axis=2)
    quats = quaternions(world_to_camera.T @ axes)
    loose = rng.random(count) < 0.10
    quats[loose] = rng.standard_normal((loose.sum(), 4))
    return quats * np.exp(rng.normal(0, 0.2, (count, 1)))


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] -> unit quaternions wxyz [N, 4]."""
    m = np.moveaxis(rotations, 0, -1)
    trace = np.trace(rotations, axis1=1, axis2=2)
    squares = [1 + trace, 1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]]
    w, x, y, z = (np.sqrt(np.maximum(0, square)) / 2 for square in squares)
    signs = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    return np.stack([w, *(np.copysign(part, sign) for part, sign in zip((x, y, z), signs, strict=True))], 1)


def _logits(rng: Generator, count: int) -> np.ndarray:
    """Opacities [N] before the sigmoid: many faint ones, some opaque."""
    faint, opaque = rng.normal(-1.6, 1.1, count), rng.normal(2.2, 1.3, count)
    return np.where(rng.random(count) < 0.62, faint, opaque)


def _harmonics(rng: Generator, means: np.ndarray) -> np.ndarray:
    """SH of degree 3 [N, 16, 3]: a smooth field of color with noise, and small higher bands."""
    count = len(means)
    phases, frequencies = rng.uniform(0, 6.28, (3, 3)), rng.uniform(0.6, 2.2, (3, 3))
    field = np.stack([np.sin(means @ frequencies[c] + phases[c, 0]) for c in range(3)], 1)
    rgb = 0.5 + 0.33 * field + 0.07 * rng.standard_normal((count, 3))
    sh = np.zeros((count, 16, 3))
    sh[:, 0] = (np.clip(rgb, 0.02, 0.98) - 0.5) / C0
    sh[:, 1:4] = 0.08 * rng.standard_normal((count, 3, 3))
    sh[:, 4:9] = 0.05 * rng.standard_normal((count, 5, 3))
    sh[:, 9:] = 0.03 * rng.standard_normal((count, 7, 3))
    return sh
