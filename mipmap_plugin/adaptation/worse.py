"""What is told of a file that gains by the mean: views and viewers that show it worse than the base, and how the base itself looks better."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress
from statistics import median

from torch import Tensor

from mipmap_plugin.adaptation.optimization.validation import HARM_DB
from mipmap_plugin.adaptation.views.pixel_size import seen_depth
from mipmap_plugin.adaptation.views.remarks import EACH_LENS, focal_length
from mipmap_plugin.adaptation.views.shown import SAMPLES
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import some_of

# A lens is called longer from this many times the shortest focal length on: what it sees is as one scale of a ladder and the next.
LONGER = 2.0

# Views count as close-ups if the nearest tenth of their splats lies before this part of its depth in others, as a level is to the next coarser.
NEAREST, CLOSE = 0.1, 0.5


def worse_views(
    views: Sequence[Camera], before: Sequence[float], after: Sequence[float], scale: float, means: Tensor, *, orbit: bool = False
) -> list[str]:
    """That the file for `scale` shows some views worse than the base does, while it gains by their mean, in a sentence; none where it loses by that.

    `before`, `after`: dB of each view as far as differences are visible. `means` [N, 3]: of the base's splats. `orbit`: the views were generated,
    some of them finer, and have no lens.
    """
    worse = [then > now + HARM_DB for then, now in zip(before, after, strict=True)]
    if not any(worse) or sum(after) < sum(before):
        return []
    then, now = max(compress(zip(before, after, strict=True), worse), key=lambda pair: pair[0] - pair[1])
    where = f"in {some_of(sum(worse), len(views), 'view')} that it was chosen by, the file for x{scale:g} looks worse than the base"
    told = f"{where}, by up to {then - now:.1f} dB as far as differences can be seen ({then:.1f} -> {now:.1f}), though it gains by their mean"
    shortest, longer = min(map(focal_length, views)), min(map(focal_length, compress(views, worse)))
    if longer >= LONGER * shortest and not orbit:
        told += f"; they are seen through longer lenses, of {longer:.0f} px and more, where the shortest has {shortest:.0f} px: {EACH_LENS}"
    elif _are_close_ups(views, worse, means) and not orbit:
        told += "; they are close-ups, and what looks right from afar does not from there: adapt with the cameras of close-ups on their own"
    return [told]


def _are_close_ups(views: Sequence[Camera], some: Sequence[bool], means: Tensor) -> bool:
    """Whether `some` of the views [V] see the nearest of the `means` [N, 3] from much nearer than the others (`CLOSE`)."""
    points = means[:: 1 + len(means) // SAMPLES[1]]
    depths = [seen_depth(view, points, 0.0, NEAREST) for view in views]
    others = [depth for depth, close in zip(depths, some, strict=True) if not close]
    return max(compress(depths, some)) < CLOSE * median(others)


def better_as_trained(as_trained: float | None, psnr: float, effects: Effects) -> list[str]:
    """A note where a renderer of the base's training shows the base itself better than the file's viewer shows the file; none elsewhere."""
    if as_trained is None or as_trained <= psnr + HARM_DB:
        return []
    own = f"drawn as its training drew it ({effects.screen_filter} {effects.eps2d:g} px²), the base itself has {as_trained:.2f} dB"
    return [f"{own} on the same views, more than this file's {psnr:.2f}: for a renderer that draws so, adapt without a viewer"]


def worse_viewers(viewers: Iterable[str], before: Sequence[float], after: Sequence[float]) -> list[str]:
    """That a file for several viewers looks worse than the base in some of them, in a sentence; none where it does not, or is for one viewer.

    `before`, `after`: dB in each viewer as far as differences are visible.
    """
    worse = {name: (then, now) for name, then, now in zip(viewers, before, after, strict=True) if then > now + HARM_DB}
    if not worse or len(before) < 2:
        return []
    most = max(worse, key=lambda name: worse[name][0] - worse[name][1])
    then, now = worse[most]
    names = f"{' and '.join(worse)} {'show' if len(worse) > 1 else 'shows'}"
    where = f"of the {len(before)} viewers that it was chosen by, {names} the file worse than the base"
    told = f"{where}, by up to {then - now:.1f} dB as far as differences can be seen ({then:.1f} -> {now:.1f})"
    return [f"{told}: for such a viewer make a file of its own (--viewer {most})"]
