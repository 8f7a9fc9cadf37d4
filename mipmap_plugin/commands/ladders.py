"""What `mipmap-plugin levels` writes: a ladder, and what viewers open of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.pages import write_levels_page
from mipmap_plugin.errors import MipmapPluginError, OutputError, SettingsError, warn
from mipmap_plugin.formats.atomic import settled
from mipmap_plugin.formats.splat_transform import LOD_META, refuse_exchange
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.levels.contents import Contents
    from mipmap_plugin.levels.distance.manifest import DistanceContents
    from mipmap_plugin.levels.request import LadderRequest
    from mipmap_plugin.wrap import Wrapped


# An orbit has pixels of its own size, so that a viewer would change levels at other distances: of lego_100 at an eleventh of them.
NO_CAMERAS = "no cameras are known: a viewer would change levels at the distances of a generated orbit; give the scene's cameras (--cameras)"


@dataclass(frozen=True)
class Exports:
    """What is written besides the levels."""

    streamed_sog: bool
    tiles: bool
    canvas: int | None  # px; None: the usual one
    title: str | None = None  # of the report page; None: no page

    def check(self, output: Path) -> None:
        """Raise SettingsError for an impossible canvas or one of nothing, or if splat-transform is needed and not installed, or too old."""
        if self.canvas is not None and self.canvas < 1:
            raise SettingsError(f"canvas: must be at least 1 px, got {self.canvas}")
        if self.canvas is not None and not (self.streamed_sog or self.tiles):
            raise SettingsError("--canvas is for the distances of Streamed SOG and 3D Tiles; give --streamed-sog or --tiles, or leave --canvas out")
        if self.streamed_sog or self.tiles:
            refuse_exchange(output)  # where it is not installed
            refuse_exchange(output / (LOD_META if self.streamed_sog else "tiles.spz"))  # where it is too old

    def write(self, ladder: Path, contents: Contents | DistanceContents) -> list[Path]:
        """Write them into the folder of a ladder; return the files that viewers open, and the page at last."""
        from mipmap_plugin.levels.manifest import CANVAS
        from mipmap_plugin.levels.streamed import write_streamed
        from mipmap_plugin.levels.tiles import write_tiles

        page = []
        if self.title is not None:
            with announced("drawing the page"):
                page = [write_levels_page(ladder, contents, self.title)]
        canvas = self.canvas or CANVAS
        streamed = [write_streamed(ladder, canvas)] if self.streamed_sog else []
        return streamed + ([write_tiles(ladder, canvas)] if self.tiles else []) + page


def saved(wrapped: Wrapped, request: LadderRequest, output: Path, exports: Exports, overwrite: bool) -> tuple[dict[str, Any], list[Path]]:
    """Make and save a ladder; return its manifest and what was written besides the levels. Raises OutputExists and SettingsError at once, but for
    Streamed SOG of a ladder that comes out as a single level, because that has few enough splats or no other is of use."""
    from mipmap_plugin.levels.ladder import make_levels, refuse_no_viewer
    from mipmap_plugin.levels.manifest import read_manifest, refuse_ladder
    from mipmap_plugin.levels.room import room_for
    from mipmap_plugin.levels.store import is_of
    from mipmap_plugin.levels.streamed import SINGLE_LEVEL
    from mipmap_plugin.models.outputs import refuse_far
    from mipmap_plugin.models.places import state_path
    from mipmap_plugin.process import threads

    unfinished = settled(state_path(output))
    overwrite = overwrite or is_of(unfinished, output)
    refuse_no_viewer(wrapped.model)
    refuse_ladder(output, wrapped, overwrite=overwrite)
    with announced("planning the levels"):
        refuse_ladder(output, wrapped, overwrite=overwrite, room=room_for(wrapped, request, unfinished))
        bound = _ends_at_once(wrapped, request) if exports.streamed_sog else ""
    if bound:
        raise SettingsError(f"{SINGLE_LEVEL}; give a smaller {bound}, or leave --streamed-sog out")
    if exports.tiles:
        refuse_far(output, wrapped.model.parameters(), "leave --tiles out")
    if not wrapped.cameras:
        warn(NO_CAMERAS)
    with _kept(unfinished):
        ladder = make_levels(wrapped, request, resume=unfinished)
    if exports.streamed_sog and len(ladder.levels) == 1:
        # Other numbers would make another ladder, and a smaller --coarsest may make more levels that are left out.
        raise SettingsError(f"{SINGLE_LEVEL}; leave --streamed-sog out, which goes on from what is made")
    with _kept(unfinished), announced(f"writing {output.name}"):
        folder = ladder.save(output, overwrite=overwrite, keep_resume=True)  # an export may fail after minutes, and the levels took longer
    try:
        with threads.limited_for(wrapped.backend()[0], wrapped.threads):
            files = exports.write(folder, ladder.contents)
    except (KeyboardInterrupt, MipmapPluginError) as error:
        again = f"{folder} has the levels, and the same command goes on from these"
        raise type(error)(f"{str(error) or 'interrupted'}; {again}") from error
    ladder.forget()
    return read_manifest(folder), files


@contextmanager
def _kept(unfinished: Path) -> Iterator[None]:
    """An interruption, and an output that cannot be written, such as to a full disk, say that the finished levels are kept."""
    try:
        yield
    except (KeyboardInterrupt, OutputError) as error:
        within = isinstance(error, KeyboardInterrupt) and str(error)  # a level's steps, where it says more
        if within or not any(unfinished.glob("level_*.ply")):
            raise
        again = f"run the same command again to go on with the levels that {unfinished} keeps"
        raise type(error)(f"{str(error) or 'interrupted'}; {again}") from error


def _ends_at_once(wrapped: Wrapped, request: LadderRequest) -> str:
    """The option for which a ladder will have one level, as far as that is known before any work; "" if it will have more."""
    if request.until_splats is not None and len(wrapped.model.parameters()["means"]) <= request.until_splats:
        return "--until-splats"
    band = request.first_band(wrapped)
    return "--coarsest" if band.reaches(request.coarsest) else ""
