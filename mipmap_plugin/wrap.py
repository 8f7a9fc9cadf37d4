"""wrap_model(model).adapt(scale): test-time adaptation as a wrapper. The wrapped model never changes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict, Unpack

from mipmap_plugin.adaptation.adapted import Adapted as Adapted
from mipmap_plugin.adaptation.optimization.resume import Interrupted as Interrupted  # what `adapt` raises
from mipmap_plugin.adaptation.target.other_world import LOOK, doubt_about
from mipmap_plugin.adaptation.views.cameras_of_base import own_cameras, where
from mipmap_plugin.adaptation.views.placing import placed
from mipmap_plugin.adaptation.views.viewpoints import near_plane_for
from mipmap_plugin.backends import BACKENDS, device_for
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera, digest_of, of_base_scale
from mipmap_plugin.errors import MipmapPluginError, SettingsError, warn
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.frozen_base import RenderOptions as RenderOptions
from mipmap_plugin.levels.finished import Ladder
from mipmap_plugin.limits import check_background, check_kinds, check_names, path_of
from mipmap_plugin.models import load_model
from mipmap_plugin.models.adapted_scale import REMEDIES, exporter, known_up
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.models.live import adopt
from mipmap_plugin.process.threads import checked as checked_threads
from mipmap_plugin.process.torch_modes import in_usual_modes
from mipmap_plugin.scenes import Scene, load_scene
from mipmap_plugin.scenes.orbits import AXES
from mipmap_plugin.scenes.training_options import WIDTH_CAP
from mipmap_plugin.screen_filters import USUAL_EPS2D, check_screen_filter


class WrapOptions(TypedDict, total=False):
    """What is said of a checkpoint, where its files do not say it. None: as they say, or as is usual."""

    background: tuple[float, float, float] | None  # linear RGB; else black
    screen_filter: str | None  # that it was trained with: "classic", "antialiased", "mip", "analytic"; else classic
    up: str | None  # the axis that is up, for views that are generated: "x", "y", "z", "-x", "-y", "-z"; else these look from all around


class Wrapped(FrozenBase):
    """A frozen base model with its cameras, ready to be adapted to any scale and made into levels. It never changes."""

    doubted = False  # whether a warning told that the photographs show something else

    @in_usual_modes
    def levels(self, viewer: str, *, resume: str | Path | None = None, **options: Any) -> Ladder:
        """Return a ladder of levels (`levels.finished.Ladder`), to be saved with `save(folder)`.

        `options`: `coarsest`, `ratio`, `least_db`, `until_splats`, `recipe`, `by` (`levels.request.LadderRequest`), and settings of AdaptConfig for
        all levels. `resume`: a folder that keeps finished levels, to continue from. Raises as `adapt`.
        """
        from mipmap_plugin.levels.ladder import make_levels
        from mipmap_plugin.levels.request import LadderRequest

        return make_levels(self, LadderRequest.of(viewer, **options), resume)


@in_usual_modes
def wrap_model(
    model: SplatModel | str | Path | Any,
    *,
    cameras: Sequence[Camera] | Scene | str | Path | None = None,
    backend: str = "auto",
    threads: int | None = None,
    **options: Unpack[WrapOptions],
) -> Wrapped:
    """Wrap a loaded model, the checkpoint at a path, or another project's live model, which is copied (`models.live.adopt`).

    A checkpoint is loaded to the GPU if a backend serves it there (`backends.device_for`); a model stays on its device.

    `cameras`: views of the scale of its training, or the scene that it was trained on or its path; by default those beside the checkpoint,
    or in it, or those of the base of an adapted file.
    `threads`: to adapt with; by default as many as torch has. With the backend cpu the result does not depend on it.
    `options`: `background`, linear RGB, by default that of the checkpoint, or else black; `screen_filter`, that it was trained with, if its
    files do not say ("classic", "antialiased", "mip", "analytic"); `up`, the axis that is up ("z", "-y", ...), if they do not say: views that
    are generated, as there are no cameras, then look from above the horizon. Raises CheckpointError, SceneError, PluginError,
    ShapeError for tensors that do not fit together, and SettingsError for an unknown filter or axis, or an object that is not a model.
    """
    wrapped, scene = wrap_unchecked(model, cameras, backend, threads, **options)
    if cameras is not None and scene is not None:
        warn_of_others(wrapped, scene, wrapped.render)
    return wrapped


@in_usual_modes
def wrap_unchecked(
    model: SplatModel | str | Path | Any,
    cameras: Sequence[Camera] | Scene | str | Path | None,
    backend: str = "auto",
    threads: int | None = None,
    **options: Unpack[WrapOptions],
) -> tuple[Wrapped, Scene | None]:
    """`wrap_model` without comparing the base with photographs, of which a sample of its splats shows little; and its cameras' scene, if any."""
    check_names("wrap_model", options, WrapOptions, ("cameras", "backend", "threads"))
    check_serves(backend, threads)
    background, screen_filter, up = options.get("background"), options.get("screen_filter"), options.get("up")
    color = None if background is None else check_background(background)
    began = time.perf_counter()
    model = _loaded(model, backend) if isinstance(model, (str, Path)) else adopt(model)
    loading_s = time.perf_counter() - began
    vertical = known_up(model.source, model.trained.up) if up is None else axis_of(up)
    trained = replace(model.trained, background=color or model.trained.background, up=vertical)
    if screen_filter is not None:
        check_kinds(screen_filter=(screen_filter, str))
        check_screen_filter(screen_filter)
        trained = replace(trained, screen_filter=screen_filter, eps2d=USUAL_EPS2D[screen_filter])
    found, read_from = _found(model, cameras)
    given = found.cameras if isinstance(found, Scene) else found
    if up is not None and given:
        warn(f"up {up}: there are cameras, whose views are taken unless an orbit is asked for (views 'orbit'); only then it is of use")
    there = placed(model, found) if isinstance(found, Scene) else None
    if not given:
        trained = replace(trained, near_plane=near_plane_for(model, trained.near_plane))
    wrapped = Wrapped(model, there.cameras if there else given, backend, trained, threads)
    wrapped.loading_s, wrapped.asked, wrapped.cameras_from = loading_s, asked_for(model.folder, given, color, screen_filter, up), read_from
    return wrapped, there


