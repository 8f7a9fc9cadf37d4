"""A job with its files, for a worker that does not see this machine's disk, and the files that come back."""

from __future__ import annotations

import io
import os
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mipmap_plugin.errors import TEMPORARY, SettingsError
from mipmap_plugin.formats.atomic import named, new_file, new_folder, refuse_output, together
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.models import detect
from mipmap_plugin.models.outputs import parts_of, refuse_parts
from mipmap_plugin.models.places import conversion_state, page_of, state_path
from mipmap_plugin.models.zipped_folder import unzipped
from mipmap_plugin.scenes import OPTIONS, load_scene

# Folders of an unpacked parcel.
BASE, CAMERAS, IMAGES, NETWORK, OUTPUT = (Path(name) for name in ("base", "cameras", "images", "network", "output"))


@dataclass(frozen=True)
class Parcel:
    """A job whose paths are relative to the folder that its files are unpacked in."""

    job: Job
    files: bytes  # a tar archive


@dataclass(frozen=True)
class Delivery:
    """The outcome of a job that was sent, and the files that it wrote."""

    outcome: Outcome
    files: bytes


def pack(job: Job) -> Parcel:
    """Pack the checkpoint of a job, its cameras, photographs and network, and the state of its run, if it was interrupted.

    Raises CheckpointError, SceneError, SettingsError, OutputExists, OutputError, OSError.
    """
    if job.needs_folder:
        raise SettingsError(job.needs_folder)
    base = replace(job.base, checkpoint=unzipped(job.base.checkpoint))
    checkpoint = detect(base.checkpoint)
    refuse_output(job.target, job.overwrite, parts_of(checkpoint.path, checkpoint.folder))  # which the worker cannot know
    folder = checkpoint.folder  # with the options and networks of the checkpoint, also where its PLY is given
    if folder is None or not base.checkpoint.is_relative_to(folder):
        folder = base.checkpoint if base.checkpoint.is_dir() else base.checkpoint.parent
    parts = [part for part in dict.fromkeys(parts_of(checkpoint.path, checkpoint.folder)) if part.is_relative_to(folder)]
    members = {BASE / part.relative_to(folder): part for part in parts}
    members |= {} if base.cameras is None else _scene(base.cameras, CAMERAS)
    members |= {} if job.images is None else _photographs(job.images, IMAGES)
    network = job.network and NETWORK / job.network.name
    members |= {network: job.network} if network and job.network else {}
    members |= {OUTPUT / state.name: state for state in _states(job.target) if state.is_file()}
    sent = replace(base, checkpoint=BASE / base.checkpoint.relative_to(folder), cameras=base.cameras and _packed(base.cameras, CAMERAS))
    target = OUTPUT / named(job.target).name
    images = job.images and _packed(job.images, IMAGES)
    return Parcel(replace(job, base=sent, target=target, images=images, network=network), _archive(members))


