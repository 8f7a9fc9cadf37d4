"""What the views of a base show: the sizes of their pixels, and how much each splat contributes to their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.blend_weights import PARTS, Wanted, may_show, wanted_of, weighed
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.views.pixel_size import LEAST_VIEWS, pixel_size, views_for
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.render_settings import MIN_ALPHA

# The user is told if a larger fraction of the splats is shown by no view, since dB say nothing of these. In captures it is up to a quarter.
HIDDEN = 1 / 3

# What the user is told of them, after how many they are.
ON_HIDDEN = "of which the dB say nothing: give cameras that show all of the scene, or look at it from where these do"

# Up to this scale views are weighed at half of their size: their pixels are still at most half as wide as the target's, and objects and captures end
# within 0.05 dB of what they would, in half to two thirds of the time for weighing. At a quarter of the size flowers and chair lose 0.1 dB at x1/4.
FAR, HALF = 1 / 4, 1 / 2


class BaseWeights:
    """The blend weights of the base's splats, and the views that they were measured in; pixel sizes, also before `measured` is called."""

    def __init__(self, problem: StartProblem, clock: Clock) -> None:
        self._problem, self._clock = problem, clock
        self._of_base: tuple[Tensor, Tensor] | None = None  # the base's means and its pixel size
        self.count: int | None = None  # of the views that show enough of the splats; None as long as it is not known
        self.views: list[Camera] = []  # these views
        self.size = 1.0  # fraction of their size at which views are weighed: `HALF`, or less where a time budget leaves no time for large ones
        self.shown = torch.empty(0, dtype=torch.bool)  # which splats views show (`may_show`)
        self.of_base = Wanted(*torch.empty(3, 0))  # once it is `measured`
        self.notes: list[str] = []  # on what they show

    def measured(self, base: SplatModel) -> Tensor:
        """[N, P]: the blend weights of the base's splats (`weighed`), in target pixels of a view, from as many views as show enough of them."""
        problem, gaussians = self._problem, base.gaussians(self._problem.views[0]).detach()

        def over(numbers: Sequence[int], parts: Sequence[int], size: float) -> tuple[Tensor, float]:
            return weighed(gaussians, [problem.views[number] for number in numbers], parts, problem.backend, problem.base_effects, size)

        def timed(numbers: Sequence[int], parts: Sequence[int]) -> tuple[Tensor, float]:
            with self._clock.timing("weights", len(numbers) / LEAST_VIEWS):
                return over(numbers, parts, self.size)

        def enough(shown: float) -> int:
            self.count = views_for(shown)
            while self.count > LEAST_VIEWS and not self._clock.allows("weights", min(self.count, len(problem.views)) / LEAST_VIEWS - 1):
                self.count //= 2
            return self.count

        self.size = self._clock.size(problem.views[0], LEAST_VIEWS, lambda size: over([0], [0], size), HALF if problem.scale <= FAR else 1.0)
        weights, numbers = weighed_in_parts(len(problem.views), timed, enough)
        self.views = [problem.views[number] for number in numbers]
        weights = weights * problem.scale**2
        self.of_base = self.wanted(gaussians, weights)
        self.shown = may_show(weights.sum(1), self.of_base.whole, gaussians.means, problem.views, self.views)
        self.notes += note_on_hidden(self.shown, gaussians.opacities)
        return weights

    def wanted(self, gaussians: Gaussians, weights: Tensor) -> Wanted:
        """`wanted_of` splats with these blend weights [N, P]."""
        problem = self._problem
        return wanted_of(weights, gaussians, self.pixel_size(gaussians.means), problem.views, problem.base_effects, problem.scale)

    def pixel_size(self, means: Tensor) -> Tensor:
        """`pixel_size` at means [N, 3]; that of the base, which is asked for first, serves all candidates."""
        if self._of_base is not None and torch.equal(self._of_base[0], means):
            return self._of_base[1]
        pixels = pixel_size(means, self._problem.closest_of, self.count)
        self._of_base = self._of_base or (means, pixels)
        return pixels


def weighed_in_parts(
    count: int, weigh: Callable[[Sequence[int], Sequence[int]], tuple[Tensor, float]], enough: Callable[[float], int] = views_for
) -> tuple[Tensor, list[int]]:
    """The blend weights [N, P] from as many of `count` views as show enough, and the numbers of these, of which every P-th one is in the same part.

    `weigh(numbers, parts)`: `weighed` in some of the views. `enough(shown)`: how many views are enough if each shows this fraction of the splats.
    """
    first = evenly(range(count), LEAST_VIEWS)
    weights, shown = weigh(first, [place % PARTS for place in range(len(first))])
    numbers = evenly(range(count), enough(shown))
    if len(numbers) % len(first):  # these are all, and the first ones are not evenly spread among them
        numbers = [*first, *(number for number in numbers if number not in first)]
    else:  # the first ones are evenly spread among these
        stride = len(numbers) // len(first)
        weights = torch.zeros_like(weights).index_add_(1, torch.arange(PARTS, device=weights.device) * stride % PARTS, weights)
    parts = {number: place % PARTS for place, number in enumerate(numbers) if number not in first}
    if parts:
        weights = weights.lerp(weigh([*parts], [*parts.values()])[0], len(parts) / len(numbers))
    return weights, numbers


def note_on_hidden(shown: Tensor, opacities: Tensor) -> list[str]:
    """That views show too little of the splats, of which they show those that are True in `shown` [N], in a sentence; none if they show enough."""
    if not (hidden := float((~shown)[opacities >= MIN_ALPHA].float().mean())) > HIDDEN:
        return []
    return [f"no view shows {hidden:.0%} of the splats, {ON_HIDDEN}"]