def axis_of(up: str) -> tuple[float, float, float]:
    """The unit vector of an axis by name, such as "z" or "-y". Raises SettingsError."""
    if not isinstance(up, str) or up not in AXES:
        raise SettingsError(f"up must be the axis of the scene that is up, one of {', '.join(AXES)}, got {up!r}")
    return AXES[up]


def check_serves(backend: str, threads: int | None) -> None:
    """Raise SettingsError for a backend that does not exist, and for no number of threads, before anything is loaded."""
    if not isinstance(backend, str) or backend != "auto":
        BACKENDS.get(backend)
    if threads is not None:
        checked_threads(threads)


def _found(model: SplatModel, cameras: Sequence[Camera] | Scene | str | Path | None) -> tuple[Sequence[Camera] | Scene, dict[str, str]]:
    """The cameras that are given, those beside the model's file, or, of an adapted file, those of its base; and `where` they were read from."""
    if isinstance(cameras, (str, Path)):
        cameras = load_scene(path_of(cameras, "cameras"), read_options(model.folder)[0])
    if isinstance(cameras, Scene):
        if cameras.is_capture and (project := exporter(model.source)):
            frames = f"{model.source} is in the frame that {project} trained in, and {cameras.source} most often in another: views may show nothing"
            warn(f"{frames}; {REMEDIES[project]}")
        if doubt := _of_unknown_size(model, cameras):
            warn(doubt)
        return cameras, where(cameras.source, model.folder)
    if cameras is not None:
        return of_base_scale(cameras), {}
    return own_cameras(model.source, model.folder)


def _of_unknown_size(model: SplatModel, scene: Scene) -> str:
    """That a capture has larger views than many trainings take, and no file says the size of this model's, in a sentence; "" else."""
    largest = max(scene.cameras, key=lambda camera: camera.width, default=None)
    if largest is None or largest.width <= WIDTH_CAP or not scene.is_capture or model.traits.placed or read_options(model.folder)[0]:
        return ""
    size = f"{scene.source} has views of {largest.width} x {largest.height} px, which is taken to be the size of the training"
    smaller = f"unless told otherwise 3DGS makes them {WIDTH_CAP} px wide, and Brush at most 1920 px long"
    return f"{size}, but {smaller}: if it was so, give a copy of the scene whose folder images has the photographs at that size"


def warn_of_others(wrapped: Wrapped, scene: Scene, render: Callable[..., Rendered]) -> None:
    """Warn if the photographs of the scene whose cameras are given, in the model's frame, do not show what it does, as drawn by `render`."""
    color, exposures = wrapped.background, wrapped.model.traits.exposures
    wrapped.compared |= scene.photographed()
    try:
        doubt = doubt_about([*scene.images], lambda camera: scene.image(camera, color, LOOK), render, color, "--cameras", exposures)
    except MipmapPluginError:  # such as a damaged photograph, which cameras do without
        return
    if doubt:
        wrapped.doubted = True
        warn(doubt)


def asked_for(
    folder: Path | None, cameras: Sequence[Camera], background: tuple[float, float, float] | None, screen_filter: str | None, up: str | None
) -> dict[str, str]:
    """What is given beside a checkpoint, as its adaptations record it (`Report.inputs`). `cameras`: before they are placed in the model's frame.

    `folder`: of the model; the options of its training (cfg_args) say how the base looks, and its hash is that of the splats alone.
    """
    color = "" if background is None else " ".join(f"{channel:g}" for channel in background)
    options = {name: value for name, value in read_options(folder)[0].items() if not isinstance(value, str)}  # but paths
    digest = sha256(json.dumps(options, sort_keys=True, default=str).encode()).hexdigest() if options else ""
    vertical = {} if up is None else {"up": up}  # files of before the option stay those of a job without it
    return {"cameras": digest_of(cameras), "background": color, "screen filter": screen_filter or "", "options": digest} | vertical


def _loaded(path: str | Path, backend: str) -> SplatModel:
    model, device = load_model(path), device_for(backend)
    return model if device == "cpu" else model.to(device)
