"""`mipmap-plugin render`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from mipmap_plugin.commands.common import base_cameras, wrap
from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.commands.types import BackendName, Background, Cameras, Checkpoint, OwnScale, Up, Viewer
from mipmap_plugin.commands.voice import note, say
from mipmap_plugin.errors import SettingsError, plural, warn
from mipmap_plugin.formats.atomic import refuse_output, refuse_unwritable, settled, sha256, staged, together, write_json
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.progress import counted
from mipmap_plugin.screen_filters import Name

if TYPE_CHECKING:
    from mipmap_plugin.backends.base import Rendered
    from mipmap_plugin.camera import Camera
    from mipmap_plugin.wrap import RenderOptions, Wrapped

# Endings of pictures, which no folder is called by.
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")

# What a picture has beside it on request.
OUTPUTS = ("depth", "normals")

# The file in the folder of the pictures that has, until all are there, the sha256 of each that is finished; by a hash of what they depend on.
RECORD = "render_{}.resume"


def render(
    checkpoint: Checkpoint,
    output: Path,
    scale: OwnScale = None,
    view: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    time: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    screen_filter: Literal["trained", "scaled"] | Name = "trained",
    viewer: Viewer | None = None,
    supersampling: int = 1,
    filter_3d: bool = False,
    depth: bool = False,
    normals: bool = False,
    exposure: bool = False,
    cameras: Cameras = None,
    up: Up = None,
    background: Background = None,
    backend: BackendName = "auto",
    overwrite: bool = False,
) -> None:
    """Render views of a checkpoint as PNG files, optionally with depth and normals.

    Args:
        checkpoint: A PLY, .spz, .sog, .splat or .glb, or a model folder.
        output: The folder for the pictures.
        scale: Zoom, relative to the cameras; by default the scale that the file was adapted to, or else 1.
        view: Name of a view, or of its picture; may be given several times. By default all test views, or all if there are none.
        time: Moment of a moving scene, 0 to 1, in place of those of the views; given several times: each view at each moment.
        screen_filter: trained: the filter of the checkpoint's training; scaled: the training-free filter for this scale.
        viewer: Render as this viewer (an unknown name lists all): classic, spark, ... By default the file's own, unless a screen filter is given.
        supersampling: N for N x N samples per pixel. The screen filter keeps its size: the exact picture of a zoom-out needs scaled, too.
        filter_3d: Smooth every splat to the finest detail that the cameras could resolve, as Mip-Splatting's 3D filter does.
        depth: Also write NAME_depth.npy, [height, width] float32: world units along the optical axis, 0 where there is nothing.
        normals: Also write NAME_normals.npy, [height, width, 3] float32: unit vectors in world axes, 0 where there is nothing.
        exposure: Apply the exposure of each view's photograph, if the training learned one (exposure.json of 3DGS).
        overwrite: Replace pictures that exist.
    """
    output, wrapped = _folder(output), wrap(Base(checkpoint, cameras, background, backend, up=up))
    zoom, views = _zoom(wrapped, scale), _at_times(wrapped, _named(wrapped, view), time)
    filter_name = None if screen_filter == "trained" else screen_filter
    own_viewer = _own_viewer(wrapped) if viewer is None and filter_name is None else None
    viewer = viewer or own_viewer
    if viewer is not None:
        wrapped.effects(zoom, filter_name, supersampling, viewer)  # check the options before any work
        if own_viewer is None:
            _tell_if_not_drawn(wrapped, viewer)
    outputs = [name for name, requested in zip(OUTPUTS, (depth, normals), strict=True) if requested]
    told = [replace(camera, name=f"{camera.name}_t{camera.time:g}") for camera in views] if len(time) > 1 else views
    pictures = [output / name for name in picture_names(told)]
    # Samples are clamped as `evaluate` clamps them, except those that an exposure may still bring into the range of a picture.
    options: RenderOptions = {"viewer": viewer, "filter_3d": filter_3d, "outputs": outputs, "exposure": exposure, "clamped": not exposure}
    record = output / RECORD.format(_hash(wrapped, views, (zoom, filter_name, supersampling, backend, options)))
    finished = _finished(record, pictures, outputs)
    left = [(view, picture) for view, picture in zip(views, pictures, strict=True) if picture.name not in finished]
    _refuse(wrapped, [picture for _, picture in left], outputs, overwrite)
    _check(wrapped, views, exposure)
    with _kept(record, finished):
        for camera, picture in counted(left, len(left), "rendering", "view"):
            _write(picture, wrapped.render(camera.zoomed(zoom), zoom, filter_name, supersampling, **options), outputs, overwrite, record, finished)
    say(f"{plural(len(views), 'picture')} in {output}{_told_by_file(zoom if scale is None else 1.0, own_viewer)}")
    _tell_of_cameras(wrapped, cameras)


def _tell_of_cameras(wrapped: Wrapped, given: Path | None) -> None:
    """Say where the views come from, unless it is the scene itself."""
    if not wrapped.cameras:
        say(f"seen from a generated orbit, {wrapped.viewpoints.orbit.told()}; --cameras gives the scene's own cameras")
    if place := base_cameras(wrapped, given):
        say(f"seen by the cameras of its base, in {place}; --cameras gives others")


def _tell_if_not_drawn(wrapped: Wrapped, viewer: str) -> None:
    """Warn of splats that no viewer draws: their pictures have its settings all the same."""
    from mipmap_plugin.models.base import why_no_viewer

    if reason := why_no_viewer(wrapped.model):
        warn(f"{viewer}: {reason}; the pictures show what its settings would make of these splats")


def _told_by_file(scale: float, viewer: str | None) -> str:
    """What the file alone decided about its pictures, to be appended to a sentence: the scale, unless it is 1, and the viewer."""
    taken = ([f"at x{scale:g}"] if scale != 1 else []) + ([f"in {viewer}"] if viewer else [])
    return f", {' '.join(taken)}, which the file was adapted for" if taken else ""


def _check(wrapped: Wrapped, views: Sequence[Camera], exposure: bool) -> None:
    """Raise the error of a view without an `exposure`; warn of views that show nothing, or a speck, which are written all the same."""
    if exposure:
        for camera in views:
            wrapped.model.traits.exposures.of(camera)
    try:
        wrapped.refuse_undrawn(views)
    except SettingsError as error:
        warn(str(error))


def _at_times(wrapped: Wrapped, views: Sequence[Camera], times: Sequence[float]) -> list[Camera]:
    """The views at each of the times; the views as they are without times. Raises SettingsError."""
    if not times:
        return list(views)
    if not wrapped.model.traits.moves:
        raise SettingsError("time: nothing moves in this scene, so that it looks the same at all times; leave it out")
    if wrong := [time for time in times if not 0 <= time <= 1]:
        raise SettingsError(f"time: must be from 0 to 1, got {wrong[0]:g}")
    return [replace(view, time=time) for view in views for time in times]


def _zoom(wrapped: Wrapped, scale: float | None) -> float:
    """The scale asked for, or else the one that the file was adapted to, or else 1."""
    from mipmap_plugin.models.adapted_scale import adapted_scale

    return scale or adapted_scale(wrapped.model.source) or 1.0


def _own_viewer(wrapped: Wrapped) -> str | None:
    """The viewer that the file was adapted for; None for a base, and for a file for several viewers, whose header names a filter.

    Raises SettingsError for one that is not known here: it is of a package.
    """
    from mipmap_plugin.models.adapted_scale import adapted_viewer
    from mipmap_plugin.splatting.viewers import VIEWERS, viewers_for

    viewer = adapted_viewer(wrapped.model.source)
    if viewer and viewer not in VIEWERS.names():
        remedy = "install the package that adds it, or give another one (--viewer) or a screen filter (--screen-filter)"
        raise SettingsError(f"{wrapped.model.source} was adapted for the viewer {viewer!r}, which is not installed here; {remedy}")
    return viewer if viewer and len(viewers_for(viewer)) == 1 else None


def _folder(output: Path) -> Path:
    """The folder for the pictures. Raises SettingsError for what is the name of one picture."""
    if output.suffix.lower() in PICTURES and not output.is_dir():
        raise SettingsError(f"{output}: pictures are written to a folder, each by the name of its view; give the folder")
    return output


def _hash(wrapped: Wrapped, views: Sequence[Camera], how: tuple[Any, ...]) -> str:
    """A hash of everything that the pictures depend on."""
    from mipmap_plugin.camera import DIGITS, digest_of
    from mipmap_plugin.models.base import digest_of_model
    from mipmap_plugin.process.versions import versions

    facts = [digest_of_model(wrapped.model), wrapped.asked, str(wrapped.trained), digest_of(views), [view.name for view in views], how, versions()]
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:DIGITS]


def _finished(record: Path, pictures: Sequence[Path], outputs: Sequence[str]) -> dict[str, str]:
    """The names of the pictures that the same command finished before it was interrupted, each with its sha256; none that was replaced since, or
    whose other outputs are gone."""
    try:
        told = json.loads(settled(record).read_text(encoding="utf-8"))["finished"]
    except (OSError, ValueError):  # none, or cut off by a crash of the machine
        return {}
    whole = [each for each in pictures if all(path.is_file() for path in (each, *(_beside(each, name) for name in outputs)))]
    return {each.name: told[each.name] for each in whole if each.name in told and sha256(each) == told[each.name]}


@contextmanager
def _kept(record: Path, finished: dict[str, str]) -> Iterator[None]:
    """Say what was finished before; inside, Ctrl-C says how many pictures are, and how to go on; after it all are, and the record is of no use."""
    if finished:
        note(f"pictures that this command finished before it was interrupted: {len(finished)}; they are not rendered again")
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(f"interrupted with {plural(len(finished), 'picture')} finished; run the same command again to go on") from interrupt
    record.unlink(missing_ok=True)


def _refuse(wrapped: Wrapped, pictures: Sequence[Path], outputs: Sequence[str], overwrite: bool) -> None:
    """Raise the errors that writing the pictures and the other outputs would raise."""
    from mipmap_plugin.models.outputs import parts_of

    parts = parts_of(wrapped.model.source, wrapped.model.folder)
    for picture in pictures:
        for path in (picture, *(_beside(picture, name) for name in outputs)):
            refuse_output(path, overwrite, parts, is_file=True)
    for picture in pictures[:1]:
        refuse_unwritable(picture)


def _write(picture: Path, rendered: Rendered, outputs: Sequence[str], overwrite: bool, record: Path, finished: dict[str, str]) -> None:
    """Write a picture and its other outputs, and that it is finished: all of it or nothing. Those of a picture that it replaces go."""
    from mipmap_plugin.formats.images import write_array, write_image

    with together(record, [_beside(picture, name) for name in OUTPUTS if overwrite and name not in outputs]):
        write_image(picture, rendered.image, overwrite=overwrite)
        for name in outputs:
            write_array(_beside(picture, name), getattr(rendered, name), overwrite=overwrite)
        now = finished | {picture.name: sha256(staged(picture))}
        write_json(record, {"finished": now}, overwrite=True)
    finished.update(now)


def _beside(picture: Path, name: str) -> Path:
    return picture.with_name(f"{picture.stem}_{name}.npy")


def _named(wrapped: Wrapped, names: Sequence[str]) -> list[Camera]:
    cameras = wrapped.views()
    if not names:
        return [c for c in cameras if c.split == "test"] or cameras
    called = {picture.removesuffix(".png"): c.name for c, picture in zip(cameras, picture_names(cameras), strict=True)}  # as pictures are, too
    wanted = {name if name in called.values() else called.get(name.removesuffix(".png"), name) for name in names}
    chosen = [c for c in cameras if c.name in wanted]
    if missing := wanted - {c.name for c in chosen}:
        some = ", ".join(c.name for c in cameras[:5])
        raise SettingsError(f"there is no view {', '.join(sorted(missing))}; the first of {len(cameras)} are {some}")
    return chosen
