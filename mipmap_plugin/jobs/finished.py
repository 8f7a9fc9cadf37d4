"""Outputs that need not be made again: they were made from the same files, for the same scale and viewer, with the same settings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mipmap_plugin.adaptation.optimization.amount import as_taken
from mipmap_plugin.adaptation.portable import settings_for_several
from mipmap_plugin.adaptation.target.resize import fitting
from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import CheckpointError, SceneError
from mipmap_plugin.formats.atomic import named, settled, sha256
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.adapted_scale import orbit_in
from mipmap_plugin.models.places import REPORT
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes.orbits import Orbit
from mipmap_plugin.splatting.viewers import viewers_for


def finished(job: Job, *, may_load: bool = True) -> tuple[Path, dict[str, Any]] | None:
    """The checkpoint that the job would make, and its report, if they are there already; None if not. may_load: see `_digest`."""
    for file, report in _outputs(job.target):
        provenance = _in_header(file) or report
        same = _is_requested(provenance, job) and _is_of_inputs(provenance, job)
        if same and provenance.get("base") == _digest(job, provenance.get("base"), may_load):
            return file, report
    return None


def _outputs(target: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The adapted checkpoints at `target`, a file or a model folder, with their reports."""
    target = settled(named(target))
    reports = sorted(target.rglob("*" + REPORT)) if target.is_dir() else [target.with_name(target.name + REPORT)]
    for path in reports:
        file = path.with_name(path.name.removesuffix(REPORT))
        try:
            report = read_json(path)
        except SceneError:
            continue
        if isinstance(report, dict) and file.is_file():
            yield file, report


def _in_header(file: Path) -> dict[str, Any] | None:
    """The provenance in the header of a PLY, which another file may have replaced since the report was written; None in other formats."""
    if file.suffix.lower() != ".ply" or is_written(file):
        return None
    try:
        return provenance_of(read_header(file).comments) or {"base": None}
    except CheckpointError:
        return {"base": None}


def _is_requested(provenance: dict[str, Any], job: Job) -> bool:
    """Whether scale, viewer and settings are those of the job, but for a filter that fits (`_fits`)."""
    try:
        settings = AdaptConfig.model_validate(provenance.get("settings"))
    except ValidationError:  # of another version
        return False
    expected = job.config()
    if job.viewer is not None and len(viewers_for(job.viewer)) > 1:
        expected = recipe(job.recipe, job.scale, **(settings_for_several(expected) | job.settings))
    if "merge_to" not in job.settings and settings.merge_to == 1:  # splats of this family are not merged
        expected = expected.model_copy(update={"merge_to": 1.0})
    if expected.resize == "fitting":
        expected = expected.model_copy(update={"resize": settings.resize})
    wanted = (job.scale, job.viewer, as_taken(expected, settings))  # the same base has the same size
    return (provenance.get("scale"), provenance.get("viewer"), settings) == wanted


def _is_of_inputs(provenance: dict[str, Any], job: Job) -> bool:
    """Whether what is given beside the checkpoint is the job's: a hash of the cameras, the background, the screen filter, and hashes of the
    photographs and of a network; and the filter that makes images smaller is one that fits these cameras, where the settings leave its choice."""
    cameras = job.base.own_cameras()
    photographs = {} if job.images is None else {"photographs": job.base.photographs(job.images).digest()}
    inputs = job.base.asked(cameras) | photographs | network_input(job.config().upsampler)
    return provenance.get("inputs") == inputs and _fits(provenance, cameras, job)


def _fits(provenance: dict[str, Any], cameras: Sequence[Camera], job: Job) -> bool:
    """Whether `fitting` may have chosen the file's filter: of a zoom-in it depends on the base's screen filter, which only loading might tell."""
    if (config := job.config()).resize != "fitting":
        return True
    recorded = orbit_in(provenance)  # on it depends the size of its views
    somewhere = Viewpoints(Orbit(**recorded) if recorded else Orbit((0.0, 0.0, 0.0), None, 1.0), list)
    as_large = {"extra_views": 1, "views": "train" if config.views == "jittered" else config.views}
    views, _ = choose_views(cameras if job.images is None else (), somewhere, config.model_copy(update=as_large))
    drawn = ("classic", "antialiased") if job.base.screen_filter is None else (job.base.screen_filter,)
    return provenance["settings"]["resize"] in [fitting(config, Effects(screen_filter=name), views, job.scale).resize for name in drawn]


def _digest(job: Job, wanted: Any, may_load: bool) -> str:
    """The hash of the base checkpoint: of its file where that is `wanted`, otherwise, if it may be loaded, as its family computes it."""
    digest = sha256(detect(job.base.checkpoint).path)
    return digest if digest == wanted or not may_load else load_model(job.base.checkpoint).digest
