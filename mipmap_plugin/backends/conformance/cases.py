"""The table of hard cases: name -> function that builds Gaussians in float64, a camera and effects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, EvenBuckets, RenderSettings
from mipmap_plugin.screen_filters import DILATION, USUAL_EPS2D
from mipmap_plugin.splatting.projection import covariances_of
from mipmap_plugin.splatting.rotations import rotations
from mipmap_plugin.splatting.viewers import BUILT_IN, Viewer

NEAR = 0.25  # world units; unlike 0.2 exact in float32, so that "on the near plane" is unambiguous


class HardCase(NamedTuple):
    """A scene for a backend to render."""

    gaussians: Gaussians  # float64
    camera: Camera
    effects: Effects
    about_degree: bool = False  # whether it is about the degree of SH, so that it tells nothing of a backend that evaluates a lower one


Builder = Callable[[], HardCase]


def view(width: int = 24, height: int = 18, *, cx: float | None = None, cy: float | None = None, turned: bool = False) -> Camera:
    """A camera at the origin that looks along +z, with fx != fy. Unless `turned`, a splat's depth equals its z exactly."""
    viewmat = torch.eye(4, dtype=torch.float64)
    if turned:
        viewmat[:3, :3] = rotations(torch.tensor([[1.0, 0.03, -0.06, 0.1]], dtype=torch.float64))[0]
        viewmat[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return Camera(width, height, 27.0, 25.0, width / 2 if cx is None else cx, height / 2 if cy is None else cy, viewmat)


def crowd(n: int = 12, degree: int = 1, seed: int = 0) -> Gaussians:
    """Ordinary splats in front of `view()`, a few outside its image; faint to nearly opaque, no two axes of the same length."""
    rng = torch.Generator().manual_seed(seed)
    rand = partial(torch.rand, generator=rng, dtype=torch.float64)
    means = (rand(n, 3) - 0.5) * torch.tensor([3.0, 2.4, 3.0]) + torch.tensor([0.0, 0.0, 3.0])
    scales = 0.02 + 0.3 * rand(n, 3) ** 2
    return Gaussians(means, rand(n, 4) - 0.5, scales, 0.05 + 0.9 * rand(n), rand(n, (degree + 1) ** 2, 3) - 0.3)


def odd_row(row: dict[str, Tensor], screen_filter: str = "classic") -> HardCase:
    """A crowd in which the values `row` make one splat hard; the others show whether it harms them."""
    gaussians = _with_row(crowd(), 5, {**_row(means=(0.1, 0.05, 2.5)), **row})
    return HardCase(gaussians, view(), Effects(1, screen_filter, USUAL_EPS2D[screen_filter], near_plane=NEAR))


def seen_by(camera: Camera, screen_filter: str = "classic") -> HardCase:
    """A crowd in front of `camera`."""
    return HardCase(crowd(), camera, Effects(1, screen_filter, background=(0.2, 0.5, 0.9)))


def of_degree(degree: int, evaluated: int) -> HardCase:
    """Coefficients of SH `degree`, of which the bands up to `evaluated` are rendered."""
    return HardCase(crowd(degree=degree), view(turned=True), Effects(evaluated), about_degree=True)


def random_scene(seed: int, screen_filter: str, eps2d: float) -> HardCase:
    """120 ordinary splats on white."""
    return HardCase(crowd(120, 3, seed), view(40, 32, turned=True), Effects(3, screen_filter, eps2d, (1.0, 1.0, 1.0)))


def seen_in(viewer: Viewer, seed: int) -> HardCase:
    """Splats from a twentieth of a pixel to several pixels, so that each of a viewer's rules applies to some and not to others.

    The image is not rounded: in another precision some values would be rounded the other way, and pixels would differ by a step.
    """
    gaussians = crowd(120, 3, seed)
    sizes = 0.02 + 0.4 * torch.rand(120, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2
    gaussians = replace(gaussians, scales=gaussians.scales * sizes)
    return HardCase(gaussians, view(40, 32, turned=True), _unrounded(viewer.effects(Effects(3, background=(1.0, 1.0, 1.0)))))


def odd_row_seen_in(viewer: Viewer, row: dict[str, Tensor]) -> HardCase:
    """`odd_row` in a viewer."""
    case = odd_row(row)
    return case._replace(effects=_unrounded(viewer.effects(case.effects)))


def _unrounded(effects: Effects) -> Effects:
    return replace(effects, settings=replace(effects.settings, picture_step=None))


def in_a_rounded_picture() -> HardCase:
    """A crowd in an image that is rounded to 8 bits after each splat."""
    settings = RenderSettings(picture_step=1 / 255, min_alpha=0.5 / 255, max_alpha=0.999, min_transmittance=1e-6)
    return HardCase(crowd(), view(), Effects(1, background=(0.2, 0.5, 0.9), settings=settings))


def ruled(rule: RenderSettings) -> HardCase:
    """A single rule, strict enough that it affects many splats."""
    case = random_scene(1, "classic", DILATION)
    return case._replace(effects=replace(case.effects, settings=rule))


def in_buckets(settings: RenderSettings, depth: float) -> HardCase:
    """A splat behind the camera, so large or so far that the depths of all others share few buckets."""
    case = ruled(settings)
    return case._replace(gaussians=_with_row(case.gaussians, 0, _row(means=(0.0, 0.0, depth), scales=1e3)))


def with_covariances(screen_filter: str, broken: bool = False) -> HardCase:
    """A crowd with covariances in place of quaternions and scales. `broken`: one of them contains NaN."""
    gaussians = crowd()
    matrices = covariances_of(gaussians)
    if broken:
        matrices[5, 0, 0] = math.nan
    return HardCase(replace(gaussians, covariances=matrices), view(turned=True), Effects(1, screen_filter, USUAL_EPS2D[screen_filter]))


def none_drawn(n: int) -> HardCase:
    """No splats, or only splats behind the camera: the background, with a gradient of 0."""
    gaussians = crowd(max(n, 1))
    return HardCase(replace(gaussians, means=-gaussians.means)[torch.arange(n)], view(), Effects(1, background=(1.0, 1.0, 1.0)))


def rows_of_the_crowd(rows: list[int]) -> HardCase:
    """The splats `rows` of a crowd."""
    return HardCase(crowd()[torch.tensor(rows)], view(), Effects(1))


def at_one_depth() -> HardCase:
    """Ties in depth: the splat with the lower index is in front."""
    gaussians = crowd(10_000)
    gaussians.means[:, 2] = 3
    return HardCase(replace(gaussians, scales=gaussians.scales / 4), view(), Effects(1))


def in_one_pixel() -> HardCase:
    """Tiny opaque splats, one behind the other, all in the same pixel."""
    n = 10_000
    gaussians = crowd(n)
    camera = view(16, 16)
    depths = 1 + torch.arange(n, dtype=torch.float64) / n
    inside = gaussians.means[:, :2] / torch.tensor([3.0, 2.4]) + 0.5  # px, 0..1 from the corner of pixel (8, 8)
    means = torch.stack([inside[:, 0] / camera.fx * depths, inside[:, 1] / camera.fy * depths, depths], -1)
    specks = replace(gaussians, means=means, scales=gaussians.scales / 100, opacities=torch.ones_like(gaussians.opacities))
    return HardCase(specks, camera, Effects(1))


def far_from_the_origin(shift: float = 1e6, size: float = 64.0) -> HardCase:
    """A scene so far from the origin that float32 resolves only 1/16 unit: the eye must be subtracted before any other operation."""
    gaussians, camera = crowd(), view(turned=True)
    eye = torch.full((3,), shift, dtype=torch.float64)
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    gaussians = replace(gaussians, means=gaussians.means * size + eye, scales=gaussians.scales * size)
    return HardCase(gaussians, camera.looking_from(viewmat, ""), Effects(1))


def long_lens(seed: int, screen_filter: str) -> HardCase:
    """One splat through a telephoto lens, 10 to 10,000 px long along each of its axes, so that it hardly varies over the image."""
    rng, focal = torch.Generator().manual_seed(seed), 171_310.0  # px
    rand = partial(torch.rand, generator=rng, dtype=torch.float64)
    camera = replace(view(), fx=focal, fy=0.9 * focal)
    pixel = 3 / focal
    means = torch.cat([(rand(1, 2) - 0.5) * 18 * pixel, torch.full((1, 1), 3.0)], 1)
    splat = Gaussians(means, rand(1, 4) - 0.5, 10 ** (1 + 3 * rand(1, 3)) * pixel, 0.3 + 0.5 * rand(1), rand(1, 4, 3) - 0.3)
    return HardCase(splat, camera, Effects(1, screen_filter, USUAL_EPS2D[screen_filter]))


def _row(**values: tuple[float, ...] | float) -> dict[str, Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


def _with_row(gaussians: Gaussians, index: int, row: dict[str, Tensor]) -> Gaussians:
    """The splats, of which one has other values."""
    return replace(gaussians, **{name: getattr(gaussians, name).index_put((torch.tensor(index),), value) for name, value in row.items()})


TURN = (0.8, 0.1, -0.3, 0.5)  # an ordinary quaternion, almost of norm 1
WIDE = (0.9, 0.7, 0.5)  # large enough that an opaque splat's alpha is clamped at 0.99 on many pixels around its center

# Values of one splat in a crowd. The near plane is NEAR, the eye is the origin.
ROWS = {
    "on-the-near-plane": _row(means=(0.02, 0.01, NEAR), scales=(0.05, 0.04, 0.03)),
    "just-in-front-of-the-near-plane": _row(means=(0.02, 0.01, NEAR + 1e-6), scales=(0.05, 0.04, 0.03)),
    "just-behind-the-near-plane": _row(means=(0.02, 0.01, NEAR - 1e-6), scales=(0.05, 0.04, 0.03)),
    "straddling-the-near-plane": _row(means=(0.1, 0.1, 0.4), scales=(0.2, 0.3, 0.4)),
    "behind-the-camera": _row(means=(0.1, 0.1, -2.0), scales=(0.5, 0.4, 0.3)),
    "camera-inside-the-splat": _row(means=(0.05, -0.1, 0.3), scales=(2.0, 1.5, 1.0)),
    "in-the-eye": _row(means=(0.0, 0.0, 0.0)),
    "center-off-screen-body-on": _row(means=(-1.9, 0.1, 3.0), scales=(0.6, 0.3, 0.2)),
    "center-beyond-the-frustum-body-on": _row(means=(4.0, 2.5, 3.0), scales=(1.9, 1.4, 1.2)),
    "1e25-units-aside": _row(means=(1e25, 0.05, 2.5)),  # overflows integers
    "1e6-units-ahead": _row(means=(3e4, 2e4, 1e6), scales=(1e5, 7e4, 5e4)),
    "scale-0-on-one-axis": _row(scales=(0.3, 0.2, 0.0)),
    "scale-0-on-two-axes": _row(scales=(0.3, 0.0, 0.0)),
    "scale-0-on-three-axes": _row(scales=(0.0, 0.0, 0.0)),
    "scale-1e-9": _row(scales=(1e-9, 2e-9, 3e-9)),
    "scale-1e-20": _row(scales=(1e-20, 2e-20, 3e-20)),
    "scale-1e-20-on-two-axes": _row(scales=(0.3, 1e-20, 2e-20)),
    "scale-1e4": _row(scales=(1e4, 2e4, 3e4)),
    "needle-1e12": _row(scales=(1e3, 1e-3, 2e-3), quats=TURN),
    "disc-1e12": _row(scales=(1e3, 2e3, 1e-3), quats=TURN),
    "quaternion-0": _row(quats=(0.0, 0.0, 0.0, 0.0)),
    "quaternion-norm-1e-35": _row(quats=tuple(1e-35 * q for q in TURN)),
    "quaternion-norm-1e-15": _row(quats=tuple(1e-15 * q for q in TURN)),
    "quaternion-norm-1e-3": _row(quats=tuple(1e-3 * q for q in TURN)),
    "quaternion-norm-1e3": _row(quats=tuple(1e3 * q for q in TURN)),
    "quaternion-norm-1e25": _row(quats=tuple(1e25 * q for q in TURN)),
    "opacity-0": _row(opacities=0.0),
    "opacity-1": _row(opacities=1.0, scales=WIDE),
    "opacity-1-1e-7": _row(opacities=1 - 1e-7, scales=WIDE),
    "opacity-logit-80": _row(opacities=1 / (1 + math.exp(-80)), scales=WIDE),
    "opacity-logit--80": _row(opacities=1 / (1 + math.exp(80))),
    "negative-color": _row(sh=-1e3),
    "saturated-color": _row(sh=1e3),
}
# Those of ROWS that are rendered in viewers too.
ODD_IN_VIEWERS = ("scale-0-on-one-axis", "scale-0-on-three-axes", "scale-1e4", "needle-1e12", "quaternion-0", "opacity-0", "opacity-1")
CAMERAS = {
    "image-1x1": view(1, 1),
    "image-1xN": view(1, 37),
    "image-Nx1": view(37, 1),
    "image-of-whole-tiles": view(32, 16),
    "image-not-of-whole-tiles": view(33, 17),
    "zoom-0.37": view().zoomed(0.37),
    "zoom-1/64": view().zoomed(1 / 64),
    "zoom-64": view().resized(4, 3).zoomed(64),
    "principal-point-outside": view(cx=-9.0),
    "principal-point-off-center": view(cx=10.0, cy=12.0),
}
BAD = (math.nan, math.inf)
FIELDS = ("means", "quats", "scales", "opacities", "sh")
FILTERS = tuple(USUAL_EPS2D)

WITH_SETTINGS = tuple(viewer for viewer in BUILT_IN if viewer.settings != USUAL)
RULES = {
    "radius": RenderSettings(radius=2.0),
    "faint-and-transparent": RenderSettings(min_alpha=0.02, min_transmittance=0.1, max_alpha=0.8),
    "fading": RenderSettings(radius=8**0.5, fades=True),
    "size": RenderSettings(min_variance=4.0),
    "size-along-x-and-y": RenderSettings(min_variance=4.0, boxed=True),
    "contribution": RenderSettings(min_contribution=1.5),
    "spread": RenderSettings(least_spread=3.0),
    "level-spread": RenderSettings(least_spread=3.0, level_below=1.0),
    "largest-color": RenderSettings(max_color=0.6),
    "distance": RenderSettings(radial=True),
    "linear-light": RenderSettings(linear_light=2.2),
    "frame": RenderSettings(frame=0.7, frozen_beyond=math.inf),
    "frozen-by-width": RenderSettings(frozen_beyond=0.0, frozen_by_width=True),
    "half-axis": RenderSettings(radius=2.0, max_half_axis=5.0),
    "half-axis-of-the-whole": RenderSettings(radius=2.0, max_half_axis=5.0, boxed=True),
    "picture-size": RenderSettings(radius=20.0, fits_picture=True),
}

CASES: dict[str, Builder] = {
    **{f"{name}-{kind}": partial(odd_row, row, kind) for (name, row), kind in product(ROWS.items(), FILTERS)},
    **{f"{bad}-in-{field}-{kind}": partial(odd_row, _row(**{field: bad}), kind) for field, bad, kind in product(FIELDS, BAD, FILTERS)},
    "no-splat": partial(none_drawn, 0),
    "no-splat-in-view": partial(none_drawn, 5),
    "one-splat": partial(rows_of_the_crowd, [4]),
    "identical-splats": partial(rows_of_the_crowd, [4, 4, 4]),
    "10000-at-one-depth": at_one_depth,
    "10000-opaque-in-one-pixel": in_one_pixel,
    "1e6-units-from-the-origin": far_from_the_origin,
    **{f"{name}-{kind}": partial(seen_by, camera, kind) for (name, camera), kind in product(CAMERAS.items(), FILTERS)},
    **{f"long-lens-{seed}-{kind}": partial(long_lens, seed, kind) for seed, kind in product((1, 42), FILTERS)},
    **{f"long-lens-{seed}-window": partial(long_lens, seed, "window") for seed in (35, 48)},
    **{f"sh-degree-{degree}": partial(of_degree, degree, degree) for degree in range(5)},
    "sh-bands-left-out": partial(of_degree, 3, 1),
    **{f"covariances-{kind}": partial(with_covariances, kind) for kind in FILTERS},
    **{f"{viewer.name}-{seed}": partial(seen_in, viewer, seed) for viewer, seed in product(BUILT_IN, (1, 2))},
    **{
        f"{name}-{viewer.name}": partial(odd_row_seen_in, viewer, ROWS[name])
        for name, viewer in product(ODD_IN_VIEWERS, WITH_SETTINGS)
        if viewer.eps2d or not name.startswith("needle")  # without any dilation its width is lost in float32
    },
    "rule-rounded-picture": in_a_rounded_picture,
    "rule-buckets": partial(in_buckets, RenderSettings(bucketed=True), -5.0),
    "rule-even-buckets": partial(in_buckets, RenderSettings(even_buckets=EvenBuckets()), -1e3),
    **{f"rule-{name}": partial(ruled, rule) for name, rule in RULES.items()},
    "nan-in-covariances": partial(with_covariances, "classic", broken=True),
    **{
        f"random-{seed}-{kind}-{eps2d:.2g}": partial(random_scene, seed, kind, eps2d)
        for seed, kind, eps2d in product((1, 2), FILTERS, (DILATION, DILATION / 64))
    },
}

# Further cases, which take some minutes.
MORE: dict[str, Builder] = {
    **{f"random-{seed}-{kind}": partial(random_scene, seed, kind, USUAL_EPS2D[kind]) for seed, kind in product(range(3, 43), FILTERS)},
    **{f"long-lens-{seed}-window": partial(long_lens, seed, "window") for seed in range(100) if f"long-lens-{seed}-window" not in CASES},
}
