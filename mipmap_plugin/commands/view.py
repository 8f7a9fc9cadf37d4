"""`mipmap-plugin view`."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mipmap_plugin.commands.common import base_cameras, starting, wrap
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.types import BackendName, Background, Cameras, Checkpoint, ScreenFilter, Threads, Up, Viewer
from mipmap_plugin.commands.voice import say
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import named, refuse_unwritable
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.viewing.page import Page, PageSettings
    from mipmap_plugin.wrap import Wrapped

# The variables that say where windows are shown; elsewhere than on Linux there is a display.
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


def view(
    checkpoint: Checkpoint,
    adapted: tyro.conf.Positional[tuple[Path, ...]] = (),
    viewer: Viewer | None = None,
    output: Path | None = None,
    cameras: Cameras = None,
    up: Up = None,
    background: Background = None,
    screen_filter: ScreenFilter = None,
    backend: BackendName = "auto",
    threads: Threads = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    browser: bool = True,
) -> None:
    """Show a checkpoint in the browser at any zoom, beside adapted files and levels, and adapt it for what is on the screen.

    Args:
        checkpoint: A PLY, .spz, .sog, .splat or .glb, or a model folder: the base.
        adapted: Files adapted from it, and folders of levels, to switch to.
        viewer: Viewer whose drawing is shown first: classic, spark, playcanvas (or supersplat), ... An unknown name lists all viewers.
        output: Folder for what the page's button saves; by default beside the checkpoint. Nothing is overwritten.
        host: Address that the page is served at. Whoever reaches it can use the page; the default is this machine alone.
        port: Port of the page; where it is taken, the next free one.
        browser: Also open the page, where there is a display.
    """
    with starting():
        from mipmap_plugin.process import threads as all_threads
        from mipmap_plugin.viewing.page import PageSettings

    if not 0 <= port <= 65535:
        raise SettingsError(f"port: must be from 0 to 65535, got {port}")
    if output is not None and output.exists() and not output.is_dir():
        raise SettingsError(f"{output} is no folder, which the page could save to; give --output a folder")
    if output is not None:
        refuse_unwritable(output / checkpoint.name)
    wrapped = wrap(Base(checkpoint, cameras, background, backend, screen_filter, up), threads)
    if viewer is not None:
        wrapped.target(viewer)  # raises before any work
    with all_threads.limited(threads, shared=False):
        name = named(checkpoint).name
        page = _page(wrapped, adapted, backend, PageSettings(host, port, name, *_choices(wrapped, viewer), _free(checkpoint, output)))
        try:
            taken = "" if port == 0 or page.address.endswith(f":{port}") else f" (port {port} is taken)"
            say(f"{page.address} shows {name}{taken}; Ctrl-C ends it")
            if place := base_cameras(wrapped, cameras):
                say(f"its views are those of its base, in {place}; --cameras gives others")
            if browser and has_display():
                webbrowser.open(page.address)
            page.run()
        except KeyboardInterrupt:
            say("ended")
        finally:
            page.close()


def _page(wrapped: Wrapped, adapted: tuple[Path, ...], backend: str, settings: PageSettings) -> Page:
    from mipmap_plugin.viewing.page import Page
    from mipmap_plugin.viewing.sources import File, Source, Supersampled, open_source
    from mipmap_plugin.viewing.stage import Stage

    sources: list[Source] = [File("base", wrapped)]
    for path in adapted:
        with announced(f"reading {path.name}"):
            sources.append(open_source(path, wrapped, backend))
    return Page(Stage(wrapped, sources, Supersampled("base, supersampled", wrapped)), settings)


def _choices(wrapped: Wrapped, viewer: str | None) -> tuple[list[str | None], list[str]]:
    """The viewers and the recipes that the page offers, what is asked for first."""
    from mipmap_plugin.models.base import why_no_viewer
    from mipmap_plugin.recipes import RECIPES
    from mipmap_plugin.splatting.viewers import own_name, single_viewers

    single = [] if why_no_viewer(wrapped.model) else single_viewers()
    others = [name for name in single if viewer is None or name != own_name(viewer)]
    return list(dict.fromkeys((viewer, None, *others))), list(dict.fromkeys(("default", *RECIPES.names())))


def _free(checkpoint: Path, output: Path | None) -> Callable[[float, str | None], Path]:
    """A function that names the file of an adaptation by its scale and viewer, with a number where there is such a file already."""

    def path(scale: float, viewer: str | None) -> Path:
        usual = adapted_path(checkpoint, None, scale, viewer, several=False)
        head, made_for, suffix = usual.name.rpartition(f"_x{scale:g}{f'_{viewer}' if viewer else ''}")
        names = (f"{head}{made_for}{f'_{number}' if number > 1 else ''}{suffix}" for number in count(1))
        return next(each for each in (Path(output or usual.parent, name) for name in names) if not os.path.lexists(each))

    return path


def has_display() -> bool:
    """Whether there is a display that a browser can open a window on."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)
