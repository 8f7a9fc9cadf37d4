"""The whole scene at the checks of a sweep: what did harm is undone in all tiles, which go on with lower rates (as `optimization.validation`).

A tile by itself cannot tell: what it shows of a view is a part of its error. On flowers' 300,000 splats (8 tiles, 60 steps, one seed), tiles
that found rates of their own ended 0.8 dB below the result without tiles, steered as a whole 0.2, and with the limit of rates that the run
without tiles had found 0.1. At a million splats, steered as a whole, 1.9 dB are missing.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, RATE_REDUCTION, TIE_DB, Steering
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.tiles.folder import START, start_file, steered_file, tile_file
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.start import psnr
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep
from mipmap_plugin.tiles.truth import Truths


@dataclass(frozen=True)
class Steered:
    """What became of a sweep, or of the start."""

    sweep: int  # of the state that is gone on with, and the step after which the tiles were in it; -1: the start
    step: int
    ceiling: float = 1.0  # of the rates
    psnrs: tuple[float, ...] = ()  # dB of the whole on the steering views at each check, up to the first that did harm

    @classmethod
    def before(cls, folder: Path, sweep: int) -> Steered:
        """What a sweep goes on with; after the last sweep: the result."""
        return cls(**read_json(steered_file(folder, sweep - 1))) if sweep else cls(-1, 0)

    def file(self, folder: Path, number: int) -> Path:
        """The splats of a tile in this state."""
        return start_file(folder, number) if self.sweep < 0 else tile_file(folder, number, self.sweep, self.step)


def open_state(scene: TiledScene, folder: Path, state: Steered) -> Splats:
    """The splats of all tiles in a state, tile after tile."""
    return Splats.of(scene.kind, [Store(state.file(folder, number)) for number in range(len(scene.cores))])


def result(scene: TiledScene, folder: Path) -> Steered:
    """What the last sweep that was made ended with; the start without steps."""
    return Steered.before(folder, sum(steered_file(folder, sweep.number).exists() for sweep in scene.sweeps))


def steer(scene: TiledScene, sweep: Sweep, folder: Path) -> None:
    """Measure the whole at each check of a sweep, and write what the next sweep begins with."""
    before, start_db = Steered.before(folder, sweep.number), load_torch(folder / START)["psnr"]
    truths, psnrs = Truths(scene, folder), []
    best, best_db, ceiling = before, -float("inf"), before.ceiling
    for step in sweep.checks:
        state = Steered(sweep.number, step)
        psnrs.append(psnr(scene, open_state(scene, folder, state), truths, scene.views.steering))
        if psnrs[-1] < start_db - HARM_DB and scene.config.returns == "best":
            ceiling = RATE_REDUCTION * rate_factor(scene, step, ceiling)
            break
        if psnrs[-1] >= best_db - TIE_DB:
            best, best_db = state, max(best_db, psnrs[-1])
    else:
        best = state  # what has learned most
    after = Steered(best.sweep, best.step, ceiling, tuple(psnrs))
    write_json(steered_file(folder, sweep.number), asdict(after), overwrite=True)


def rate_factor(scene: TiledScene, step: int, ceiling: float) -> float:
    """The factor of all rates in a step."""
    return Steering(0.0, 0.0, Snapshot({}, {}), ceiling=ceiling).rate_factor(step / scene.config.steps, scene.config)
