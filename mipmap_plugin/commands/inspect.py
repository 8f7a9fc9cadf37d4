"""`mipmap-plugin inspect`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.common import base_cameras, print_facts, print_json
from mipmap_plugin.commands.types import Cameras, Checkpoint, ScreenFilter, Up
from mipmap_plugin.errors import PluginError, SettingsError, plural
from mipmap_plugin.formats.here import typed
from mipmap_plugin.jobs.base import COLORS
from mipmap_plugin.process.garbage import uncollected
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.wrap import Wrapped


def inspect(
    checkpoint: Checkpoint,
    iteration: int | None = None,
    screen_filter: ScreenFilter = None,
    cameras: Cameras = None,
    up: Up = None,
    viewers: bool = True,
    all: bool = False,
    json: bool = False,
) -> None:
    """Say whether a checkpoint is sound, what it is, which effects it needs, and what is wrong with it.

    Args:
        checkpoint: A PLY, .spz, .sog, .splat or .glb, or a model folder.
        iteration: Which iteration of a model folder; by default the newest.
        viewers: Render a few views as web viewers do, and report their PSNR against renders with the filter of the training.
        all: Also list the effects that are off, with reasons. The JSON always has them.
        json: Print JSON instead of sentences.
    """
    with announced(f"reading {checkpoint.name}"), uncollected():
        from mipmap_plugin.models import detect, load_model
        from mipmap_plugin.models.zipped_folder import with_archives_named

        found = detect(checkpoint, iteration=iteration)
        known = {"file": with_archives_named(found.path), "family": found.family}
        if not json:
            print_facts(known)  # before torch is imported
        from mipmap_plugin.wrap import wrap_model

        model = load_model(checkpoint, iteration=iteration)
        wrapped = wrap_model(model, cameras=cameras, screen_filter=screen_filter, up=up)
    inspected = checkpoint if iteration is None or not checkpoint.is_dir() else _of_iteration(found.path)
    facts = _facts(inspected, wrapped, cameras, whole=all or json)
    asked = [note for note in model.notes if "--screen-filter" in note and screen_filter]  # which is answered
    if not json:
        print_facts(facts)  # before pictures are drawn, which takes longer
    with announced("drawing as viewers do"):
        differences = _differences(wrapped) if viewers else "not requested"
    last = {"viewers": differences, "notes": [note for note in model.notes if note not in [*facts["health"], *asked]]}
    print_json(known | facts | last) if json else print_facts(last)


def _of_iteration(splats: Path) -> Path:
    """What `adapt`, which takes the newest iteration of a model folder, is given for that of the file `splats`: its folder, or itself."""
    from mipmap_plugin.models.adapted_name import model_of

    return splats.parent if model_of(splats.parent) else splats


def _differences(wrapped: Wrapped) -> str:
    """`viewer_differences`, or that the backend failed: nobody asked for it here, and the checkpoint may be sound."""
    from mipmap_plugin.evaluation.viewer_differences import viewer_differences

    try:
        return viewer_differences(wrapped)
    except PluginError as error:
        return f"not drawn: {error}"


def _facts(checkpoint: Path, wrapped: Wrapped, given: Path | None, *, whole: bool) -> dict[str, Any]:
    """What is known of a loaded model without a picture, by name. `given`: where its cameras lie; `whole`: with the effects that are off."""
    from mipmap_plugin.adaptation.views.remarks import hints, remarks
    from mipmap_plugin.effects import explain
    from mipmap_plugin.models.base import effects_of
    from mipmap_plugin.models.health import examine, holds_splats
    from mipmap_plugin.models.vanilla import VanillaModel
    from mipmap_plugin.splatting.eigen import by_axes

    model = wrapped.model
    with announced("examining"):
        gaussians = model.gaussians(wrapped.views()[0].zoomed(_adapted_to(wrapped) or 1.0))
        health = examine(model if holds_splats(model) else VanillaModel.from_gaussians(by_axes(gaussians), model.trained))
        effects = explain(wrapped.effects(), gaussians, effects_of(model))
        off = sum(not effect.on for effect in effects)
        near = wrapped.effects().near_plane
        lost = remarks(wrapped.views(), model, near, orbit=not wrapped.cameras)
        try:
            wrapped.refuse_undrawn()
        except SettingsError as error:  # which adapting would raise
            lost = [*dict.fromkeys([str(error), *lost])]
        told = [*health.sentences(), *lost, *hints(wrapped.views(), model, near)]
    return {
        "verdict": _verdict(wrapped, _advice(wrapped, checkpoint, given), told, bool(lost) or health.spoilt(), health.mostly_unseen()),
        "splats": len(gaussians),
        "sh degree": f"{gaussians.used_sh_degree()} in use of {gaussians.sh_degree}",
        "trained with": f"{wrapped.trained.told()}, background {_color(wrapped.background)}",
        "cameras": _seen_by(wrapped, given),
        "effects": [str(effect) for effect in effects if effect.on or whole] + ([f"{off} more are off (--all)"] if off and not whole else []),
        "health": told or ["nothing found"],
    }


def _color(background: tuple[float, ...]) -> str:
    """A background in the words of --background, or by its numbers."""
    return next((name for name, color in COLORS.items() if name and color == background), str(background))


def _seen_by(wrapped: Wrapped, given: Path | None) -> str:
    """The cameras in words, or what a model without any is looked at from. `given`: where they lie."""
    from mipmap_plugin.scenes import unread_cameras
    from mipmap_plugin.scenes.base import sizes_of

    if wrapped.cameras:
        place, tests = base_cameras(wrapped, given), sum(camera.split == "test" for camera in wrapped.cameras)
        own = f"{len(wrapped.cameras)}, {sizes_of(wrapped.cameras)}, {tests} of them test views"
        return f"{own}, of its base, in {place}" if place else own
    unread, orbit = unread_cameras(wrapped.model.source), wrapped.viewpoints.orbit
    none = f"none are read; {unread} may be of this scene" if unread else "none beside the checkpoint"
    told = orbit.up or orbit.seen
    return f"{none}; {f'it is looked at {orbit.told()}' if told else 'give the scene (--cameras), or say what is up (--up z, for one)'}"


def _verdict(wrapped: Wrapped, advice: str, health: Sequence[str], spoilt: bool, unseen: str) -> str:
    """Whether the checkpoint is sound, and what to do with it. `health`: remarks; `spoilt`: one says that it is not; `unseen`: that most is."""
    from mipmap_plugin.models.health import DROPPED

    if lost := next((note for note in wrapped.model.notes if DROPPED in note), None):
        return f"doubtful: {lost}; train or export it again, or adapt what is left"
    if spoilt:
        return "doubtful: read health before you adapt it"
    remarks = len(health)
    noted = f", but {unseen}" if unseen else f", with {plural(remarks, 'remark')} (health)" if remarks else ""
    scale = _adapted_to(wrapped)
    made = "" if scale is None else f", adapted to x{scale:g}, at which alone it looks right"
    return f"sound{made}{noted}; next: {advice}"


def _adapted_to(wrapped: Wrapped) -> float | None:
    """The scale that a checkpoint was adapted to, if that is another than its base's."""
    from mipmap_plugin.models.adapted_scale import adapted_scale

    scale = adapted_scale(wrapped.model.source)
    return None if scale == 1 else scale


def _advice(wrapped: Wrapped, checkpoint: Path, given: Path | None) -> str:
    """The next command for a sound checkpoint, with what this one was told. `given`: where its cameras lie."""
    from mipmap_plugin.scenes import unread_cameras

    named = f"./{checkpoint}" if str(checkpoint).startswith("-") else str(checkpoint)  # or it would be taken for an option
    if _adapted_to(wrapped) is not None:  # the scale that it is drawn at unless another is given
        own = [] if given is None else ["--cameras", str(given)]
        return typed(["mipmap-plugin", "render", named, "--output", "DIR", *own])
    words = ["mipmap-plugin", "adapt", named, "--scale", "1/4"]
    if told := wrapped.asked["screen filter"]:
        words += ["--screen-filter", told]
    if given is None and not wrapped.cameras and (up := wrapped.asked.get("up")):
        words += ["--up", up]
    elif cameras := given or (None if wrapped.cameras else unread_cameras(wrapped.model.source)):
        words += ["--cameras", str(cameras)]
    return typed(words)
