"""Code books that splats are rounded to: each of 256 numbers, or a palette of vectors, close where rounding would show most."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.process.torch_modes import usual_modes

CODES = 256

# Bins of the histogram that codes are placed by, and rounds of k-means that then move them.
BINS, ROUNDS = 4096, 3

# Fraction of the codes that lie evenly over the whole range, so that every number has one near it, whatever its weight.
EVEN = 0.5

# Values between these quantiles count as usual. Codes are spaced evenly up to so many times that range away from the median, and in proportion to the
# distance beyond: otherwise one value that is very far away would leave all others in a single bin.
USUAL, NEAR = (0.01, 0.99), 30

# The seed of what is drawn: the same splats give the same bytes.
SEED = 0

# Powers of the weights by which the first entries of a palette are drawn, and by which the parts of the splats share its entries.
DRAWN, SHARED = 0.5, 1 / 3

# Rows that are compared with all entries at a time.
ROWS = 4096


def codebook(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """256 ascending numbers, and the index of the one that each of the `values` is rounded to, uint8 in their shape. `weights`: of that shape.

    Fewer distinct numbers have several codes each, and the index is the one in the middle: Babylon.js decodes images on a canvas, which changes the
    colors of half-transparent pixels, and these are indices, by a few levels.
    """
    flat, shares = values.astype(np.float64).ravel(), weights.astype(np.float64).ravel()
    distinct = np.unique(flat)
    codes = distinct if len(distinct) <= CODES else _moved(_placed(flat, shares), flat, shares)
    entries = np.searchsorted((codes[1:] + codes[:-1]) / 2, flat)
    owners = np.arange(CODES) * len(codes) // CODES
    middles = (np.searchsorted(owners, np.arange(len(codes))) + np.searchsorted(owners, np.arange(len(codes)), "right") - 1) // 2
    return codes[owners], middles[entries].astype(np.uint8).reshape(values.shape)


def _placed(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Codes whose density is the cube root of that of the weights, which minimizes the square error, mixed with an even density."""
    middle, near = np.median(values), NEAR * np.ptp(np.quantile(values, USUAL)) or np.ptp(values)
    values = np.arcsinh((values - middle) / near)
    low, high = values.min(), values.max()
    bins = ((values - low) / (high - low) * (BINS - 1)).astype(np.int64)
    density = np.cbrt(np.bincount(bins, weights, BINS))
    total = density.sum()
    mixed = EVEN / BINS + (1 - EVEN) * density / total if total > 0 else np.full(BINS, 1 / BINS)
    reached = np.concatenate([[0.0], mixed.cumsum()])
    wanted = (np.arange(CODES) + 0.5) / CODES * reached[-1]
    codes: np.ndarray = middle + near * np.sinh(low + (high - low) * np.interp(wanted, reached, np.linspace(0, 1, BINS + 1)))
    return codes


def _moved(codes: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    for _ in range(ROUNDS):
        labels = np.searchsorted((codes[1:] + codes[:-1]) / 2, values)
        mass, total = np.bincount(labels, weights, CODES), np.bincount(labels, weights * values, CODES)
        codes = np.sort(np.divide(total, mass, out=codes.copy(), where=mass > 0))
    return codes


@usual_modes()
def palette(vectors: np.ndarray, weights: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` vectors [K, D], and which of them each of the `vectors` [N, D] is rounded to [N]; exact as long as there is room for all.

    Otherwise splats are cut into parts by k-means, and each part has entries of its own: all splats with all entries would take minutes.
    """
    distinct, labels = np.unique(vectors, axis=0, return_inverse=True)
    labels = labels.reshape(-1)
    if len(distinct) <= most:
        return distinct, labels
    points, mass = torch.from_numpy(distinct).float(), torch.from_numpy(np.bincount(labels, weights)).float()
    generator = torch.Generator().manual_seed(SEED)
    _, part = _k_means(points, mass, int(most**0.5), generator)
    members = [rows for number in range(int(part.max()) + 1) if len(rows := (part == number).nonzero()[:, 0])]
    shares = torch.stack([(mass[rows] ** SHARED).sum() for rows in members])
    entries: list[Tensor] = []
    entry = torch.empty(len(points), dtype=torch.long)
    for rows, room in zip(members, _rooms(shares, torch.tensor([len(rows) for rows in members]), most), strict=True):
        centers, own = _k_means(points[rows], mass[rows], room, generator)
        entry[rows] = own + sum(len(part) for part in entries)
        entries.append(centers)
    return torch.cat(entries).numpy(), entry.numpy()[labels]


def _rooms(shares: Tensor, sizes: Tensor, most: int) -> list[int]:
    """How many of `most` entries each part has: at least one, and none more than it has members."""
    spare = most - len(sizes)
    low, high = 0.0, float(sizes.max() / shares[shares > 0].min()) if (shares > 0).any() else 0.0
    for _ in range(60):  # bisection for the factor of the shares at which all is given away
        factor = (low + high) / 2
        within = torch.minimum(shares * factor, sizes - 1.0).sum() <= spare
        low, high = (factor, high) if within else (low, factor)
    given: list[int] = (1 + torch.minimum(shares * low, sizes - 1.0).floor()).long().tolist()
    return given


def _k_means(points: Tensor, weights: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Centers [count, D] of weighted points [N, D], and the nearest one to each [N]; the points themselves if there are no more."""
    if len(points) <= count:
        return points, torch.arange(len(points))
    chances = weights**DRAWN + torch.finfo(weights.dtype).tiny
    keys = torch.rand(len(points), generator=generator).log() / chances  # a draw by weight, without repeats
    centers = points[keys.topk(count).indices]
    for _ in range(ROUNDS):
        labels = _nearest(points, centers)
        mass = torch.zeros(count).index_add_(0, labels, weights)[:, None]
        total = torch.zeros_like(centers).index_add_(0, labels, points * weights[:, None])
        centers = torch.where(mass > 0, total / mass, centers)
    return centers, _nearest(points, centers)


def _nearest(points: Tensor, centers: Tensor) -> Tensor:
    lengths = (centers * centers).sum(1)
    return torch.cat([torch.addmm(lengths[None], rows, centers.T, alpha=-2).argmin(1) for rows in points.split(ROWS)])
