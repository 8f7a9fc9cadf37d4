"""The whole scene at the checks of a sweep: what did harm is undone in all tiles, which go on with lower rates.

A tile by itself cannot tell, because it shows only a part of a view's error. In the warm-up a state does harm if it is worse than the start, as
without tiles. Later it does if it is worse than the best state of its sweep, or than the one that the sweep began with: as halos stay as they
are during a sweep, rates that are too high drive all tiles further and further off. (The first steps after the warm-up of flowers with a million
splats ended below the start in this way; repeated at half of the rates, they ended 1 to 2 dB above the best state before.)
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path

from mipmap_plugin.adaptation.optimization.steering import RATE_REDUCTION, warmed_up
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, TIE_DB, Quality
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.tiles.folder import START, start_file, steered_file, tile_file
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.start import quality
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep
from mipmap_plugin.tiles.truth import Truths

# Steps that did harm are repeated this often, at half of the rates each time, before the run goes on without them.
MOST_REPEATS = 3

# Of a state that is not measured.
UNKNOWN = Quality(-math.inf, -math.inf)


@dataclass(frozen=True)
class Steered:
    """What became of a sweep, or of the start."""

    sweep: int  # of the state that is gone on with, and the step after which the tiles were in it; -1: the start
    step: int
    ceiling: float = 1.0  # of the rates
    checked: tuple[float, ...] = ()  # visible dB of the whole on the steering views at each check, up to the first that did harm
    quality: Quality = UNKNOWN  # of the state that is gone on with
    following: Sweep | None = None  # None: the run is over

    @classmethod
    def before(cls, folder: Path, sweep: int) -> Steered:
        """What a sweep goes on with; after the last sweep: the result."""
        if not sweep:
            return cls(-1, 0, quality=Quality(*load_torch(folder / START)["quality"]))
        facts = read_json(steered_file(folder, sweep - 1))
        following, quality = facts.pop("following"), Quality(*facts.pop("quality"))
        return cls(**facts, quality=quality, following=None if following is None else Sweep(**{**following, "checks": tuple(following["checks"])}))

    def file(self, folder: Path, number: int) -> Path:
        """The splats of a tile in this state."""
        return start_file(folder, number) if self.sweep < 0 else tile_file(folder, number, self.sweep, self.step)


def sweep_of(scene: TiledScene, number: int) -> Sweep | None:
    """The `number`-th sweep that is made, once the one before it was steered; None if there is none."""
    return Steered.before(scene.folder, number).following if number else next(iter(scene.sweeps), None)


def open_state(scene: TiledScene, state: Steered) -> Splats:
    """The splats of all tiles in a state, tile after tile."""
    return Splats.of(scene.kind, [Store(state.file(scene.folder, number)) for number in range(len(scene.cores))])


def result(folder: Path) -> Steered:
    """What the last sweep that was made ended with; the start without steps."""
    return Steered.before(folder, next(number for number in count() if not steered_file(folder, number).exists()))


def steer(scene: TiledScene, sweep: Sweep) -> None:
    """Measure the whole at each check of a sweep, and write what the next sweep begins with."""
    start, before = (Steered.before(scene.folder, number) for number in (0, sweep.number))
    truths, checked, harmful = Truths(scene), [], False
    best, reached, ceiling = before, before.quality, before.ceiling
    warms_up = sweep.end <= scene.config.warm_up_steps  # rates that lose a little in a few steps may gain in many
    for step in sweep.checks:
        state = Steered(sweep.number, step)
        found = quality(scene, open_state(scene, state), truths)
        checked.append(found.visible)
        if found.visible < (start.quality if warms_up else reached).visible - HARM_DB and scene.config.returns == "best":
            ceiling, harmful = RATE_REDUCTION * min(warmed_up(step, scene.config), ceiling), True
            break
        if found.visible >= reached.visible - TIE_DB:
            best, reached = state, max(reached, found)
    else:
        best, reached = state, found  # what has learned most
    again = harmful and not warms_up and sweep.repeats < MOST_REPEATS
    following = repeated(sweep, best) if again else next_planned(scene, sweep)
    after = Steered(best.sweep, best.step, ceiling, tuple(checked), reached, following)
    write_json(steered_file(scene.folder, sweep.number), asdict(after), overwrite=True)


def repeated(sweep: Sweep, best: Steered) -> Sweep:
    """The rest of a sweep after its best state, or all of it, in front of the same halos."""
    first = best.step if best.sweep == sweep.number else sweep.first
    checks = tuple(step for step in sweep.checks if step > first)
    return replace(sweep, number=sweep.number + 1, first=first, checks=checks, repeats=sweep.repeats + 1)


def next_planned(scene: TiledScene, sweep: Sweep) -> Sweep | None:
    """The sweep that comes after one and its repetitions."""
    planned = scene.sweeps[sweep.planned + 1 : sweep.planned + 2]
    return replace(planned[0], number=sweep.number + 1, halos=sweep.number + 1) if planned else None
