"""One job, from the checkpoint to the saved model; whatever goes wrong with it is its outcome."""

from __future__ import annotations

import time
import traceback
import warnings
from dataclasses import replace

from mipmap_plugin.adaptation.target.upsamplers import placed
from mipmap_plugin.errors import MipmapPluginError, OutputExists, hide_others_warnings, of_a_file
from mipmap_plugin.jobs.finished import finished
from mipmap_plugin.jobs.job import Job, Outcome
from mipmap_plugin.limits import is_out_of_memory
from mipmap_plugin.models.places import state_path
from mipmap_plugin.models.zipped_folder import with_archives_named
from mipmap_plugin.wrap import Wrapped


def run(job: Job, threads: int | None = None) -> Outcome:
    """Do a job; what is wrong with it becomes its outcome, warnings too. One that Ctrl-C interrupted goes on when it is run again."""
    began = time.perf_counter()
    with placed(job.settings.get("upsampler", ""), job.network), warnings.catch_warnings(record=True) as caught:
        hide_others_warnings()
        try:
            outcome = _attempt(job, threads)
        except KeyboardInterrupt as interrupt:
            outcome = Outcome(job, "interrupted", reason=str(interrupt) or "interrupted")
    return replace(outcome, seconds=time.perf_counter() - began, warnings=tuple(with_archives_named(each.message) for each in caught))


def _attempt(job: Job, threads: int | None) -> Outcome:
    try:
        return job.own_work(threads) or _finished_before(job) or _adapt(job, threads)
    except OutputExists as error:
        # Another process may have finished the same job meanwhile.
        return _finished_before(job) or Outcome(job, "failed", reason=with_archives_named(error))
    except MipmapPluginError as error:
        return Outcome(job, "failed", reason=with_archives_named(error))
    except OSError as error:
        return Outcome(job, "failed", reason=with_archives_named(of_a_file(error)))
    except Exception as error:
        if isinstance(error, (MemoryError, RuntimeError)) and is_out_of_memory(error):
            return Outcome(job, "failed", reason="out of memory; use a smaller scale, fewer views or fewer jobs at a time")
        return Outcome(job, "failed", reason=f"{type(error).__name__}: {with_archives_named(error)}", trace=traceback.format_exc())


def _finished_before(job: Job) -> Outcome | None:
    found = finished(job) if job.skip_finished else None
    return found and Outcome(job, "finished before", *found)


def _adapt(job: Job, threads: int | None) -> Outcome:
    base = job.base.load(threads, job.images)
    base.keeps_images = False
    check(base, job)
    scene = None if job.images is None else job.base.photographs(job.images)
    adapted = base.adapt(job.scale, recipe=job.recipe, viewer=job.viewer, resume=state_path(job.target), images=scene, **job.settings)
    file = adapted.save(job.target, overwrite=job.overwrite)
    return Outcome(job, "done", file, adapted.report_of(file).model_dump())


def check(base: Wrapped, job: Job) -> None:
    """Raise now what adapting a loaded base and saving the result would raise, as far as it can be predicted."""
    config = job.config()
    base.targets(job.viewer)
    networks_move = config.steps > 0 and config.rates.networks > 0
    base.refuse_output(job.target, overwrite=job.overwrite, networks_move=networks_move, viewer=job.viewer)