def do_parcel(parcel: Parcel, do: Callable[[Job], Outcome]) -> Delivery:
    """Do the job of a parcel in a folder of its own, which is removed at the end."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        place, job = Path(folder), parcel.job
        with tarfile.open(fileobj=io.BytesIO(parcel.files)) as archive:
            archive.extractall(place, filter="data")
        (place / OUTPUT).mkdir(exist_ok=True)
        base = replace(job.base, checkpoint=place / job.base.checkpoint, cameras=job.base.cameras and place / job.base.cameras)
        images, network = job.images and place / job.images, job.network and place / job.network
        outcome = do(replace(job, base=base, target=place / job.target, images=images, network=network))
        kept = {"done": (place / OUTPUT).rglob("*"), "interrupted": _states(place / job.target)}.get(outcome.status, [])
        written = [file for file in kept if file.is_file()]
        file = outcome.file and outcome.file.relative_to(place / OUTPUT)
        reason, *warnings = (text.replace(f"{place}{os.sep}", "") for text in (outcome.reason, *outcome.warnings))
        told = replace(outcome, job=job, file=file, reason=reason, warnings=tuple(warnings))
        return Delivery(told, _archive({each.relative_to(place / OUTPUT): each for each in written}))


def unpack(delivery: Delivery, job: Job) -> Outcome:
    """Write what came back to where the job was to write it, atomically: its files, or the state of its run. Raises OutputExists, OutputError."""
    outcome, place = replace(delivery.outcome, job=job), named(job.target).parent
    if outcome.status == "interrupted":
        with tarfile.open(fileobj=io.BytesIO(delivery.files)) as archive:
            for member in archive.getmembers():
                _write(archive, member, place, replace(job, overwrite=True), [])
        return outcome
    if outcome.status != "done" or outcome.file is None:
        return outcome
    base, within = job.base.checkpoint, outcome.file.parts[1:]  # of a model folder
    source, model_folder = (None, base) if base.is_dir() else (base, None)
    refuse_parts(job.target, job.overwrite, source, model_folder, within[0] if within else None)
    with together(job.target, [*_states(job.target), *page_of(job.target)]), tarfile.open(fileobj=io.BytesIO(delivery.files)) as archive:
        if within:
            with new_folder(job.target, job.overwrite) as folder:
                archive.extractall(folder.parent, filter="data")
        else:
            for member in archive.getmembers():
                _write(archive, member, place, job, parts_of(source, model_folder))
    return replace(outcome, file=place / outcome.file)


def _states(target: Path) -> list[Path]:
    """Where the states of a run, and of a conversion before it, are."""
    state = state_path(target)
    return [state, conversion_state(state)]


def _write(archive: tarfile.TarFile, member: tarfile.TarInfo, place: Path, job: Job, base: list[Path]) -> None:
    content, path = archive.extractfile(member), place / member.name
    assert content is not None
    refuse_output(path, job.overwrite, base, is_file=True)
    with new_file(path, job.overwrite) as temporary:
        temporary.write_bytes(content.read())


def _scene(path: Path, folder: Path) -> dict[Path, Path]:
    """The files of a scene, by their names in the archive: a file, a model folder's cameras and options, or the folder with its photographs."""
    packed = _packed(path, folder)
    file, within = (path, packed.parent) if path.is_file() else (path / "cameras.json", packed)
    if file.is_file():
        return {within / each.name: each for each in (file, file.with_name(OPTIONS)) if each.is_file()}
    return {within / file.relative_to(path): file for file in _files(path)}


def _files(folder: Path) -> Iterator[Path]:
    """All files below a folder. Links to folders are followed, as photographs often are behind one, but not links to a folder around them."""
    for entry in sorted(folder.iterdir()):
        if entry.is_file():
            yield entry
        elif entry.is_dir() and not (entry.is_symlink() and folder.resolve().is_relative_to(entry.resolve())):
            yield from _files(entry)


def _photographs(path: Path, folder: Path) -> dict[Path, Path]:
    """`_scene` of photographs, also of a file that names them."""
    if path.is_dir():
        return _scene(path, folder)
    within = {file: os.path.relpath(file, path.parent) for file in (path, *load_scene(path).images.values())}
    if other := next((file for file, name in within.items() if name.startswith("..")), None):
        raise SettingsError(f"{path}: its photograph {other} lies outside its folder, so that it cannot be sent; give a folder with all of them")
    return {folder / name: file for file, name in within.items()}


def _packed(path: Path, folder: Path) -> Path:
    """Where a scene is in the archive. The name of the folder above is kept, for it says which capture of HyperNeRF it is (`scenes.hypernerf`)."""
    return folder / path.name if path.is_file() else folder / path.absolute().parent.name / "scene"


def _archive(members: Mapping[Path, Path]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", dereference=True) as archive:
        for name, file in members.items():
            archive.add(file, name.as_posix(), recursive=False)
    return stream.getvalue()
