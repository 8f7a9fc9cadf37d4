"""What is asked of tiles: requests that no tiles serve are refused, and the folder of a request is claimed for it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.formats.atomic import new_file, refuse_output, refuse_unwritable, settled, sha256, write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.formats.staging import claim as lock
from mipmap_plugin.formats.staging import missing_folders, release, remove_empty
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models.adapted_scale import refuse_adapted
from mipmap_plugin.models.outputs import parts_of
from mipmap_plugin.models.places import PLAN
from mipmap_plugin.splatting.viewers import viewers_for
from mipmap_plugin.tiles.folder import BASE, CUT, FEWEST, work_folder
from mipmap_plugin.tiles.reading import find_splats, make_cut

# Of the folder's files: those of another format are not gone on with.
FORMAT = 7


def refuse(job: Job, tiles: int) -> None:
    """Raise SettingsError for what cannot be done in tiles, OutputExists and OutputError for a target that cannot be written."""
    base = find_splats(job.base.checkpoint)[0].path
    config = job.config()
    refuse_adapted(base)
    if tiles < FEWEST:
        raise SettingsError(f"tiles: give at least {FEWEST}, got {tiles}; a scene that is not cut needs no tiles")
    if job.images is not None or job.scale > 1:
        raise SettingsError(f"x{job.scale:g}: a scene is cut into tiles for a zoom-out, without photographs; adapt it without tiles")
    if job.scale == 1 and job.viewer is None:
        raise SettingsError("x1: the base is right as it is, so that there is nothing to cut it into tiles for; give a smaller scale, or a viewer")
    if config.most_splats is not None or config.band != (1, 1):
        raise SettingsError("tiles are adapted to one scale, and to no number of splats; leave most_splats (--splats) and band out")
    if job.viewer is not None and len(viewers_for(job.viewer)) > 1:
        raise SettingsError(f"tiles are adapted for one viewer at a time, and {job.viewer} stands for several; give one of them")
    if is_written(job.target):
        raise SettingsError(f"{job.target}: tiles are joined to a .ply or a model folder; give one of these, and convert it afterwards")
    refuse_output(job.target, job.overwrite, parts_of(base, None))
    copies = 1 if (work_folder(job.target) / CUT).exists() else 2  # one is kept beside the output until all is done
    refuse_unwritable(job.target, copies * base.stat().st_size, what="the tiles take at least")


@contextmanager
def alone(jobs: Sequence[Job]) -> Iterator[None]:
    """Inside, no other command works on the tiles of these jobs, or deletes them. Raises SettingsError where one does; OSError."""
    with ExitStack() as held:
        for folder in dict.fromkeys(work_folder(job.target) for job in jobs):
            held.callback(remove_empty, missing_folders(folder.parent))
            folder.parent.mkdir(parents=True, exist_ok=True)
            place = lock_of(folder)
            if (descriptor := lock(place)) is None:
                raise SettingsError(f"{folder}: another command is making these tiles; wait until it has ended, or choose another output")
            held.callback(release, place, descriptor)
        yield


def unlock(jobs: Sequence[Job]) -> None:
    """Remove the locks of a command that was killed, as far as the system lets this one: of jobs that are finished, which need none any more."""
    for place in (lock_of(work_folder(job.target)) for job in jobs):
        with suppress(OSError):
            if place.exists() and (descriptor := lock(place)) is not None:
                release(place, descriptor)


def lock_of(folder: Path) -> Path:
    """The lock of whoever works in a work folder."""
    return folder.with_name(f".{folder.name}.lock")


def claim(jobs: Sequence[Job], tiles: int) -> None:
    """Make the work folder of each job, for this base, its settings and this number of tiles.

    Raises SettingsError, before any is made, if one holds those of others; CheckpointError, SceneError.
    """
    if any(job.base != jobs[0].base for job in jobs) or len({job.target for job in jobs}) < len(jobs):
        raise SettingsError("tiles of several jobs are those of one base, each with an output of its own; adapt other bases one after the other")
    digest = sha256(find_splats(jobs[0].base.checkpoint)[0].path)
    plans = {work_folder(job.target): _plan(job, tiles, digest) for job in jobs}
    for folder, plan in plans.items():
        if settled(folder / PLAN).exists():
            if read_json(folder / PLAN) != json.loads(json.dumps(plan)):
                others = "tiles of another base, settings or number of tiles, or of another version"
                raise SettingsError(f"{folder} holds {others}; repeat those, or delete it to start anew")
        elif folder.exists() and any(folder.iterdir()):
            raise SettingsError(f"{folder} is needed for the tiles, but holds other things; move it, or choose another output")
    for folder, plan in plans.items():
        write_json(folder / PLAN, plan, overwrite=True)


def _plan(job: Job, tiles: int, digest: str) -> dict[str, Any]:
    """Everything that the tiles of a job depend on."""
    return {
        "format": FORMAT, "base": digest, "tiles": tiles, "scale": job.scale, "viewer": job.viewer, "settings": job.config().model_dump(mode="json"),
        "inputs": job.base.asked(), "backend": job.base.backend,
    }  # fmt: skip


def cut_for(jobs: Sequence[Job], tiles: int) -> None:
    """Cut the base of some jobs into tiles, once, and leave what all their folders lack of it there. Raises CheckpointError."""
    folders = [work_folder(job.target) for job in jobs]
    if not (done := [folder for folder in folders if (folder / CUT).exists()]):
        try:
            make_cut(jobs[0].base.checkpoint, tiles, folders[0])
        except (MipmapPluginError, OSError):  # of the checkpoint, or of a full disk
            for folder in folders:
                shutil.rmtree(folder)  # nothing was done yet
            raise
        done = folders[:1]
    for folder in folders:
        for name in () if (folder / CUT).exists() else (BASE, CUT):  # the cut last, which says that both are there
            _link(done[0] / name, folder / name)


def _link(file: Path, new: Path) -> None:
    """Give a file a second name; a copy, where the disk knows no such names."""
    with new_file(new, overwrite=True) as temporary:
        with suppress(OSError):
            os.link(file, temporary)
            return
        shutil.copyfile(file, temporary)
