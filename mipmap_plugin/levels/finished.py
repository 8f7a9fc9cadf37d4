"""A finished ladder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.errors import plural
from mipmap_plugin.formats.atomic import delete, together
from mipmap_plugin.levels.contents import Contents, Level
from mipmap_plugin.levels.distance.manifest import DistanceContents
from mipmap_plugin.levels.manifest import refuse_ladder, write_levels
from mipmap_plugin.levels.store import LevelStore
from mipmap_plugin.limits import path_of
from mipmap_plugin.process.torch_modes import in_usual_modes


@dataclass(frozen=True, eq=False, repr=False)
class Ladder:
    """A ladder in memory, whichever way its levels were made."""

    contents: Contents | DistanceContents
    _store: LevelStore
    _manifest: Callable[[Any, list[Path]], dict[str, Any]]  # of the contents, whose levels are in these files

    def __repr__(self) -> str:
        return f"<Ladder: {plural(len(self.levels), 'level')}>"

    @property
    def levels(self) -> list[Level] | list[Adapted]:
        """From the finest to the coarsest."""
        return self.contents.levels

    @in_usual_modes
    def save(self, folder: str | Path, *, overwrite: bool = False, keep_resume: bool = False) -> Path:
        """Write the levels and the manifest `levels.json` to a folder, atomically; return it. Raises OutputExists, OutputError.

        `keep_resume`: leave what was kept to go on from until `forget`.
        """
        folder = path_of(folder)
        with together(folder, [] if keep_resume else self._store.folders()):
            refuse_ladder(folder, self.contents.base, overwrite=overwrite)
            adapted = [level.adapted if isinstance(level, Level) else level for level in self.levels]
            saved = write_levels(adapted, partial(self._manifest, self.contents), folder, overwrite)
            if keep_resume:
                self._store.note(saved)
        return saved

    def forget(self) -> None:
        """Delete what was kept to go on from."""
        for folder in self._store.folders():
            delete(folder)
