"""How a run draws the base, and the files that it makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from mipmap_plugin.adaptation.portable import extreme_targets, median_target
from mipmap_plugin.adaptation.renderers import Renderer, unrounded
from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.viewers import find_viewer

# Bands that every renderer of training evaluates, as most viewers do (`Viewer.sh_degree`).
USUAL_DEGREE = 3


@dataclass(frozen=True)
class Drawn:
    """The effects of the base, and of the file in each viewer. Raises SettingsError for a viewer that is not registered."""

    base: Effects
    targets: Mapping[str, Effects]  # by viewer; the file names the first of them

    @property
    def effects(self) -> Effects:
        """Those of the first viewer."""
        return next(iter(self.targets.values()))

    @cached_property
    def extremes(self) -> dict[str, Effects]:
        """The targets that steps draw."""
        return extreme_targets(self.targets)

    @property
    def median(self) -> Effects:
        """The target that a start is made for."""
        return median_target(self.targets)

    def renders(self, backend: Backend) -> list[Renderer]:
        """What draws as each of the extremes does."""
        return [Renderer(backend, target) for target in self.extremes.values()]

    @property
    def to_step(self) -> list[Effects]:
        """How steps draw: as the extremes, `unrounded`."""
        return [*map(unrounded, self.extremes.values())]

    def copied(self, model: SplatModel, *, shared: bool = False) -> SplatModel:
        """A copy of a model that is rendered with the target's screen filter; `shared`: with the model's tensors, if it can have these."""
        model = getattr(model, "shared", model.copy)() if shared else model.copy()
        model.trained = model.trained.drawn_with(self.effects)
        return model

    @cached_property
    def degrees(self) -> Mapping[str, int]:
        """The degree of the SH bands that each viewer draws."""
        return {name: find_viewer(name).sh_degree if name else USUAL_DEGREE for name in self.targets}

    def most_degree(self, backend: Backend, model: SplatModel) -> int:
        """The highest degree of SH bands that all of the viewers draw, and the backend of splats like the model's.

        Of several viewers the worst counts: what others learn by their bands is wrong in one that draws none.
        """
        means, degrees = model.parameters()["means"], range(min(self.degrees.values()), 0, -1)
        needs = [Needs(means.device.type, means.dtype, True, 0, target.screen_filter, settings=target.settings) for target in self.targets.values()]
        return next((each for each in degrees if not any(backend.lacking(replace(need, sh_degree=each)) for need in needs)), 0)

    def with_bands(self, degree: int) -> Drawn:
        """The same with SH bands up to `degree`, as far as viewers draw them. The base, which may have fewer, looks the same by it."""
        targets = {name: _at_least(target, min(degree, self.degrees[name])) for name, target in self.targets.items()}
        return Drawn(_at_least(self.base, degree), targets)


def _at_least(effects: Effects, degree: int) -> Effects:
    return replace(effects, sh_degree=max(effects.sh_degree, degree))
