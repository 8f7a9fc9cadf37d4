"""The page of a ladder of levels by distance: what a camera that walks backwards sees, how good it is, and from where each level is shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.levels.distance.manifest import DistanceContents
from mipmap_plugin.levels.distance.walks import mean_focal
from mipmap_plugin.levels.distance.yardstick import Seen, WalkPoint, Walks
from mipmap_plugin.pages.gallery import effects_of_base
from mipmap_plugin.pages.levels import lead, rounded
from mipmap_plugin.pages.record import Page, Picture, Role, Zoom

# What the pictures are compared with.
TRUTH = "the supersampled base (no photographs)"


def walks_page(title: str, ladder: DistanceContents, manifest: dict[str, Any], commands: Sequence[str]) -> Page:
    """The page of a ladder and its manifest (`levels.distance.manifest`): pictures of a walk where it begins, where what is nearest is in the middle
    of each level, and at the end."""
    scene, walks, zooms = ladder.scene, Walks(ladder.scene, [level.model for level in ladder.levels]), dict[float, Zoom]()
    curve = list(zip(walks.sizes(), ladder.curve, strict=True))
    middles = {scene.rule.middle(number) for number in range(scene.rule.count + scene.rule.left_out)}
    for size, point in [curve[0], *(each for each in curve if each[0] in middles), curve[-1]]:
        seen = walks.seen(walks.views[0], size)
        if seen.way not in zooms:  # the first levels may end before the walk begins
            zooms[seen.way] = _zoom(ladder, walks, seen, point)
    text, effects = lead(manifest, "on walks backwards"), effects_of_base(scene.base)
    return Page(title, text, commands, list(zooms.values())[::-1], ladder=manifest, effects=effects, provenance=manifest["versions"])


def _zoom(ladder: DistanceContents, walks: Walks, seen: Seen, point: WalkPoint) -> Zoom:
    """The base in the viewer, the levels as it mixes them, and the supersampled base. `point`: the means of all walks."""
    view = walks.views[0]
    scale = 1 - seen.way / (seen.pixel * mean_focal(view))
    base = _picture(f"base in {ladder.scene.request.viewer}", "base", seen.base, seen, point.base_db, len(ladder.scene.splats))
    mixture = _picture("levels as shown", "adapted", seen.mixture, seen, point.psnr_db, seen.splats)
    truth = Picture("base, supersampled", "truth", seen.truth, note=TRUTH)
    place = f"{view.name}, from {seen.way:.3g} world units farther back"
    return Zoom(rounded(scale), scale, [base, mixture, truth], place, TRUTH, f"{plural(len(walks.views), 'walk')} that no level was adapted to")


def _picture(name: str, role: Role, image: Tensor, seen: Seen, mean: float, splats: int) -> Picture:
    return Picture(name, role, image, {"psnr_db": psnr(image, seen.truth)}, {"psnr_db": mean}, plural(splats, "splat"))
