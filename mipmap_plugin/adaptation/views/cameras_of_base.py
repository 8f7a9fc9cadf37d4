"""The cameras of the base of an adapted file, which a lone file has not beside it: its report says where they were read from."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.camera import Camera, digest_of
from mipmap_plugin.errors import MipmapPluginError, is_temporary, warn
from mipmap_plugin.models.adapted_scale import report_beside
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.models.zipped_folder import unzipped, with_archives_named
from mipmap_plugin.scenes import Scene, cameras_in, load_scene, model_cameras

# What is said where the cameras are gone, or are others by now.
GONE = "views of a generated orbit are taken instead; give the scene's cameras (--cameras)"


def own_cameras(source: Path | None, folder: Path | None) -> tuple[list[Camera] | Scene, dict[str, str]]:
    """The cameras beside the file `source` of a model in `folder`, in it, or of the base that it was adapted from; and `where` they were found."""
    if beside := model_cameras(folder, read_options(folder)[0]):
        return beside, where(None, folder)
    if inside := cameras_in(source):
        return inside, where(source, None)
    return _of_base(source) or ([], {})


def where(scene: Path | None, folder: Path | None) -> dict[str, str]:
    """Where cameras are read from, as `Report.cameras_from` records it: a scene or, by default, the model folder, whose options say their size.

    Of an unpacked archive, which is removed, the archive; nothing where another process unpacked it, as for a worker.
    """
    read_from = scene or folder
    paths = {"scene": read_from, "options": folder}
    places = {name: with_archives_named(path.absolute()) for name, path in paths.items() if path is not None}
    return {} if read_from is None or any(map(is_temporary, places.values())) else places


def _of_base(source: Path | None) -> tuple[list[Camera] | Scene, dict[str, str]] | None:
    """The cameras of the base of the file `source`, or their scene, and `where` they are; None if `source` is a base, or was adapted without any.

    A warning says so where they are gone, or are others by now.
    """
    place = ""
    try:
        match report := report_beside(source):
            case {"cameras_from": {"scene": str() as place, **others}, "inputs": {"cameras": str() as wanted}}:
                options = others.get("options")
            case _:
                return None
        folder = unzipped(Path(options)) if isinstance(options, str) else None
        cfg, scene = read_options(folder)[0], unzipped(Path(place))
        # Those of the base's own folder as it reads them, also where its options cannot be read.
        found = (scene == folder and model_cameras(folder, cfg)) or load_scene(scene, cfg)
        cameras = found.cameras if isinstance(found, Scene) else found
        reason = "" if digest_of(cameras) == wanted else f"the cameras in {place} are others now"
    except (MipmapPluginError, OSError) as error:
        reason = str(error)
    if reason:
        warn(f"{source} was adapted with cameras that are not found any more ({reason}): {GONE}")
        return None
    return found, report["cameras_from"]
