"""Adapts for what is on a screen in a thread of its own, shows each state on request, and can be stopped."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import psnr_as_shown
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.viewing.around import middle, views_for_screen
from mipmap_plugin.viewing.sources import File, Request, Supersampled
from mipmap_plugin.wrap import Wrapped

# Seconds between two points of the curve; seconds to wait for a picture of a run, which may be busy with something else.
MEASURED_EVERY_S, PATIENCE_S = 0.7, 1.5

# px: the screen's picture is measured on at most this many, around its middle.
MEASURED_PIXELS = 200_000

# Fewer than usual, because the user is waiting.
VALIDATION_VIEWS = 10

# A zoom that differs from x1 by less is x1.
SAME_ZOOM = 0.03

# Seconds to wait at the end of the program for a run to end after its next step, and then for it to end where it is.
GRACE_S, LAST_GRACE_S = 2.0, 20.0


@dataclass(frozen=True)
class Wish:
    """What to adapt for."""

    screen: Camera  # of the new scale
    look_at: tuple[float, ...]  # the point that the eye turns around, world units
    zoom: float  # of the screen, relative to the training
    viewer: str | None
    seconds: float  # at most
    recipe: str = "default"

    @property
    def scale(self) -> float:
        """The scale of the file: the zoom, rounded."""
        return 1.0 if abs(math.log(self.zoom)) < SAME_ZOOM else float(f"{self.zoom:.3g}")


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    wish: Wish | None = None  # None: nothing was adapted yet
    running: bool = False
    step: int = 0
    curve: tuple[tuple[float, float], ...] = ()  # seconds of adapting, dB of the screen's picture against the supersampled base
    base_db: float | None = None  # of the base as the viewer draws it; None: not measured yet
    adapted: Adapted | None = None
    trouble: str = ""  # why there is none, in a sentence


class Adapter:
    """One run at a time. The base never changes; `as_it_is` shows it."""

    def __init__(self, base: Wrapped, reference: Supersampled, changed: Callable[[], None] = lambda: None) -> None:
        """`changed` is called, in the thread of the run, whenever `progress` is new."""
        self._base, self._reference, self.as_it_is, self._changed = base, reference, File("base", base), changed
        self.progress = Progress()
        self._thread: threading.Thread | None = None
        self._warm = set[str | None]()  # the viewers that were adapted for before
        self._starting, self._stopping = threading.Lock(), threading.Event()
        self._asked: Camera | None = None  # whose picture somebody waits for
        self._answer: tuple[Camera, Tensor] | None = None  # the last picture, and whose it is
        self._stepping = False  # the run takes steps, and answers between them
        self._talk = threading.Condition()  # guards these three

    def start(self, wish: Wish, then: Callable[[], None] = lambda: None) -> None:
        """Begin a run, and call `then` in its thread when it has ended. Raises SettingsError while one is running."""
        with self._starting:  # two browsers may ask at once
            if self.progress.running:
                raise SettingsError("an adaptation is running; stop it first")
            self._stopping.clear()
            with self._talk:
                self._answer, self._stepping = None, False
            self.progress = Progress(wish, running=True)
        self._thread = threading.Thread(target=self._run, args=(wish, then), name="adapting", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the run after its next step; what it then returns is the best of its states, as always."""
        self._stopping.set()

    def close(self) -> None:
        """End the run with the program: after its next step or, if that takes long, in the middle of it, without a result."""
        self.stop()
        if self._thread is None:
            return
        self._thread.join(GRACE_S)
        if self._thread.is_alive():  # a thread that still computes when Python ends makes it crash
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread.ident or 0), ctypes.py_object(SystemExit))
            self._thread.join(LAST_GRACE_S)

    def picture(self, camera: Camera) -> Tensor | None:
        """What a camera of the new scale sees of the run's state, [H, W, 3]; None while no step is taken, unless it was drawn before."""
        with self._talk:
            if self._stepping:
                self._asked = camera
                self._stepping = self._talk.wait_for(lambda: self._asked is not camera or not self.progress.running, PATIENCE_S)
            return self._answer[1] if self._answer is not None and alike(self._answer[0], camera) else None

    def _run(self, wish: Wish, then: Callable[[], None]) -> None:
        try:
            self._set(adapted=self._adapt(wish), running=False)
        except (MipmapPluginError, MemoryError) as error:
            self._set(trouble=str(error) or "out of memory", running=False)
        except Exception as error:
            self._set(trouble=f"{type(error).__name__}: {error}", running=False)
            raise
        except SystemExit:  # of `close`
            self._set(running=False)
        finally:
            with self._talk:
                self._talk.notify_all()
            then()

    def _adapt(self, wish: Wish) -> Adapted:
        views = views_for_screen(self._base, wish.screen, torch.tensor(wish.look_at, dtype=torch.float64), wish.scale)
        options: dict[str, Any] = {"recipe": wish.recipe, "viewer": wish.viewer, "views": "given", "validation_views": VALIDATION_VIEWS}
        if wish.viewer not in self._warm:  # one step, so that the time to compile kernels for this viewer is not that of the run
            self._base.adapt(wish.scale, cameras=views[:1], steps=1, **options)
            self._warm.add(wish.viewer)
        return self._base.adapt(wish.scale, cameras=views, observe=self._observer(wish), time_budget_s=wish.seconds, **options)

    def _observer(self, wish: Wish) -> Callable[[int, float, Callable[[Camera], Tensor]], bool]:
        """A function that the run calls after each step: it draws a picture that is waited for, and now and then measures that of the screen."""
        judged = middle(wish.screen, MEASURED_PIXELS)
        request = Request(judged, wish.zoom, wish.viewer)
        truth, measured = self._reference.render(request).clamp(0, 1), -math.inf
        self._set(base_db=psnr_as_shown(self.as_it_is.render(request), truth))

        @torch.no_grad()
        def observe(step: int, seconds: float, render: Callable[[Camera], Tensor]) -> bool:
            nonlocal measured
            self._answer_with(render)
            if step == 0 or time.monotonic() - measured > MEASURED_EVERY_S:
                self._set(step=step, curve=(*self.progress.curve, (seconds, psnr_as_shown(render(judged), truth))))
                measured = time.monotonic()
            return self._stopping.is_set()

        return observe

    def _answer_with(self, render: Callable[[Camera], Tensor]) -> None:
        with self._talk:
            camera, self._stepping = self._asked, True
        if camera is None:
            return
        answer = camera, render(camera)
        with self._talk:
            self._answer = answer
            if self._asked is camera:
                self._asked = None
            self._talk.notify_all()

    def _set(self, **changes: object) -> None:
        self.progress = replace(self.progress, **changes)  # type: ignore[arg-type]  # mypy does not check these names
        self._changed()


def alike(one: Camera, other: Camera) -> bool:
    """Whether two cameras give the same picture."""
    same = one.size == other.size and (one.fx, one.fy, one.time) == (other.fx, other.fy, other.time)
    return same and torch.equal(one.viewmat, other.viewmat)


class Live:
    """The state of a run, as something that can be shown; the base while there is none."""

    name = "adapting"

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter

    def render(self, request: Request) -> Tensor:
        """The picture, [H, W, 3], as the viewer draws it that the run is for."""
        image = self._adapter.picture(request.camera) if self._adapter.progress.running else None
        return self._adapter.as_it_is.render(request) if image is None else image

    def shown(self, zoom: float) -> str:
        """The step."""
        return f"adapting, step {self._adapter.progress.step}"

    def splats(self, request: Request) -> None:
        """Not known while a run changes them."""
