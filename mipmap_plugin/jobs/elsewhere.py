"""Whether other processes can do a job: a plug-in that was registered by a call is known to the process of that call alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models import detect
from mipmap_plugin.models.families import FAMILIES
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.splatting.viewers import VIEWERS


def refuse_elsewhere(jobs: Sequence[Job]) -> None:
    """Raise SettingsError if a job needs a plug-in that only this process knows."""
    if name := next((name for job in jobs for name in _only_here(job)), ""):
        others = "other processes, which --jobs and --dask use, do not know it"
        raise SettingsError(f"the {name} is registered in this process alone, and {others}; register it by an entry point, or do one job at a time")


def _only_here(job: Job) -> Iterator[str]:
    upsampler = job.settings.get("upsampler") if job.network is None else None  # a network's file is registered by each process itself
    named = {"backend": (BACKENDS, job.base.backend), "viewer": (VIEWERS, job.viewer), "recipe": (RECIPES, job.recipe)}
    for kind, (registry, name) in {**named, "upsampler": (UPSAMPLERS, upsampler)}.items():
        if registry.is_only_here(name):
            yield f"{kind} {name!r}"
    if any(map(FAMILIES.is_only_here, FAMILIES.names())) and FAMILIES.is_only_here(family := _family(job)):
        yield f"family {family!r}"


def _family(job: Job) -> str:
    """The family of a job's checkpoint; "" for one that cannot be read, which the job will report."""
    try:
        return detect(job.base.checkpoint).family
    except (MipmapPluginError, OSError):
        return ""
