"""A scene in the frame of a model: trainings turn, shift and scale worlds, and a base's cameras tell in which one they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch

from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.errors import SettingsError, some_of
from mipmap_plugin.models.base import Placed, SplatModel
from mipmap_plugin.models.hosts import Capture
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import DEFORMABLE, Scene
from mipmap_plugin.scenes.base import SPLIT

# Cameras are in a world if they are nearer to its cameras than to those of the other by this factor: in neither, one is nearer by chance.
FAR_NEARER = 0.1

# Cameras that tell in which world all of them are.
LOOKED_AT = 256


def placed(model: SplatModel, scene: Scene, cameras: Sequence[Camera] = ()) -> Scene:
    """The scene in the frame that the model was trained in, and with its test views: gsplat and splatfacto transform it.

    `cameras`: of the model, if any are known. Raises SceneError, and SettingsError for a capture that was read as another project does.
    """
    if scene.as_4dgaussians and DEFORMABLE in read_options(model.folder)[0]:
        other = "was read as 4DGaussians does, and Deformable 3D Gaussians, which trained this checkpoint, takes other views and times"
        remedy = "give the path itself as images or cameras, or read it by load_scene(path, {'is_6dof': False})"
        raise SettingsError(f"{scene.source}: {other}; {remedy}")
    if not model.traits.placed:
        return _unapplied(scene, cameras)
    scene = scene.original()
    capture = Capture(scene.points, scene.smaller if scene.images else None, scene.applied_scale, scene.numbers)
    there = scene.with_cameras(cast(Placed, model).as_trained(scene.cameras, capture))
    if [camera.split for camera in there.cameras] == [camera.split for camera in scene.cameras]:
        return there
    held_out = some_of(len(there.split("test")), len(there.cameras), "view")
    tests = f"the checkpoint's options hold out {held_out}: these are for testing"
    return replace(there, notes=[*(note for note in there.notes if SPLIT not in note), tests])


def _unapplied(scene: Scene, cameras: Sequence[Camera]) -> Scene:
    """The scene in COLMAP's world if the base's `cameras` are there and not in that of nerfstudio's file, which was turned (`Scene.applied`)."""
    original = scene.original()
    if original is scene or not cameras or not _apart(original, cameras) < FAR_NEARER * _apart(scene, cameras):
        return scene
    note = "its applied_transform is taken back, for the checkpoint's cameras are where these were before it"
    return replace(original, notes=[*original.notes, note])


def _apart(scene: Scene, cameras: Sequence[Camera]) -> float:
    """How far cameras of a scene and of a base are from the nearest of the other, median, in world units; one may have but some of the other's."""
    pairs = (scene.cameras, cameras), (cameras, scene.cameras)
    return min(_to_nearest(evenly(some, LOOKED_AT), others) for some, others in pairs)


def _to_nearest(some: Sequence[Camera], others: Sequence[Camera]) -> float:
    """How far `some` cameras are from the nearest of the `others`, median, in world units."""
    these, those = (torch.stack([camera.center for camera in each]) for each in (some, others))
    return float(torch.cdist(these, those, compute_mode="donot_use_mm_for_euclid_dist").amin(1).median())
