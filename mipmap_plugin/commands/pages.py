"""The report pages that the commands write: where they go, and what is on them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.common import this_command
from mipmap_plugin.formats.atomic import named, refuse_output, refuse_unwritable
from mipmap_plugin.formats.here import from_here

if TYPE_CHECKING:
    from mipmap_plugin.adaptation.adapted import Adapted
    from mipmap_plugin.evaluation.tradeoff.front import Tradeoff
    from mipmap_plugin.levels.contents import Contents
    from mipmap_plugin.levels.distance.manifest import DistanceContents
    from mipmap_plugin.pages.gallery import Gallery
    from mipmap_plugin.wrap import Wrapped


def look_at(page: Path) -> str:
    """The line that says where a page is."""
    return f"page: {from_here(page)}"


def evaluation_page_path(checkpoint: Path, output: Path | None) -> Path:
    """The page beside `output`, or else in this folder under a name that is free."""
    if output:
        return output.with_suffix(".html")
    free = (Path(f"{named(checkpoint).name}.evaluation{f'-{number}' if number > 1 else ''}.html") for number in count(1))
    return next(path for path in free if not os.path.lexists(path))


def write_evaluation_page(
    page: Path, checkpoints: Sequence[Path], galleries: Sequence[Gallery], rows: Sequence[Any], notes: Sequence[str], overwrite: bool
) -> None:
    """Write the page of an evaluation."""
    from mipmap_plugin.pages.html import write_page
    from mipmap_plugin.pages.reports import evaluation_page

    title = ", ".join(named(each).name for each in checkpoints)
    write_page(page, evaluation_page(title, galleries, rows, commands=(this_command(),), notes=notes), overwrite)


class AdaptationPage:
    """The page of `adapt`: beside the one file, or in the folder of several."""

    def __init__(self, checkpoint: Path, targets: Sequence[Path], overwrite: bool, *, all_finished: bool) -> None:
        """Raises now the errors that writing the page would raise: OutputExists and OutputError. `all_finished`: no file is made, so that a page
        that is there stays."""
        from mipmap_plugin.models.adapted_name import name_of
        from mipmap_plugin.models.places import PAGE_ENDING

        name, target, self.of_one = name_of(checkpoint), named(targets[0]), len(targets) == 1
        self.path = target.with_name(f"{target.name if self.of_one else f'{name}_adapted'}{PAGE_ENDING}")
        self._title, self._overwrite, self._zooms = name, overwrite, list[Any]()
        self.stays = all_finished and self.path.is_file()
        if not self.stays:
            refuse_output(self.path, overwrite, is_file=True)
            refuse_unwritable(self.path)

    def add(self, base: Wrapped, adapted: Adapted) -> None:
        """Draw the pictures of an adapted file, as it is written."""
        from mipmap_plugin.pages.reports import adaptation_zoom

        self._zooms.append(adaptation_zoom(base, adapted))

    def write(self, reports: Sequence[dict[str, Any]], before: Sequence[dict[str, Any]]) -> None:
        """Write the page, with a report for each file that was drawn, and those of files that were finished `before` an interruption."""
        from mipmap_plugin.pages.html import write_page
        from mipmap_plugin.pages.reports import adaptation_page

        titled = [{"title": zoom.label, **report} for zoom, report in zip(self._zooms, reports, strict=True)]
        write_page(self.path, adaptation_page(self._title, self._zooms, titled, (this_command(),), before), self._overwrite)


def tradeoff_page_path(folder: Path, overwrite: bool) -> Path:
    """The page in the folder of a tradeoff. Raises OutputExists."""
    from mipmap_plugin.models.places import PAGE

    refuse_output(folder / PAGE, overwrite, is_file=True)
    return folder / PAGE


def write_tradeoff_page(page: Path, checkpoint: Path, base: Wrapped, overwrite: bool, tradeoffs: Sequence[Tradeoff]) -> None:
    """Write the page of a tradeoff."""
    from mipmap_plugin.evaluation.tradeoff.files import facts
    from mipmap_plugin.pages.html import write_page
    from mipmap_plugin.pages.reports import tradeoff_page

    title = f"{named(checkpoint).name}: accuracy and time"
    write_page(page, tradeoff_page(title, base, facts(tradeoffs, complete=True), (this_command(),)), overwrite)


def write_levels_page(folder: Path, ladder: Contents | DistanceContents, title: str) -> Path:
    """Write the page of a ladder into its folder."""
    from mipmap_plugin.levels.distance.manifest import DistanceContents
    from mipmap_plugin.levels.manifest import read_manifest
    from mipmap_plugin.models.places import PAGE
    from mipmap_plugin.pages.html import write_page
    from mipmap_plugin.pages.levels import levels_page
    from mipmap_plugin.pages.walks import walks_page

    name, manifest, commands = f"{title}: levels", read_manifest(folder), (this_command(),)
    page = walks_page(name, ladder, manifest, commands) if isinstance(ladder, DistanceContents) else levels_page(name, ladder, manifest, commands)
    return write_page(folder / PAGE, page, overwrite=True)
