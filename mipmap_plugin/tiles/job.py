"""The jobs of a scene in tiles, from its truths to its tiles. Each can be sent to any process, and done again without harm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from mipmap_plugin.formats.atomic import together, write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.torch_file import save_torch
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.models.places import state_path
from mipmap_plugin.process import pool
from mipmap_plugin.process import threads as thread_pool
from mipmap_plugin.tiles.folder import work_folder
from mipmap_plugin.tiles.halo import draw_halos, draw_layers
from mipmap_plugin.tiles.scene import TiledScene, opened
from mipmap_plugin.tiles.start import StartSearch
from mipmap_plugin.tiles.steering import steer, sweep_of
from mipmap_plugin.tiles.tile import Tile
from mipmap_plugin.tiles.truth import draw_truths

Work = Literal["truth", "start", "layer", "halo", "tile", "steering"]


@dataclass(frozen=True)
class TileJob(Job):
    """A job of one scene; its target is the file that it leaves in the scene's folder."""

    needs_folder: ClassVar[str] = "tiles need a folder that all workers see, and some worker does not see the checkpoint's; use --jobs, or share it"

    work: Work = "tile"
    number: int = 0
    sweep: int = 0
    others: tuple[Job, ...] = ()  # of the same base, whose truths are made from the same pictures

    def __str__(self) -> str:
        number = "" if self.work in ("start", "steering") else f" {self.number + 1}"
        sweep = "" if self.work in ("truth", "start") else f" in sweep {self.sweep + 1}"
        return f"{self.base.checkpoint.name} x{self.scale:g}: {self.work}{number}{sweep}"

    def own_work(self, threads: int | None) -> Outcome:
        """Do the work, unless its file is there already. Raises what `TiledScene` raises."""
        if self.target.exists():
            return Outcome(self, "finished before", self.target, _facts(self.target))
        scene = opened(self.base, self.scale, self.viewer, self.config(), self.target.parent)
        with thread_pool.limited_for(scene.backend, threads):
            self._do(scene)
        pool.release_to_system()
        return Outcome(self, "done", self.target, _facts(self.target))

    def _do(self, scene: TiledScene) -> None:
        if self.work == "truth":
            return draw_truths(scene, self.number, [scene.at(job, work_folder(job.target)) for job in self.others])
        if self.work == "start":
            return StartSearch(scene).run()
        sweep = sweep_of(scene, self.sweep)
        assert sweep is not None  # since this job is a part of it
        if self.work == "layer":
            draw_layers(scene, self.number, sweep)
        elif self.work == "halo":
            draw_halos(scene, self.number, sweep)
        elif self.work == "steering":
            steer(scene, sweep)
        else:
            self._adapt(Tile(scene, self.number, sweep))

    def _adapt(self, tile: Tile) -> None:
        saved, facts, keeper = tile.adapt(state_path(self.target))
        state = keeper and keeper.remaining_file()
        with together(self.target, state.files if state else []):
            save_torch(self.target, saved, overwrite=True)
            write_json(facts_file(self.target), facts, overwrite=True)
        if state:
            state.release()


def facts_file(target: Path) -> Path:
    """Where a tile's job leaves what there is to say of it."""
    return target.with_name(target.name + ".json")


def _facts(target: Path) -> dict[str, Any]:
    return dict(read_json(facts_file(target))) if facts_file(target).exists() else {}
