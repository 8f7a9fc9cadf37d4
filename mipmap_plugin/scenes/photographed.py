"""From where a capture was photographed, as the colors of its splats tell.

Training fits the SH bands above 0 of a splat to the views that see it, and to no others. So toward an eye where a camera was, the squares of these
bands are larger than their mean over all directions; and as one camera is seen in different directions by splats in different places, they tell how
far away it was, too. In two captures the rank correlation between `agreement` and the distance to the nearest camera is -0.80 and -0.86.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import basis

DIRECTIONS = 256  # around the scene, of which the better half counts as seen
CELL = math.sqrt(4 * math.pi / DIRECTIONS) / 4  # how far around each of them views are, in radians, one standard deviation

# Places at multiples of the golden ratio are spread evenly, however many there are.
GOLDEN = (math.sqrt(5) - 1) / 2

# So many splats tell, evenly out of all that can be seen; with fewer than LEAST chance decides.
SAMPLE, LEAST, SEEN_OPACITY = 1024, 1000, 0.1

# A splat that has nothing toward an eye counts as one that has this part of its mean, so that few cannot decide for all.
FLOOR = 0.05

# The standard deviation of the agreement over all directions from which on it tells something: 0.15 to 0.6 in three captures and two objects, and
# 0.03 for colors by chance.
CONTRAST = 0.1

# Eyes are looked for at so many distances, in so many of the directions, of which the best quarter decides.
DISTANCES, TRIED = 24, 64

# The colors tell of a distance 1.15 times that of the cameras in one capture, and 0.66 times in another: half of the views are so many times as far.
FARTHER = 1.4

# This part of the splats that pictures show is smaller than a pixel: in the closest photographs of two captures a tenth are below 1.01 and 1.09 px.
SMALLEST = 0.1

# px: the longest focal length, that of a photograph of 24 megapixels. Of splats that nothing could show, tiny or flat, there may be many.
LONGEST = 5000.0


@dataclass(frozen=True)
class Photographed:
    """How far from the center the cameras were, in world units, at least and at most, in which directions, and their focal length in px.

    `seen`: a bit for each of `even_directions`, in hexadecimal.
    """

    nearest: float
    farthest: float
    seen: str
    focal: float


def photographed(splats: Gaussians, center: Tensor, nearest: float, farthest: float, half_fov: float) -> Photographed | None:
    """From where the capture was photographed, between `nearest` and `farthest` (world units) of `center` [3]; None if its colors do not tell.

    `half_fov`: half of the angle that pictures show, radians.
    """
    chosen = _telling(splats)
    if chosen is None:
        return None
    ways = even_directions()
    distances = torch.logspace(math.log10(nearest), math.log10(farthest), DISTANCES, dtype=torch.float64).tolist()
    some = ways[:: DIRECTIONS // TRIED]
    best = [agreement(chosen, center + far * some).topk(TRIED // 4).values.mean().item() for far in distances]
    near = distances[max(range(DISTANCES), key=best.__getitem__)]
    found = agreement(chosen, center + near * ways)
    if found.std() < CONTRAST:
        return None
    seen = found >= found.median()
    some = near * ways[seen][:: DIRECTIONS // TRIED]
    focal = _focal(chosen, center, torch.cat([some[::2], FARTHER * some[1::2]]), half_fov)
    return Photographed(near, FARTHER * near, _hexadecimal(seen), focal) if focal else None


def even_directions(count: int = DIRECTIONS) -> Tensor:
    """`count` unit vectors, [D, 3] on the processor, evenly spread over the sphere (Fibonacci's)."""
    number = torch.arange(count, dtype=torch.float64, device="cpu")
    height = 1 - (2 * number + 1) / count
    turn, level = 2 * math.pi * GOLDEN * number, (1 - height**2).sqrt()
    return torch.stack([level * turn.cos(), level * turn.sin(), height], dim=1)


def seen_ways(seen: str, count: int, generator: torch.Generator) -> Tensor:
    """`count` unit vectors, [V, 3], evenly out of the directions that were `seen`, each somewhere near one of `even_directions`."""
    cells = even_directions()[[bit == "1" for bit in f"{int(seen, 16):0{DIRECTIONS}b}"]]
    chance = torch.rand(count, generator=generator, dtype=torch.float64)
    place = ((torch.arange(count) + chance) * len(cells) / count).long().clamp_max(len(cells) - 1)
    return torch.nn.functional.normalize(cells[place] + CELL * torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)


def agreement(splats: Gaussians, eyes: Tensor) -> Tensor:
    """How strongly the splats' view-dependent colors stand out toward `eyes` [V, 3], [V]: 0 if as much as in the mean over all directions.

    The mean, by opacity, of the logarithm of the squares of the SH bands above 0 over their mean over the sphere, which is the sum of the
    squares of the coefficients over 4 pi.
    """
    rays = torch.nn.functional.normalize(splats.means - eyes[:, None], dim=2)
    above, degree = splats.sh[:, 1:], math.isqrt(splats.sh.shape[1]) - 1
    functions = basis(rays.flatten(0, 1), degree)[:, 1:].unflatten(0, rays.shape[:2])
    toward = torch.einsum("vnk,nkc->vnc", functions, above).square().sum(2)
    everywhere = above.square().sum((1, 2)) / (4 * math.pi)
    return (toward / everywhere + FLOOR).log() @ splats.opacities / splats.opacities.sum()


def sizes(gaussians: Gaussians) -> Tensor:
    """The size of each splat, [N] in world units: the geometric mean of its two longer axes (standard deviations)."""
    return gaussians.scales.topk(2, dim=1).values.prod(dim=1).sqrt()


def quantile(values: Tensor, share: float) -> Tensor:
    """The value below which `share` of the first dimension lies. torch.quantile refuses more than 16 million values."""
    return values.kthvalue(max(1, round(share * len(values))), dim=0).values


def _telling(splats: Gaussians) -> Gaussians | None:
    """An even sample of the splats that can be seen and whose colors depend on the view, in double precision; None where there are too few."""
    if splats.covariances is not None or splats.sh.shape[1] < 2:
        return None
    finite = splats.means.isfinite().all(1) & splats.scales.isfinite().all(1) & splats.sh.isfinite().all(2).all(1)
    rows = ((splats.opacities >= SEEN_OPACITY) & finite & (splats.sh[:, 1:] != 0).any(2).any(1)).nonzero()[:, 0]
    if len(rows) < LEAST:
        return None
    rows = rows[torch.linspace(0, len(rows) - 1, min(SAMPLE, len(rows)), dtype=torch.float64).long()]
    return splats.detach()[rows].to(device="cpu", dtype=torch.float64)


def _focal(splats: Gaussians, center: Tensor, eyes: Tensor, half_fov: float) -> float:
    """The focal length, px, at which the smallest splats in pictures from `eyes` [V, 3], relative to the center, are pixels; 0 if there are none."""
    closest = torch.full((len(splats.means),), math.inf, dtype=torch.float64)
    for eye in eyes:
        rays = splats.means - center - eye
        depth = rays @ -eye / eye.norm()
        inside = (depth > 0) & (depth >= math.cos(half_fov) * rays.norm(dim=1))
        closest = torch.where(inside, torch.minimum(closest, depth), closest)
    shown = closest.isfinite()
    if not shown.any():
        return 0.0
    pixels = sizes(splats)[shown] / closest[shown]
    smallest = quantile(pixels, SMALLEST).item()
    return min(LONGEST, 1 / smallest) if smallest > 0 else LONGEST


def _hexadecimal(seen: Tensor) -> str:
    return f"{int(''.join(str(int(bit)) for bit in seen.tolist()), 2):x}"
