"""How much room a ladder needs on the disk, as far as that is known before any work."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.adaptation.views.pixel_size import seen_pixel_size
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.distance.coarsening import kept_splats
from mipmap_plugin.levels.distance.ladder import by_distance
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.request import Band, LadderRequest
from mipmap_plugin.models.base import SplatModel

# Columns of a PLY that are no parameters: the normals.
NORMALS = 3

# Splats by which a ladder by distance is estimated.
SAMPLE = 100_000


def room_for(base: FrozenBase, request: LadderRequest, unfinished: Path) -> int:
    """About how many bytes a ladder still writes: each level is kept in the folder `unfinished`, and copied to the output when all are ready."""
    levels = round(sum(shares(base, request)) * _bytes(base.model))
    kept = sum(file.stat().st_size for file in unfinished.glob("level_*.ply"))
    return max(0, levels - kept) + max(levels, kept)


def shares(base: FrozenBase, request: LadderRequest) -> list[float]:
    """How many splats each level is planned to have, in those of the base. Merging may keep more, where it would cost too much."""
    band = request.first_band(base)
    if by_distance(base, request):
        return _by_distance(base, request, band)
    found, ratio = [1.0], band.ratio
    while not band.reaches(request.coarsest):
        ratio = request.next_ratio(band.low, ratio)
        band = band.next(ratio, request.coarsest)
        found.append((band.settings() | dict(request.settings)).get("merge_to", 1.0))
    return found


def _by_distance(base: FrozenBase, request: LadderRequest, band: Band) -> list[float]:
    means = base.model.parameters()["means"].detach()
    pixels = seen_pixel_size(means[:: 1 + len(means) // SAMPLE], base.views(), base.effects().near_plane)
    if not len(pixels):
        return [1.0]  # and no ladder, since no distance follows
    rule = DistanceRule.of(pixels, request, band)
    splats = [len(pixels)]
    for size in map(rule.middle, range(1, rule.count)):
        moved = int((pixels < size).sum())
        splats.append(len(pixels) - moved + min(moved, kept_splats(pixels, size, rule.ratio)))
    return [count / len(pixels) for count in splats]


def _bytes(model: SplatModel) -> int:
    """Of a model's PLY, about."""
    parameters = model.parameters()
    return 4 * (sum(values.numel() for values in parameters.values()) + NORMALS * len(parameters["means"]))
