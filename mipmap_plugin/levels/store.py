"""The folder of an unfinished ladder: the levels that are ready, so that the same command goes on where it was interrupted."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.camera import digest_of
from mipmap_plugin.errors import MipmapPluginError, SettingsError, brief
from mipmap_plugin.formats.atomic import json_text, refuse_unwritable, settled, sha256, staged, write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import Filtered, SplatModel, digest_of_model
from mipmap_plugin.models.places import MANIFEST, REPORT, STATE, state_path
from mipmap_plugin.process.versions import versions
from mipmap_plugin.progress import announced

# Written before the first level: what was broken off earlier leaves the state of a run at most.
REQUEST = "request.json"

# Written once the ladder is, which further files may still be made from.
OUTCOME = "written.json"

# The name of a run's state, or of the lock beside it.
IS_STATE = re.compile(rf"\.?level_.*{re.escape(STATE)}.*").fullmatch


class LevelStore:
    """Finished levels of one ladder in a folder; without a folder nothing is kept."""

    def __init__(self, folder: Path | None, base: FrozenBase, request: LadderRequest) -> None:
        """Raises SettingsError for a folder with levels of another ladder, SceneError for a damaged one."""
        self._folder, self._base, self._target = folder, base, base.target(request.viewer)
        if folder is None:
            return
        self._facts = json.loads(json_text(_facts(base, request)))
        self._refuse_others(settled(folder))

    def _refuse_others(self, folder: Path) -> None:
        """Raise what `__init__` raises. The state of a run, which says itself what it belongs to, is no level yet."""
        file = settled(folder / REQUEST)
        if folder.exists() and any(each.name != REQUEST and not IS_STATE(each.name) for each in folder.iterdir()):
            if not file.is_file():
                raise SettingsError(f"{folder}: unfinished ladders are kept there, but it has other things in it; choose another output")
            if read_json(file) != self._facts:
                others = "levels of another base, viewer or settings, or of another version"
                raise SettingsError(f"{folder}: holds {others}; repeat the run with those, or delete it")

    def level(self, name: str, make: Callable[[Path | None], Adapted]) -> Adapted:
        """The level of that name from the folder, or else the one that `make` returns for the path of the state of its run, kept from now on.

        Raises OutputError, and what `__init__` raises for a folder in which another run has kept levels meanwhile.
        """
        if self._folder is None:
            return replace(make(None), judge=None)  # a level is written as a PLY, which rounds nothing that is to be measured
        file = self._folder / f"{name}.ply"
        if not file.with_name(file.name + REPORT).is_file():
            refuse_unwritable(file)
            made = make(state_path(file))
            self._refuse_others(self._folder)
            write_json(self._folder / REQUEST, self._facts, overwrite=True)
            made.save(file, overwrite=True)
        with announced(f"reading {file.name}"):
            return self._loaded(file)

    def note(self, written: Path) -> None:
        """Keep which ladder is `written` of the levels, so that the same command may replace it (`is_of`)."""
        if self._folder is not None:
            write_json(self._folder / OUTCOME, {MANIFEST: sha256(staged(written / MANIFEST))}, overwrite=True)

    def folders(self) -> list[Path]:
        """The folder, if there is one."""
        return [] if self._folder is None else [self._folder]

    def _loaded(self, file: Path) -> Adapted:
        """A level as it is in its file. Every level is read, also one just made, so that a ladder is the same whether it was interrupted or not."""
        try:
            report = Report.model_validate(read_json(file.with_name(file.name + REPORT)))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what there is to say of its splats was said of the base's
                read = load_model(file)
        except (ValueError, MipmapPluginError) as error:
            raise SettingsError(f"{file}: this level of an unfinished ladder is damaged ({brief(error)}); delete its folder to start anew") from error
        plain: SplatModel = cast(Filtered, read).bare() if read.traits.filtered else read  # the filter of a file for Mip-Splatting is 0
        model = plain.to(self._base.model.parameters()["means"].device)
        near_plane = self._base.model.trained.near_plane  # of the training: that of a small scene without cameras is nearer in `trained`
        model.trained = replace(self._base.trained.drawn_with(self._target), near_plane=near_plane)
        backend, _ = self._base.backend(viewer=report.viewer)
        return Adapted(model, report, backend, self._target, {str(report.viewer): self._target}, cameras=self._base.views())


def is_of(unfinished: Path, ladder: Path) -> bool:
    """Whether a ladder was written of the levels in the folder `unfinished`, and has not changed since."""
    try:
        return bool(read_json(unfinished / OUTCOME) == {MANIFEST: sha256(ladder / MANIFEST)})
    except (MipmapPluginError, OSError):
        return False


def _facts(base: FrozenBase, request: LadderRequest) -> dict[str, Any]:
    """Everything that the levels depend on."""
    of_base = {"base": digest_of_model(base.model), "trained": str(base.trained), "background": base.background}
    made_with = {"backend": base.backend(viewer=request.viewer)[0].name, "versions": versions()}
    return {**of_base, "cameras": digest_of(base.cameras), "request": request.facts(), **made_with}
