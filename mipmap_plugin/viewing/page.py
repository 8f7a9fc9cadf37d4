"""The live view in a browser: viser serves the page, and this draws what its cameras see."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.formats.images import in_8_bits
from mipmap_plugin.limits import is_out_of_memory
from mipmap_plugin.viewing.adapting import Adapter, Live, Wish
from mipmap_plugin.viewing.controls import AS_TRAINED, DISTANCE, NOWHERE, Controls, plain
from mipmap_plugin.viewing.pace import STILL_S, Pace
from mipmap_plugin.viewing.screen import Pose, by_distance, by_lens, pose_of, up_of, zoomed
from mipmap_plugin.viewing.server import served, without_words
from mipmap_plugin.viewing.sources import of_adapted
from mipmap_plugin.viewing.stage import Look, Stage, free_name, smaller

OUT_OF_MEMORY = "out of memory; enlarge pixels, or make the window smaller"

# px of a canvas, in all and along a side: of a larger one fewer are drawn, and the browser enlarges them. A screen of 5K has 15 million; JPEG and
# the memory end soon after.
MOST_PIXELS, LONGEST_SIDE = 2**24, 2**14

# Views of an orbit that are looked at to find one to begin with, before the page is there.
LOOKED_AT = 16

# Of JPEG, while the camera moves; pictures that stay are PNGs, whose pixels are exact.
QUALITY = 80

# Seconds between two looks at what has changed, if nothing tells of a change; and after which the slider of zooms, once a hand has left
# it, follows the picture again.
PERIOD_S, HANDS_OFF_S = 0.05, 1.0


@dataclass(frozen=True)
class PageSettings:
    """What the page offers, and where it is served."""

    host: str
    port: int  # the first that is tried
    title: str
    viewers: Sequence[str | None]  # the chosen one first
    recipes: Sequence[str]
    output: Callable[[float, str | None], Path]  # scale and viewer of an adapted file -> a path that is free


@dataclass
class _Seen:
    """What a browser shows."""

    view: tuple[Pose, int, int] | None = None  # with the width and height of its canvas, px; None: nothing was drawn yet
    look: Look | None = None
    version: int = 0
    since: float = 0.0  # when the camera last moved
    whole: bool = False  # the picture has all its pixels


class Page:
    """The page of one scene. Raises SettingsError without viser, or for an address that cannot be served."""

    def __init__(self, stage: Stage, settings: PageSettings) -> None:
        self._stage, self._settings, self._pace = stage, settings, Pace()
        self._changed, self._version = threading.Event(), 0
        self._sliding, self._slid = threading.Lock(), 0.0  # one movement of the slider after the other; when the last one was
        self._slid_to: dict[int, Pose] = {}  # where it moved the camera of each browser, which reports that later
        self._slider_of: Any = None  # the browser in which it was moved, until its camera is where the slider says
        self._seen: dict[int, _Seen] = {}
        self.adapter = Adapter(stage.base, stage.reference, self._progressed)
        self._live = stage.add(Live(self.adapter))
        self._views = by_name(stage.base.views())
        self._server = served(settings.host, settings.port)
        self._prepare()

    @property
    def address(self) -> str:
        """Where the page is."""
        host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host  # of IPv6
        return f"http://{host}:{self._server.get_port()}"

    def run(self) -> None:
        """Draw until Ctrl-C."""
        while True:
            self._changed.wait(PERIOD_S)
            self._changed.clear()
            still = [self._tried(self._serve, number, client) for number, client in self._server.get_clients().items()]
            if all(still) and time.monotonic() - self._slid > HANDS_OFF_S:
                self._tried(self._settle)

    def _tried(self, work: Callable[..., bool | None], *of: Any) -> bool | None:
        """Call `work`. Its errors are shown on the page and do not end it, because other browsers use it, and a result may wait to be saved."""
        try:
            return work(*of)
        except Exception as error:
            expected = isinstance(error, MipmapPluginError)
            told = OUT_OF_MEMORY if is_out_of_memory(error) else plain(str(error) if expected else f"{type(error).__name__}: {error}")
            if not expected and told not in (OUT_OF_MEMORY, self._controls.figures.content):
                traceback.print_exc()
            self._controls.figures.content = told
            return False

    def close(self) -> None:
        """End a run that is adapting, and the server."""
        self.adapter.close()
        with without_words():
            self._server.stop()

    def _prepare(self) -> None:
        """Fill the panel, and say where a browser's camera begins."""
        server, settings = self._server, self._settings
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.set_panel_label(settings.title)
        server.gui.main_panel.dock_right()  # beside the picture, not on it
        viewers = [viewer or AS_TRAINED for viewer in settings.viewers]
        base, views = self._stage.base, list(self._views.values())
        view = views[0]
        if not base.cameras:  # an orbit begins high above, and a capture's with views through its walls
            best = base.viewpoints.best(evenly(views, LOOKED_AT))
            view = best[len(best) // 2]
        first, moment = self._pose(view), view.time or 0.0 if self._stage.base.model.traits.moves else None
        self._controls = Controls(server.gui, self._names(), viewers, list(self._views), settings.recipes, moment)
        vertical = None if base.cameras else base.viewpoints.orbit.up
        server.scene.set_up_direction(vertical or up_of(views))
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = first.position, first.look_at, first.fov
        server.on_client_connect(self._connected)
        controls = self._controls
        for element in filter(None, (controls.source, controls.against, controls.viewer, controls.pixel, controls.time)):
            element.on_update(lambda _: self._changed.set())
        controls.zoom.on_update(self._zoom)
        controls.view.on_update(self._go)
        controls.adapt.on_click(self._adapt)
        controls.stop.on_click(self._stop)
        controls.save.on_click(self._save)

    def _names(self) -> list[str]:
        """What can be shown now."""
        return [name for name in self._stage.sources if name != self._live or self.adapter.progress.running]

    def _connected(self, client: Any) -> None:
        client.camera.max_orbit_distance = float("inf")
        client.camera.on_update(lambda _: self._changed.set())
        self._changed.set()

    def _pose(self, view: Camera) -> Pose:
        return pose_of(view, self._stage.sampling.of(view).depth)

    def _serve(self, number: int, client: Any) -> bool:
        """Draw what a browser's camera sees if that has changed, coarsely while it moves, in full once it is still; return whether nothing had."""
        view, look, now, seen = _view(client), self._controls.look(), time.monotonic(), self._seen.get(number, _Seen())
        version = self._version
        is_same = (seen.view, seen.look, seen.version) == (view, look, version)
        if is_same and seen.whole:
            return True
        since = seen.since if seen.view == view else now
        _, width, height = view
        coarse = self._pace.fraction(width * height // look.pixel**2) if now - since < STILL_S else 1.0
        if is_same and coarse < 1:
            return False
        self._seen[number] = _Seen(view, look, version, since, coarse == 1)
        self._draw(client, look, view, coarse)
        return False

    def _draw(self, client: Any, look: Look, view: tuple[Pose, int, int], coarse: float) -> None:
        pose, width, height = view
        picture = self._stage.draw(look, pose.camera(width, height), coarse)
        self._pace.learn(picture.drawn.width * picture.drawn.height, picture.seconds)
        client.scene.set_background_image(in_8_bits(picture.image), format="png" if coarse == 1 else "jpeg", jpeg_quality=QUALITY)
        if coarse == 1:
            self._controls.tell_picture(picture)

    def _zoom(self, event: Any) -> None:
        """Move the camera whose slider was moved by hand."""
        if event.client is not None:
            self._slider_of = event.client
            self._slide(event.client)

    def _settle(self) -> None:
        """Once no hand is on the slider: move the camera again if it missed the slider's zoom, or else let the slider follow the picture."""
        client, self._slider_of = self._slider_of, None
        if client is None or not self._controls.is_missed():
            return self._controls.follow()
        self._slide(client)

    def _slide(self, client: Any) -> None:
        """Move a browser's camera to the zoom of the slider."""
        with self._sliding:
            number, now = client.client_id, time.monotonic()
            pose, width, height = _view(client)
            if now - self._slid < HANDS_OFF_S:  # the browser may not have reported the last movement yet
                pose = self._slid_to.get(number, pose)
            look, zoom = self._controls.look(), 2.0**self._controls.zoom.value
            screen = smaller(pose.camera(width, height), 1 / look.pixel)
            change = by_distance if self._controls.by.value == DISTANCE else by_lens
            self._slid, self._slid_to[number] = now, zoomed(pose, zoom, self._stage.sampling, screen.size, change)
            _move(client, self._slid_to[number])

    def _go(self, event: Any) -> None:
        """Move the camera to a view of the scene, and reset the list: viser does not report that the same entry is chosen again."""
        view = self._views.get(self._controls.view.value)
        if event.client is not None and view is not None:
            self._slider_of = None  # the new view has a zoom of its own
            _move(event.client, self._pose(view))
            self._controls.show_moment(view.time)
            self._controls.view.value = NOWHERE

    def _adapt(self, event: Any) -> None:
        """Adapt for what is on the screen of the browser whose button was pressed."""
        if event.client is None or self.adapter.progress.running:
            return
        (pose, width, height), look = _view(event.client), self._controls.look()
        screen = self._stage.camera(look, pose.camera(width, height))
        zoom = self._stage.sampling.of(screen).zoom
        wish = Wish(screen, pose.look_at, zoom, look.viewer, self._controls.seconds.value, self._controls.recipe.value)
        try:
            self.adapter.start(wish, self._ended)
        except SettingsError:  # another browser was quicker
            return
        self._controls.offer(self._names(), self._live)
        self._progressed()

    def _stop(self, _: Any) -> None:
        self.adapter.stop()
        self._controls.told.content = "stopping after the next step ..."

    def _progressed(self) -> None:
        """In the thread of a run: there is something new to tell and to draw."""
        self._controls.tell_progress(self.adapter.progress)
        self._version += 1
        self._changed.set()

    def _ended(self) -> None:
        """In the thread of a run: show what it returned, or else the base."""
        progress = self.adapter.progress
        shown = self._names()[0]
        if progress.adapted is not None and progress.wish is not None:
            name = f"adapted ×{progress.wish.scale:g}{f' for {progress.wish.viewer}' if progress.wish.viewer else ''}"
            shown = self._stage.add(of_adapted(name, progress.adapted, self._stage.base))
        self._controls.offer(self._names(), shown)
        self._progressed()

    def _save(self, _: Any) -> None:
        adapted = self.adapter.progress.adapted
        if adapted is None or self._controls.save.disabled:  # another browser was quicker
            return
        try:
            saved = adapted.save(self._settings.output(adapted.report.scale, adapted.report.viewer))
        except MipmapPluginError as error:
            self._controls.told.content = plain(str(error))
        else:
            self._controls.told.content = plain(f"saved: {saved}")
            self._controls.save.disabled = True


def by_name(views: Sequence[Camera]) -> dict[str, Camera]:
    """The views by their names; a name that is taken gets a number, as where training and test views are both called r_0."""
    named: dict[str, Camera] = {}
    for number, view in enumerate(views):
        named[free_name(view.name or f"view {number}", named)] = view
    return named


def _view(client: Any) -> tuple[Pose, int, int]:
    """The pose of a browser's camera, and the width and height of its canvas in px."""
    camera = client.camera
    wxyz, position, look_at = (tuple(map(float, each)) for each in (camera.wxyz, camera.position, camera.look_at))
    width, height = max(1, camera.image_width), max(1, camera.image_height)
    part = min(1.0, math.sqrt(MOST_PIXELS / (width * height)), LONGEST_SIDE / max(width, height))
    return Pose(wxyz, position, look_at, float(camera.fov)), max(1, int(part * width)), max(1, int(part * height))


def _move(client: Any, pose: Pose) -> None:
    """Move a browser's camera; what is upwards in its picture stays the scene's."""
    with client.atomic():
        client.camera.position = pose.position
        client.camera.look_at = pose.look_at
        client.camera.fov = pose.fov
